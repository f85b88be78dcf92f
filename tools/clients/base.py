"""Interface of a client, a third-party library that reads our formats, and shared helpers. Imports only NumPy: clients also run in
interpreters without our packages."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from tools.figures import describe_run, write_run
from tools.options import MeasuredRow

SAMPLES = 3
"""Number of frames read from an episode."""
PICTURE = "picture"
"""Prefix of values that are pictures from 0 to 1; they are compared by PSNR."""
PSNR = 28.0
"""Lowest PSNR of a picture [dB]: lossy video stays above, and so does another path tracer's noise; a wrong light falls below."""
MILLIMETERS = 1000.0
"""Millimetres per metre."""
Values = dict[str, np.ndarray]
"""Arrays by name, read by a client or expected; the first word of a name is the kind of value, a last number the frame."""


@dataclass
class ClientReading:
    """Values that a client has read, with remarks and versions for the table."""

    what: str
    """Summary for the printed table, as "3 scenes, 5 classes"."""
    values: Values
    remarks: list[str] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)
    """Of packages that are not installed, but imported from a folder."""


def expect_views(data_set: Any) -> Values:
    """Expected values of the sampled views, from `synpick_warp.open`. A client need not read all: those that it read are compared.

    `visible_...`: only of the instances with visible pixels. `depth` is in metres, `depth_count` in integer counts of `depth_scale`.
    """
    values: Values = {}
    for frame, view in sampled_views(data_set).items():
        seen, scale = view.masks.any(axis=(1, 2)), np.float32(view.records.camera["depth_scale"] / MILLIMETERS)
        found = {
            "rgb": view.rgb,
            "depth": view.depth,
            "depth_count": np.rint(view.depth / scale).astype(np.int64),
            "cam_K": view.intrinsics,
            "world_to_camera": view.world_to_camera,
            "object_to_camera": view.object_to_camera,
            "obj_id": view.object_ids,
            "visib_fract": view.visibility,
            "mask": view.amodal_masks,
            "mask_visib": view.masks,
            "visible_obj_id": view.object_ids[seen],
            "visible_mask": view.masks[seen],
            "visible_pose": view.object_to_camera[seen],
        }
        values |= {f"{name} {frame}": value for name, value in found.items()}
    return values


@dataclass(frozen=True)
class Client:
    """A third-party reader of one of our formats, and how its values are compared with ours."""

    packages: tuple[str, ...]
    """Distributions that it needs; the first one's version is printed."""
    find: Callable[[Path], Path | None]
    """File or folder of a data set that it opens; None: the data set has not that format."""
    read: Callable[[Path, Path, str], ClientReading]
    """Reads, by what `find` returned, the data set's folder, and the BOP toolkit's (empty: none). Runs in the client's interpreter."""
    expect: Callable[[Any], Values] = expect_views
    """Expected values, by the same names, of a data set opened by `synpick_warp.open`. Runs in our interpreter."""
    bounds: Mapping[str, float] = field(default_factory=dict)
    """Largest absolute difference allowed, by kind of value (0 if not listed)."""
    tone_map: Callable[[np.ndarray], np.ndarray] = np.asarray
    """Maps a picture of the client to one like ours, as by tone mapping. Runs in our interpreter."""


def sample_frames(count: int) -> list[int]:
    """Frames spread evenly over an episode, the first and the last among them."""
    return sorted({round(index * (count - 1) / max(SAMPLES - 1, 1)) for index in range(SAMPLES)})


def first_scene(data: Path) -> Path | None:
    """Folder of the BOP scene with the lowest scene_id; None: the data set has none."""
    scenes = [path.parent for path in data.glob("[!.]*/*/scene_camera.json") if path.parent.name.isdigit()]
    return min(scenes, key=lambda path: int(path.name), default=None)


def first_shard(data: Path) -> Path | None:
    """Shard with the lowest index; None: the data set has none."""
    return min(data.glob("*_web/shard-*.tar"), key=lambda path: path.name, default=None)


def find_usd(data: Path) -> Path | None:
    """USD file of the first episode; None: there is none."""
    return find_in(f"usd/{first_episode(data)['episode']:06d}.usdc")(data)


