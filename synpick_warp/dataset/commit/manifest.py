"""Manifest of a data set: seed, versions and settings, and one entry with checksums per committed episode.

    manifest.json           seed, versions, the settings that determine the output; the first file of a data set
    manifest/constants.*    constants: models, USD assets
    manifest/000012.*       episode 12: how it ended, its attempts
    manifest/joined.*       indices: lists over all episodes; the last files of a data set

An entry is two files: `NAME.sha256` lists the checksums of its files, as `sha256sum -c` reads them in the data set's folder; `NAME.json`
is written after it and commits them. Nothing here depends on the machine, the time, or the number of worlds and writers.

A list in a folder that somebody else made could name `.git/hooks/post-checkout` or `Makefile`; files are copied by lists, so a list is
compared with the names in FORMAT_TABLE first: only those that its formats write. A record states how many frames an episode has, and
arrays, loops and tasks follow from the number: it is compared with the sizes of the files before anything is made of it.
"""

import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import os
import re
import stat
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from synpick_warp._version import __version__
from synpick_warp.configs.cell.bins import Bins
from synpick_warp.configs.cell.cameras import Still
from synpick_warp.configs.cell.gripper import EACH, SUCTION1
from synpick_warp.configs.dataset import DataLayout
from synpick_warp.configs.episodes.manipulation import MASK, SAME, Picks
from synpick_warp.configs.episodes.objects import AUTO_UNIT, Objects
from synpick_warp.configs.episodes.randomize import Randomize
from synpick_warp.configs.files.load import load_config, override_config, table_lists
from synpick_warp.configs.files.table_lists import given_values
from synpick_warp.configs.schema import CLASSIC, COLUMN, WITHIN, Config
from synpick_warp.dataset.annotations import ADVICE, Entry, IndicesEntry, Manifest, RecordedEpisode, read_record
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.formats import find_format, format_names, part_files
from synpick_warp.exporters.trajectory.arrays import EPISODES, STORE
from synpick_warp.exporters.writing.files import MANIFEST_FILE, parse_checksums
from synpick_warp.system.inputs.files import MAX_JSON, MAX_TOML, check_regular_file, describe_bytes, path_inside, read_file, read_json

ENTRIES = Path("manifest")
"""Folder of the entries, in the data set."""
CONSTANTS, INDICES = ENTRIES / "constants", ENTRIES / "joined"
CONFIG_FILE = "config.toml"
"""Resolved settings of the last bake that wrote to the data set."""
EPISODES_FILE = "episodes.jsonl"
"""List of episodes and how they ended."""
ATTEMPTS_FILE = "attempts.jsonl"
"""List of all pick attempts, ordered by episode and index; absent from bakes without picking."""
INPUTS = "inputs"
"""Key in the manifest: content digests of objects and lights."""
OBJECT = "object "
"""Start of the keys of single objects in INPUTS, before obj_id and name; older manifests have only the digest of all objects."""
FORMAT = 1
"""Version of the manifest's file format."""
FREE_SETTINGS = (
    "bake.worlds",
    "bake.episodes",
    "bake.device",
    "bake.models",
    "bake.lights",
    "randomize.bin_textures",
    "randomize.table_textures",
    "randomize.background_textures",
    "randomize.distractor_models",
    "bake.writers",
    "render.views_per_batch",
    "render.reuse",
    "render.reuse_worlds",
    "perception.views",
    "gripper.mesh",
    "picks.worlds",
)
"""Settings that may differ when a bake is resumed: no episode depends on them. Objects, lights, textures and meshes of bins and gripper are
compared by content, not by the name of their file or folder. A device of another type computes the same episodes up to rounding."""


