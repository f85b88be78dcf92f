"""Table of data set formats: which class writes each, how its files are called, and what of a data set it can be made of.

How to add a format:

1. Write a class that implements `Exporter` (`base.py`). `EpisodeExporter` (there) stages and commits for it. A format of views is a
   `SceneExporter` (`bop/scene_exporter.py`), which hands it encoded views, in a module of `bop/`: follow `bop/yolo.py`. A format of ticks
   is a subpackage beside it: follow `usd/exporter.py`. Views come in any order, from several processes: for one file a scene, append
   records, and sort and count them in the commit task, as `bop/coco.py` does. Name the module in the import contract of its folder in
   pyproject.toml.
2. Add a row to FORMAT_TABLE, and its name to `FORMATS` in configs/schema.py: settings must not import exporters, and a test compares both.
   In a package of your own, name the row (a `Format`) as an entry point instead: see `system/plugins.py`.
3. Let its test class inherit `ExporterContract` (synpick_warp/testing/exporters.py): determinism, atomic commits, resuming, names of files.
   Bake once, and run `verify`.

Nothing else in the package lists formats: bakes, `convert`, `merge`, `verify`, the manifest and the reader take them from here. Tests of
the table, of conversion and of the command line name what they expect, and `tools/compare/guard.py` what it bakes. Imports no
format and no NumPy.
"""

import re
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from typing import Literal, NamedTuple

from synpick_warp.configs.dataset import DataLayout
from synpick_warp.configs.schema import FORMATS, Bop
from synpick_warp.errors import ConfigError
from synpick_warp.system.inputs.image_files import TEXTURE_KINDS
from synpick_warp.system.plugins import load_plugin

Content = Literal["views", "masks", "poses", "gripper"]
"""Content of a stored data set: images with annotations, their masks, poses of a trajectory, states and commands of the gripper."""

_INDEX = r"[0-9]{6,12}"
_PLAIN = r"[^./][^/]*"
"""A part of a path that is not hidden."""
_MODELS = rf"models(?:_eval)?/(?:models_info\.json|obj_{_INDEX}\.ply|(?:{_PLAIN}/)*{_PLAIN}\.(?i:{'|'.join(TEXTURE_KINDS)}))"
"""Models, and textures, whose names come from the models of the user."""
_NOTES = r"camera(?:_[a-z][a-z0-9_]{0,31})?\.json|dataset_info\.md"
_SCENE_CONSTANTS = rf"{_MODELS}|{_NOTES}|bop_dataset_params\.py"
_ZARR_ARRAY = r"[a-z_]+/(?:zarr\.json|c(?:\.[0-9]+)*)"
_STORE = r"trajectory\.zarr"
POINT_BYTES = 23.0
"""Size of a point of the format points [B]."""


class PartFiles(NamedTuple):
    """Files that a format has once an episode or scene, by which the reader finds the episodes of formats that it reads no further."""

    folder: str
    """Folder of the files, relative to the data set."""
    suffix: str
    """Of their names, behind six digits: the episode's index, or the BOP scene_id of a scene."""
    frame_bytes: int
    """Least size of a frame in a file [B]: numbers of frames are checked against the sizes of files. 0: they say nothing of frames."""
    per_scene: bool = False
    joined: bool = False
    """Whether an index is joined from them; those of no committed episode are then left out, with a note."""
    cameras: int = 1
    """Number of scenes of an episode, if there is a file for each."""

    def file(self, episode: int) -> str:
        """File of an episode, or of its first scene, relative to the data set."""
        return f"{self.folder}/{self.cameras * episode:06d}{self.suffix}"

    @property
    def pattern(self) -> str:
        """Glob pattern of all these files, relative to the data set."""
        return f"{self.folder}/[0-9]*{self.suffix}"

    def episode(self, number: int) -> int:
        """Index of the episode from the number in a file's name."""
        return number // self.cameras