def find_in(name: str) -> Callable[[Path], Path | None]:
    """Function that returns the file or folder of that name in a data set; None: there is none."""
    return lambda data: data / name if (data / name).exists() else None


def first_episode(data: Path) -> dict[str, Any]:
    """Entry of episodes.jsonl with the lowest index."""
    rows = [json.loads(line) for line in (data / "episodes.jsonl").read_text().splitlines()]
    return min(rows, key=lambda row: row["episode"])


def make_matrix(rotation: Any, translation: Any) -> np.ndarray:
    """Homogeneous transform (4, 4) [m] from BOP's rotation and translation [mm]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.reshape(rotation, (3, 3)), np.reshape(translation, 3) / MILLIMETERS
    return matrix


def pose_matrix(pose: np.ndarray) -> np.ndarray:
    """Homogeneous transform (4, 4) from x, y, z [m] and a quaternion x, y, z, w."""
    x, y, z, w = np.asarray(pose[3:], np.float64) / np.linalg.norm(pose[3:])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += 2 * w * cross + 2 * cross @ cross
    matrix[:3, 3] = pose[:3]
    return matrix


def sampled_views(data_set: Any) -> dict[int, Any]:
    """`View` of the first camera for each sampled frame of the first episode."""
    episode = data_set[min(data_set)]
    return {frame: episode.view(frame) for frame in sample_frames(len(episode))}


ROOT = Path(__file__).resolve().parents[2]
TIMEOUT = 900.0
"""Time limit of a client [s]; rendering by Cycles takes most."""
NOT_INSTALLED, ALL = "not installed", "all"
_MISSING = ("ModuleNotFoundError", "PackageNotFoundError", "ImportError")


@dataclass
class Result:
    """Result of one client library: name, version, what it read, agreement, remarks, and whether the check holds."""

    client: str
    version: str = ""
    read: str = ""
    agreement: str = ""
    remarks: str = ""
    holds: bool = True


def run_module(client: str, python: str, module: str, *arguments: str) -> tuple[Result, str]:
    """Run a module of this checkout with a client's Python interpreter. Returns the client's result and its output. If the client is not
    installed, fails or prints no result, `agreement` states the reason, and the output is empty."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "ignore"}
    command = (python, "-m", module, client, *arguments)
    try:
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=TIMEOUT)
    except OSError as error:
        return Result(client, agreement=NOT_INSTALLED, remarks=str(error)), ""
    except subprocess.TimeoutExpired:
        return Result(client, agreement=f"no answer in {TIMEOUT:.0f} s", holds=False), ""
    if done.returncode:
        last = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        is_missing = last.startswith(_MISSING)
        return Result(client, agreement=NOT_INSTALLED if is_missing else "FAILED", remarks=last, holds=is_missing), ""
    return Result(client), done.stdout


def interpreters(names: Iterable[str], every: tuple[str, ...], given: list[str]) -> Iterator[tuple[str, str]]:
    """Yield each client with its Python interpreter: the current one, or those of options NAME=PATH; NAME "all" stands for every client.
    Raises ValueError: an option is not NAME=PATH, or names no client."""
    chosen: dict[str, list[str]] = {}
    for text in given:
        name, _, path = text.partition("=")
        if name not in (*every, ALL) or not path:
            raise ValueError(f"--python is {text}; allowed: NAME=PATH, names: {', '.join((*every, ALL))}")
        chosen.setdefault(name, []).append(path)
    for name in names:
        for path in chosen.get(name) or chosen.get(ALL) or [sys.executable]:
            yield name, path


def finish(tool: str, json_file: Path | None, results: list[Result]) -> int:
    """Print one row a client, and write them; returns the exit code, 1 if one disagrees or fails."""
    table = Table("client", "version", "read", "agreement", "remarks")
    for result in results:
        table.add_row(result.client, result.version, result.read, result.agreement, result.remarks, style="" if result.holds else "bold")
    Console().print(table)
    rows = [MeasuredRow(result.client, float(result.holds), bound="= 1", holds=result.holds) for result in results]
    write_run(json_file, describe_run(tool, [], rows, clients=[asdict(result) for result in results]))
    return 0 if all(result.holds for result in results) else 1
