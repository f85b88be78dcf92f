"""Proof of a data set by replication: a random share of its episodes is baked again from the recorded settings, and compared by bytes.

On the same kind of device, with the same versions, nothing may differ; a device of another kind rounds differently. A successful
proof is logged in PROOFS_FILE of the data set, with date, version, device and episodes.
"""

import math
import random
import tempfile
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from synpick_warp._version import __version__
from synpick_warp.dataset.commit import manifest as manifests
from synpick_warp.dataset.commit.verify import check_files
from synpick_warp.errors import DatasetError, SynpickError
from synpick_warp.exporters.writing.files import output_errors, write_atomically
from synpick_warp.factory.episodes import measured
from synpick_warp.factory.pipeline import bake_episodes
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import Progress

PROOFS_FILE = "proofs.md"
"""Log of the successful proofs of a data set, next to its manifest. It has no checksum."""


class Proof(NamedTuple):
    """Result of a proof: the device, the episodes that were baked again, the number of compared files, and the first difference."""

    device: str
    episodes: list[int]
    files: int
    """Number of compared files, of these episodes and of the constants."""
    problem: str


def prove(folder: Path, share: float, seed: int, progress: Progress, device: str | None = None) -> Proof:
    """Bake a share of the episodes again in a temporary folder, at least one, drawn by `seed`, and compare all of their files.

    `device`: None, that of the settings. Raises DatasetError: the folder is not a data set, has no episodes, or is of other versions;
    ConfigError: its objects or lights are not those of the bake; SynpickError as the bake.
    """
    manifest = manifests.read_manifest(folder)
    config = manifests.read_settings(folder, manifest).with_values({"bake.device": device} if device else {})
    if said := manifests.describe_differences(manifests.make_manifest(config), manifest):
        raise DatasetError(f"{folder} cannot be proved here: {said}; only the same versions bake the same bytes")
    known = manifests.committed_episodes(folder)
    if not known:
        raise DatasetError(f"{folder} has no episodes yet; resume its bake first")
    drawn = sorted(random.Random(seed).sample(known, math.ceil(share * len(known)) or 1))
    with tempfile.TemporaryDirectory(prefix="synpick-prove-") as name:
        again = Path(name) / folder.resolve().name
        again.mkdir()
        (again / manifests.MANIFEST_FILE).write_bytes(
            (folder / manifests.MANIFEST_FILE).read_bytes()
        )  # Its digests of objects and lights are compared.
        try:
            summary = bake_episodes(measured(config, ()), again, progress, drawn, deliver=lambda: None)
        except SynpickError as error:
            raise type(error)(str(error).replace(str(again), str(folder))) from error
        if summary.stopped:
            raise DatasetError(f"the proof of {folder} was interrupted: nothing was compared")
        return Proof(pick_device(config.bake.device).name, drawn, *_compare(folder, again, drawn))


def record_proof(folder: Path, proof: Proof) -> None:
    """Append a line about a successful proof to PROOFS_FILE of the data set. Raises OutputError: the file cannot be written."""
    path, episodes = folder / PROOFS_FILE, ", ".join(map(str, proof.episodes))
    line = f"- {datetime.now(UTC):%Y-%m-%d}, synpick-warp {__version__}, {proof.device}: {proof.files:,} files are those of a new bake of"
    with output_errors(path):
        before = path.read_bytes() if path.exists() else b""
        write_atomically(path, before + f"{line} episode{'s' * (len(proof.episodes) > 1)} {episodes}\n".encode())


def _compare(folder: Path, again: Path, episodes: list[int]) -> tuple[int, str]:
    """Compare constants and episodes of two data sets up to the first difference. Returns the number of files and the difference, or ""."""
    files = 0
    for entry in (manifests.CONSTANTS, *map(manifests.episode_entry, episodes)):
        then, now = (manifests.read_checksums(each, entry) for each in (folder, again))
        for name in sorted(then | now):
            files += 1
            if then.get(name) != now.get(name):
                return files, _describe(folder, again, name, then)
        if problem := check_files(folder, then).problem:  # The records are equal; the files may have changed since.
            return files, problem
        if (folder / f"{entry}.json").read_bytes() != (again / f"{entry}.json").read_bytes():
            return files, f"{folder / entry}.json differs from that of a new bake, but no file that it lists"
    return files, ""


def _describe(folder: Path, again: Path, name: str, recorded: Mapping[str, str]) -> str:
    """Describe how a file of the data set differs from that of a new bake, given its recorded checksums."""
    path = folder / name
    if name not in recorded or not (again / name).is_file():
        return f"{path} is {'only' if name not in recorded else 'not'} in a new bake"
    if problem := check_files(folder, {name: recorded[name]}).problem:
        return problem
    old, new = path.read_bytes(), (again / name).read_bytes()
    place = next((index for index, pair in enumerate(zip(old, new, strict=False)) if pair[0] != pair[1]), min(len(old), len(new)))
    return f"{path} differs from byte {place:,} on: {len(old):,} bytes here, {len(new):,} in a new bake"