class Format(NamedTuple):
    """Row of the table of formats; names of files are relative to the data set."""

    module: str
    """Module of its exporter, with a dot in front relative to `synpick_warp.exporters`; imported when the format is used."""
    exporter: str
    """Class in it."""
    constants: str
    """Names of the files that all episodes share, as a regular expression; "": none."""
    episode: Callable[[DataLayout, int], str]
    """Names of the files of an episode, as a regular expression."""
    sources: Callable[[Bop], tuple[Content, ...]] | None = None
    """What a stored data set must have for `convert` to make this format of it; None: no data set has it."""
    part: PartFiles | None = None
    """How `open` and `stats` find the episodes of a set of this format alone; None: the reader reads the format (bop, shards, zarr)."""
    packages: tuple[str, ...] = ()
    """Packages of this format alone whose versions its output depends on."""
    indexed: str = r"(?!)"
    """Names of the files of episodes, and of constants, that `Exporter.finalize` reads, as a regular expression; without those of which
    there are `Exporter.index_lines`."""
    remedy: str = "name other formats"
    """What to do if a package that it needs is not installed."""
    view_bytes: float = 0.0
    """Size of a view's files at full HD [B], for forecasts: bop had 57 GB for 77,166 views of real objects, of which colour is 65 %.
    0: small beside others."""
    frame_bytes: float = 0.0
    """Size of a frame of an episode [B], with ten objects."""


def _bop(layout: DataLayout, episode: int) -> str:
    """Regular expression that matches the paths of an episode's files in scene folders."""
    scenes = "|".join(dict.fromkeys(f"{layout.scene(episode, camera)[0]:06d}" for camera in range(layout.cameras)))
    sensor = f"(?:_(?:{'|'.join(layout.sensors)}))?" if layout.has_sensors else ""
    image = rf"[a-z_]+{sensor}/{_INDEX}(?:_[0-9]{{6}})?\.(?:png|jpg)"
    return rf"{re.escape(layout.folder(episode))}/(?:{scenes})/(?:scene_[a-z_]+{sensor}\.json|{image})"


def _shards(layout: DataLayout, episode: int) -> str:
    """Regular expression that matches the paths of an episode's shards, relative to the data set."""
    # Further shards of a scene have its id plus a multiple of a million.
    return rf"{re.escape(layout.folder(episode))}_web/shard-[0-9]{{0,12}}(?:{_scenes(layout, episode)})\.tar"


def _lerobot(layout: DataLayout, episode: int) -> str:
    """Regular expression that matches the paths of an episode's part and videos in the LeRobot folder."""
    video = rf"chunk-{episode // 1000:03d}/file-{episode % 1000:03d}\.mp4"
    return rf"lerobot/(?:parts/{episode:06d}\.json|videos/observation\.images\.(?:{'|'.join(layout.names)})/{video})"


def _coco(layout: DataLayout, episode: int) -> str:
    """Regular expression that matches the paths of an episode's images and parts in the COCO folder."""
    scenes = _scenes(layout, episode)
    return rf"coco/(?:parts/(?:{scenes})\.jsonl|images/(?:{scenes})/{_INDEX}\.(?:png|jpg))"


def _yolo(layout: DataLayout, episode: int) -> str:
    """Regular expression that matches the paths of an episode's images, labels and lists in the YOLO folder."""
    split = re.escape(layout.folder(episode))
    files = rf"(?:images|labels|boxes|oriented_boxes)/{split}/(?:{{0}})/{_INDEX}_{_INDEX}\.(?:png|jpg|txt)"
    return rf"yolo/(?:(?:{{0}})\.txt|{files})".replace("{0}", _scenes(layout, episode))


def _points(layout: DataLayout, episode: int) -> str:
    """Regular expression that matches the paths of an episode's clouds and lists in the folder of point clouds."""
    scenes = _scenes(layout, episode)
    return rf"points/(?:(?:{scenes})\.txt|{re.escape(layout.folder(episode))}/(?:{scenes})/{_INDEX}\.ply)"


def _scenes(layout: DataLayout, episode: int) -> str:
    """Alternatives of an episode's scene_ids, one per camera, for a regular expression."""
    return "|".join(f"{scene:06d}" for scene in range(layout.cameras * episode, layout.cameras * (episode + 1)))