_YOUNGER: dict[str, dict[str, Any]] = {
    "bop": {"layout": CLASSIC, "keypoints": 0, "graph": False, "rectified": False},
    "arrangement": {"fill": WITHIN, "counts": (), "drop": COLUMN, "upright": 0.0},
    "settle": {"restless": 0.0},
    "physics": {"match_all": False, "sleep": 0.0},
    "depth_sensor": {"preset": "", "disparity_noise": 0.0, "max_disparity": 0.0, "noise_width": 1, "registration": 0.0, "projector": 0.5}
    | {"dot_spacing": 4.0, "dot_brightness": 2.0, "ambient": 0.25, "infrared_noise": 0.005, "clear_reach": 0.0, "multipath": 0.0},
    "pick": {"forgive": False, "retry": SAME},
    "perception": {"camera": "", "grasp_point": MASK},
    "render": {"table_size": (0.0, 0.0), "shutter_samples": 8},
    "cameras": {"exposure_time": 0.0, "readout_time": 0.0},
    "effects": {"contrast": (0.0, 0.0), "saturation": (0.0, 0.0)},
    "gripper": {"kind": SUCTION1, "cups": (), "valve": EACH, "mesh_unit": "m", "mesh_checksum": ""},
    "suction": {"vacuum": None, "flow": None, "compliance": None},
    "objects": {"unit": AUTO_UNIT}
    | {name: getattr(Objects(), name) for name in ("embedded", "mass_volume", "symmetries", "symmetry_tolerance")},
    "bins": {item.name: item.default for item in dataclasses.fields(Bins)},
    "picks": {item.name: item.default for item in dataclasses.fields(Picks)},
    "still": {item.name: item.default for item in dataclasses.fields(Still)},
    "randomize": given_values(Randomize()),
}
YOUNGER_SETTINGS: dict[str, Any] = {f"{section}.{name}": value for section, table in _YOUNGER.items() for name, value in table.items()}
YOUNGER_SETTINGS |= {"camera": [], "bin": [], "prop": []}
"""Settings that older manifests lack, and what held before: left out where they have these values, so that older data sets can still be
read, and resumed with them."""
_ADDED = ("bop", "polygons", False)
"""Section, name and value before of a setting that manifests of 0.2.0 lack, and later ones always have."""
_YOUNGER_KEYS = ("symmetries_discrete", "symmetries_continuous")
"""Keys of object rows that older manifests lack: left out if they are empty."""
PACKAGES = ("warp-lang", "newton", "numpy", "scipy", "coacd", "opencv-python-headless", "isal", "orjson", "usd-core", "zarr")
"""Packages whose versions the output of every format depends on; `FORMAT_TABLE` has those of single formats."""
MAX_DIFFERENCES, MAX_SHOWN = 8, 80
"""Differences, and characters of a value, that an error message shows."""
_EPISODE = re.compile(r"[0-9]{6,12}")
"""Name of an episode's entry."""
_NEW_FOLDER = "restore the file, or bake again into another folder"


class _Format(msgspec.Struct):
    """Version of a manifest, which is read first: other versions may have other keys."""

    format: int


def make_manifest(config: Config) -> dict[str, Any]:
    """Build the manifest of a data set with these settings, in types of JSON."""
    settings = fixed_settings(config)
    rows = [find_format(name) for name in sorted(set(config.bake.formats).intersection(format_names()))]
    packages = (*PACKAGES, *(name for row in rows for name in row.packages))
    content = {
        "format": FORMAT,
        "seed": config.bake.seed,
        "versions": {"synpick-warp": __version__, **{name: _version(name) for name in packages}},
        "settings_checksum": _digest(settings),
        "settings": settings,
    }
    return json.loads(json.dumps(content))


def fixed_settings(config: Config) -> dict[str, Any]:
    """Settings that determine the output: all but FREE_SETTINGS, YOUNGER_SETTINGS as before and the splits' numbers of episodes.

    Nested; formats sorted by name.
    """
    settings = dataclasses.asdict(config)
    for name in table_lists():
        settings[name] = [given_values(row) for row in getattr(config, name)]
    settings["randomize"] = given_values(config.randomize)
    for key in FREE_SETTINGS:
        section, name = key.split(".")
        del settings[section][name]
    for key, before in YOUNGER_SETTINGS.items():
        *sections, name = key.split(".")
        table = settings[sections[0]] if sections else settings
        if name in table and table[name] == before:
            del table[name]
    for row in settings.get("bin", ()):
        row.pop("file", None)
    for row in settings.get("prop", ()):
        del row["mesh"]
    for row in settings["object_rows"]:
        for name in [name for name in _YOUNGER_KEYS if not row[name]]:
            del row[name]
    settings = {section: content for section, content in settings.items() if content != {}}
    settings["bake"]["formats"] = sorted(set(config.bake.formats))
    for split in settings["splits"]:
        del split["episodes"]
    if not config.splits:
        del settings["splits"]
    return settings


@functools.cache
def _version(name: str) -> str:
    """Version of an installed package; empty: not installed."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _digest(content: object) -> str:
    """SHA-256 of content as JSON with sorted keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def encode_manifest(content: Mapping[str, Any]) -> bytes:
    """Serialize a manifest as indented JSON."""
    return (json.dumps(content, indent=2) + "\n").encode()


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read a data set's manifest. Raises DatasetError if there is none, it is of another format, damaged, or has been changed by hand."""
    path = path_inside(folder, MANIFEST_FILE, folder, DatasetError)
    if not os.path.lexists(path):
        raise DatasetError(f"{folder} has no {MANIFEST_FILE}; name the folder of a data set that synpick-warp baked")
    version = read_json(path, _Format, DatasetError, _NEW_FOLDER).format
    if version != FORMAT:
        raise DatasetError(f"{path} has the format {version}; this version reads {FORMAT}")
    manifest, content = read_record(path, Manifest, _NEW_FOLDER)
    bake = manifest.settings.get("bake")
    if manifest.settings_checksum != _digest(content["settings"]) or not isinstance(bake, dict):
        raise DatasetError(f"the settings in {path} do not match their checksum: it has been changed by hand; {_NEW_FOLDER}")
    if type(bake.get("seed")) is not int or bake["seed"] != manifest.seed:
        raise DatasetError(f"the seed in {path} is not that of its settings: it has been changed by hand; {_NEW_FOLDER}")
    return content


def read_settings(folder: Path, manifest: Mapping[str, Any]) -> Config:
    """Read config.toml, the settings of the last bake, and compare them with the manifest. Raises ConfigError if it is not a file of
    settings, and DatasetError if it does not match the manifest."""
    path = path_inside(folder, CONFIG_FILE, folder, DatasetError)
    check_regular_file(path, MAX_TOML, DatasetError)
    settings = manifest["settings"]
    younger = {key: value for key, value in YOUNGER_SETTINGS.items() if "." in key and value is not None and key not in FREE_SETTINGS}
    before = {key: value for key, value in younger.items() if key.split(".")[1] not in settings.get(key.split(".")[0], {})}
    config = override_config(load_config(str(path), {}), before)
    ours, (section, name, value) = make_manifest(config)["settings"], _ADDED
    if name not in settings.get(section, {}) and ours[section][name] == value:
        del ours[section][name]
    said = describe_differences({"settings": ours}, {"settings": settings})
    if said:
        raise DatasetError(f"{path} does not match the manifest: {said}")
    return config