FORMAT_TABLE: dict[str, Format] = {
    "bop": Format(
        ".bop.scene_exporter",
        "BopExporter",
        _SCENE_CONSTANTS,
        _bop,
        sources=lambda bop: ("views", "masks") if bop.coco else ("views",),
        view_bytes=739e3,
    ),
    "shards": Format(
        ".bop.shards",
        "ShardsExporter",
        _SCENE_CONSTANTS,
        _shards,
        sources=lambda _: ("views",),
        view_bytes=739e3,
    ),
    "usd": Format(
        ".usd.exporter",
        "UsdExporter",
        r"usd/assets/(?:[a-z_0-9]+\.usdc|lights/light_[0-9]{3,6}\.exr|textures/[a-z_0-9]+\.png)",
        lambda _, episode: rf"usd/{episode:06d}\.usdc",
        sources=lambda _: ("poses",),
        part=PartFiles("usd", ".usdc", 1),
        packages=("openexr",),
    ),
    "zarr": Format(
        ".trajectory.exporter",
        "TrajectoryExporter",
        rf"{_STORE}/(?:(?:episodes/)?zarr\.json|(?:objects|cameras)/(?:zarr\.json|{_ZARR_ARRAY}))",
        lambda _, episode: rf"{_STORE}/episodes/{episode:06d}/(?:zarr\.json|[a-z_]+/(?:zarr\.json|{_ZARR_ARRAY}))",
        frame_bytes=50e3,
    ),
    "picks": Format(
        ".picks",
        "PicksExporter",
        r"(?!)",  # None.
        lambda _, episode: rf"picks/(?:states/)?{episode:06d}\.parquet",
        part=PartFiles("picks", ".parquet", 0),
        packages=("pyarrow",),
        remedy="install it by pip install 'synpick-warp[picks]'",
    ),
    "lerobot": Format(
        ".lerobot.exporter",
        "LerobotExporter",
        _NOTES,
        _lerobot,
        indexed=rf"lerobot/parts/{_INDEX}\.json",
        sources=lambda _: ("views", "poses", "gripper"),
        part=PartFiles("lerobot/parts", ".json", 64, joined=True),  # A row in base64.
        packages=("av", "pyarrow"),
        remedy="install it by pip install 'synpick-warp[lerobot]'",
    ),
    "coco": Format(
        ".bop.coco",
        "CocoExporter",
        rf"coco/categories\.json|{_NOTES}",
        _coco,
        indexed=rf"coco/(?:categories\.json|parts/{_INDEX}\.jsonl)",
        sources=lambda _: ("views", "masks"),
        part=PartFiles("coco/parts", ".jsonl", 3, per_scene=True, joined=True),  # A line: [] and its end.
        view_bytes=480e3,
    ),
    "yolo": Format(
        ".bop.yolo",
        "YoloExporter",
        rf"yolo/data\.yaml|{_NOTES}",
        _yolo,
        sources=lambda _: ("views", "masks"),
        part=PartFiles("yolo", ".txt", 35, per_scene=True),  # A line: an image's name.
        view_bytes=480e3,
    ),
    "points": Format(
        ".bop.points",
        "PointsExporter",
        _NOTES,
        _points,
        sources=lambda _: ("views", "masks"),
        part=PartFiles("points", ".txt", 22, per_scene=True),  # A line: a cloud's name.
        view_bytes=POINT_BYTES * 1920 * 1080,
    ),
}
"""Format of this package -> its row."""


def format_names() -> tuple[str, ...]:
    """Names of all formats: of this package, then of others."""
    return tuple(dict.fromkeys((*FORMAT_TABLE, *FORMATS)))


def find_format(name: str) -> Format:
    """Row of a format of this package or of others (see `system/plugins.py`); raises ConfigError if that of others cannot be loaded."""
    return FORMAT_TABLE.get(name) or load_plugin("formats", name, *Format._fields)


def indexed_files(names: Collection[str]) -> re.Pattern[str]:
    """Regular expression of the files that these formats read to write indices over all episodes."""
    return re.compile("|".join(f"(?:{find_format(name).indexed})" for name in format_names() if name in names) or r"(?!)")


def convertible() -> tuple[str, ...]:
    """Names of the formats that `convert` writes; those of other packages without a look at them."""
    return tuple(name for name in format_names() if name not in FORMAT_TABLE or FORMAT_TABLE[name].sources is not None)


def loadable_formats() -> Iterator[Format]:
    """Rows of all formats but those of packages that cannot be loaded: data sets without these must not suffer."""
    for name in format_names():
        with suppress(ConfigError):
            yield find_format(name)


def part_files(cameras: int | None) -> list[PartFiles]:
    """Part files of all formats that have them; `cameras`: their number, None: unknown, and formats with a file per scene are left out."""
    parts = [row.part for row in loadable_formats() if row.part is not None]
    whole = [part for part in parts if not part.per_scene]
    return whole if cameras is None else whole + [part._replace(cameras=cameras) for part in parts if part.per_scene]


def contents_of(name: str, bop: Bop) -> tuple[Content, ...]:
    """Content that a stored data set with these settings must have for `convert` to make a format of it."""
    sources = find_format(name).sources
    return () if sources is None else sources(bop)