def differences(here: Mapping[str, Any], there: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Compare two manifests: yields (key, value here, value there) of each difference; None: no such key."""
    for name in [*here, *(name for name in there if name not in here)]:
        first, second = here.get(name), there.get(name)
        if isinstance(first, Mapping | None) and isinstance(second, Mapping | None):
            # A section of which one has no key, since all have their old values.
            yield from differences(first or {}, second or {}, f"{path}{name}.")
        elif first != second:
            yield f"{path}{name}", first, second


def describe_differences(here: Mapping[str, Any], there: Mapping[str, Any]) -> str:
    """Describe the differences of two manifests in a sentence, but for their inputs: "physics.step is 0.004, there 0.002"."""
    parts = []
    here, there = ({name: value for name, value in each.items() if name != INPUTS} for each in (here, there))
    for key, first, second in differences(here, there):
        if key not in ("settings_checksum", "seed"):
            parts.append(f"{_show_key(key.removeprefix('settings.'))} is {_show(first)}, there {_show(second)}")
    more = len(parts) - MAX_DIFFERENCES
    return "; ".join(parts[:MAX_DIFFERENCES] + ([f"and {more} more"] if more > 0 else []))


def describe_inputs(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """Format the names of inputs whose digests differ, e.g. "objects and lights (24: bowl)"; an empty string if none do."""
    differing = [name for name in {**here, **there} if here.get(name) != there.get(name)]
    kinds = " and ".join(_show_key(name) for name in differing if not name.startswith(OBJECT))
    objects = [_show_key(name.removeprefix(OBJECT)) for name in differing if name.startswith(OBJECT)]
    if not kinds or not all(any(name.startswith(OBJECT) for name in each) for each in (here, there)) or not objects:
        return kinds
    more = [f"and {len(objects) - MAX_DIFFERENCES} more"] if len(objects) > MAX_DIFFERENCES else []
    return f"{kinds} ({', '.join(objects[:MAX_DIFFERENCES] + more)})"


def _show(value: object) -> str:
    """Value as JSON for a message, cut to MAX_SHOWN characters."""
    text = json.dumps(value)
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}…"


def _show_key(key: str) -> str:
    """Key for a message: as it is if printable and short, else quoted and cut."""
    return key if key.isprintable() and len(key) <= MAX_SHOWN else _show(key)


def episode_entry(episode: int) -> Path:
    """Path of an episode's manifest entry, relative to the data set, without suffix."""
    return ENTRIES / f"{episode:06d}"


def committed_episodes(folder: Path) -> list[int]:
    """Sorted indices of committed episodes. Raises DatasetError if the folder of the entries is a link that leads out of the data set."""
    entries = path_inside(folder, str(ENTRIES), folder, DatasetError)
    names = (path.stem for path in entries.iterdir() if path.suffix == ".json") if entries.is_dir() else ()
    return sorted(int(name) for name in names if _EPISODE.fullmatch(name) and name == episode_entry(int(name)).name)


def read_entry(folder: Path, entry: Path) -> dict[str, Any] | None:
    """Read a manifest entry; None: there is none. Raises DatasetError if it cannot be read, or is damaged."""
    path = path_inside(folder, f"{entry}.json", folder, DatasetError)
    if not os.path.lexists(path):
        return None
    schema = {CONSTANTS: Entry, INDICES: IndicesEntry}.get(entry, RecordedEpisode)
    content, raw = read_record(path, schema, entry_advice(entry))
    if isinstance(content, RecordedEpisode) and content.episode != int(entry.name):
        raise DatasetError(f"{path} is damaged: it is of episode {content.episode}; {entry_advice(entry)}")
    return raw


def entry_advice(entry: Path) -> str:
    """Advice for messages about a damaged manifest entry."""
    return f"remove {entry}.json and {entry}.sha256, and resume the bake: it makes their files again"


def read_checksums(folder: Path, entry: Path) -> dict[str, str]:
    """Read the checksums of an entry's files: path relative to the data set -> SHA-256. The paths are inside the data set. Raises
    DatasetError if the list is missing, does not match its entry, or is damaged."""
    content = read_entry(folder, entry)
    path = path_inside(folder, f"{entry}.sha256", folder, DatasetError)
    lines = read_file(path, MAX_JSON, DatasetError)
    if content is None or hashlib.sha256(lines).hexdigest() != content["checksum"]:
        raise DatasetError(f"{path} does not match {path.with_suffix('.json')}; {entry_advice(entry)}")
    return parse_checksums(lines, folder, path, entry_advice(entry))


def is_complete(folder: Path, entry: Path) -> bool:
    """Whether an entry and all of its files exist, compared by total size; `verify` checks content."""
    content = read_entry(folder, entry)
    if content is None:
        return False
    try:
        states = [(folder / name).lstat() for name in read_checksums(folder, entry)]
    except (OSError, DatasetError):
        return False
    return all(stat.S_ISREG(state.st_mode) for state in states) and sum(state.st_size for state in states) == content["bytes"]


_HARMLESS = 1000
"""Number of frames up to which nothing is compared: reading finds what is missing, and says so better."""
_CAMERA, _MEMBERS = 40, 5 * 1024
"""Least bytes that a frame takes in scene_camera.json ("0": {"cam_K": nine numbers}), and in a shard (five members with headers)."""
_TIME = 0.125
"""The same of the times in a trajectory: zstd's highest level makes one byte of five of these float64."""


@functools.lru_cache(maxsize=4)
def _pattern(layout: DataLayout, entry: Path) -> re.Pattern[str]:
    """Regular expression of the file names that the formats write in an entry: of an episode, or the constants."""
    formats = [find_format(name) for name in dict.fromkeys(layout.formats)]
    names = (row.constants if entry == CONSTANTS else row.episode(layout, int(entry.name)) for row in formats)
    return re.compile("|".join(dict.fromkeys(names)))


def check_file_names(folder: Path, entry: Path, names: Iterable[str], layout: DataLayout) -> None:
    """Check that a checksum list names only files of the data set's formats. Raises DatasetError: it names another."""
    matches = _pattern(layout, entry).fullmatch
    foreign = next((name for name in names if not matches(name)), None)
    if foreign is not None:
        raise DatasetError(
            f'{folder / entry}.sha256 names "{foreign[:MAX_SHOWN]}", which none of its formats writes; {entry_advice(entry)}'
        )


def describe_strays(folder: Path, layout: DataLayout, episodes: Iterable[int]) -> str:
    """Name, in a sentence, what lies beside the parts that indices are joined from and belongs to no committed episode; empty: nothing."""
    strays = []
    known = set(episodes)
    for name in (name for name in format_names() if name in layout.formats):
        part = find_format(name).part
        if part is not None and part.joined and (folder / part.folder).is_dir():
            count = layout.cameras if part.per_scene else 1
            parts = {f"{number:06d}{part.suffix}" for episode in known for number in range(count * episode, count * (episode + 1))}
            strays += sorted(f"{part.folder}/{entry.name}" for entry in os.scandir(folder / part.folder) if entry.name not in parts)
    if not strays:
        return ""
    more = f" and {len(strays) - 1} more" if len(strays) > 1 else ""
    return f"left out: {folder}/{ascii(strays[0])[1:-1][:MAX_SHOWN]}{more}, of no committed episode"


def check_frames(folder: Path, layout: DataLayout | None, episode: int, frames: int) -> None:
    """Compare the number of frames that an episode's record states, if it is above _HARMLESS, with the sizes of its files in every format;
    raises DatasetError if one is too small. `layout` None: the data set has no settings, as a lone trajectory store."""
    for path, size, least in _sizes(folder, layout, episode) if frames > _HARMLESS else ():
        if size / least < frames:
            raise DatasetError(
                f"the record of episode {episode} in {folder} counts {frames:,} frames, but {path.relative_to(folder)} has"
                f" {describe_bytes(size)}, too little for them; {ADVICE}"
            )


def check_listed_frames(folder: Path, layout: DataLayout, row: Mapping[str, Any], names: Mapping[str, str]) -> None:
    """Compare an episode's row with the images that its checksum list names. Raises DatasetError if it counts more or fewer."""
    episode, frames = row["episode"], row["frames"]
    scene, suffix = layout.scene(episode, 0)
    for place in (f"{layout.folder(episode)}/{scene:06d}/rgb{suffix}/", f"coco/images/{scene:06d}/"):
        count = sum(name.startswith(place) for name in names)
        if count and count != len(layout.frames(0, frames)):
            raise DatasetError(f"the record of episode {episode} in {folder} counts {frames:,} frames, but {place} has {count:,}; {ADVICE}")


def _sizes(folder: Path, layout: DataLayout | None, episode: int) -> Iterator[tuple[Path, int, float]]:
    """File or folder that holds something of every frame, its size, and the least size of a frame [bytes]; only what is there."""
    name = f"{episode:06d}"
    times = folder / STORE / EPISODES / name / "ticks" / "time"
    if times.is_dir():
        yield times, sum(_size(path) for path in times.iterdir() if path.name.startswith("c")), _TIME
    parts = part_files(None if layout is None else layout.cameras)
    places: list[tuple[Path, float]] = [(folder / part.file(episode), part.frame_bytes) for part in parts if part.frame_bytes]
    if layout is not None:
        cameras, (scene, sensor) = layout.cameras, layout.scene(episode, 0)
        split = folder / layout.folder(episode)
        places.append((split / f"{scene:06d}" / f"scene_camera{sensor}.json", _CAMERA / layout.every[0]))
        first = split.with_name(f"{split.name}_web") / f"shard-{cameras * episode:06d}.tar"
        if first.is_file():
            shards = first.parent.glob(f"shard-*{cameras * episode:06d}.tar")
            yield first, sum(map(_size, shards)), _MEMBERS / layout.every[0]
    yield from ((path, _size(path), least) for path, least in places if path.is_file())


def _size(path: Path) -> int:
    """Size of a file [bytes]; 0: it cannot be looked at."""
    try:
        return path.stat().st_size
    except OSError:
        return 0
