"""Schemas of a data set's JSON files as they are read back (msgspec types): BOP annotations, object infos, run lengths, episodes; and its
own records, the manifest and the entries of constants, episodes and indices.

A file is checked once, when it is read; what comes out is its content as plain dictionaries and lists, with all of its keys. Lengths,
types and ranges hold afterwards: code behind this module does not check again. Numbers are finite, and small enough for every array
and drawing that they go into. Unknown keys are allowed and kept.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from synpick_warp.codes import MAX_CUPS, Ending, Mode, Outcome, names
from synpick_warp.codes import MAX_INSTANCES as MAX_OBSERVED
from synpick_warp.configs.cell.cameras import WORLD
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import MAX_JSON, decode_json, read_file
from synpick_warp.system.inputs.image_files import MAX_SIDE

_Content = TypeVar("_Content")
ADVICE = "restore the file, or bake the data set again"

Index = Annotated[int, Meta(ge=0, lt=2**31)]
"""Index, id or count."""
Supporter = Annotated[int, Meta(ge=-1, lt=2**31)]
"""Index, or -1."""
Key = Annotated[int, Meta(ge=0, lt=2**31)]
"""Index as a key of an object."""
Length = Annotated[float, Meta(ge=-1e9, le=1e9)]
"""Coordinate in any unit; far beyond every scene, small enough to compute with."""
Vector3 = Annotated[list[Length], Meta(min_length=3, max_length=3)]
Matrix3 = Annotated[list[Length], Meta(min_length=9, max_length=9)]
Rotation = Annotated[list[Annotated[float, Meta(ge=-1.01, le=1.01)]], Meta(min_length=9, max_length=9)]
Matrix4 = Annotated[list[Length], Meta(min_length=16, max_length=16)]
Box = Annotated[list[Annotated[int, Meta(ge=-(2**20), le=2**20)]], Meta(min_length=4, max_length=4)]
"""x, y, width, height [px]."""
Scale = Annotated[float, Meta(gt=0.0, le=1e6)]
"""Depth of one count [mm]."""
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]
Side = Annotated[int, Meta(ge=1, le=MAX_SIDE)]
"""Width or height of an image [px]."""


MAX_SYMMETRIES = 1024
"""Most symmetries of an object; a polyhedron has up to 60 rotations, and every one multiplies the work of evaluation."""


def camera_schema(*required: str, **types: Any) -> Any:
    """Schema of a view's entry in scene_camera.json: K [px], depth scale, world-to-camera rotation and translation [mm], lens. Keys that
    are not `required` may be missing, as in files of others; `types` are those of further keys, or of these, in place of the usual ones."""
    fields = [(key, kind) if key in required else (key, kind | UnsetType, UNSET) for key, kind in (_CAMERA | types).items()]
    return msgspec.defstruct("CameraEntry", fields, kw_only=True, gc=False)


_CAMERA: dict[str, Any] = {
    "cam_K": Matrix3, "depth_scale": Scale, "cam_R_w2c": Rotation, "cam_t_w2c": Vector3, "cam_dist": Any, "cam_dist_model": Any
}  # fmt: skip


class TruthEntry(Struct, gc=False):
    """Schema of an instance's entry in scene_gt.json: object-to-camera rotation and translation [mm], obj_id, instance_id if known."""

    cam_R_m2c: Rotation  # noqa: N815
    cam_t_m2c: Vector3
    obj_id: Index
    instance_id: Index | UnsetType = UNSET


class InfoEntry(Struct, gc=False):
    """Schema of an instance's entry in scene_gt_info.json: boxes and pixel counts [px], visible fraction."""

    bbox_obj: Box
    bbox_visib: Box
    px_count_all: Index
    px_count_valid: Index
    px_count_visib: Index
    visib_fract: Fraction


class RunLengths(Struct, gc=False):
    """Schema of a mask in COCO's uncompressed run-length encoding; size is height, width."""

    counts: list[Index]
    size: tuple[Side, Side]


class ContinuousSymmetry(Struct, gc=False):
    """Schema of a continuous symmetry: axis of rotation in the object's frame, and a point on it [mm]."""

    axis: Vector3
    offset: Vector3


class ModelDiameter(Struct, gc=False):
    """Schema of an object's entry in models_info.json, reduced to the diameter [mm], by which names are found."""

    diameter: Annotated[float, Meta(gt=0.0, le=1e9)]


class ModelInfo(ModelDiameter, gc=False):
    """Schema of an object's entry in models_info.json: diameter, bounding box and symmetries [mm]."""

    min_x: Length
    min_y: Length
    min_z: Length
    size_x: Annotated[float, Meta(ge=0.0, le=1e9)]
    size_y: Annotated[float, Meta(ge=0.0, le=1e9)]
    size_z: Annotated[float, Meta(ge=0.0, le=1e9)]
    symmetries_discrete: Annotated[list[Matrix4], Meta(max_length=MAX_SYMMETRIES)] | UnsetType = UNSET
    symmetries_continuous: Annotated[list[ContinuousSymmetry], Meta(max_length=MAX_SYMMETRIES)] | UnsetType = UNSET


class GraphEntry(Struct, gc=False):
    """Schema of a view's entry in scene_graph.json: edges of support and occlusion between ground-truth indices, and unstacking order."""

    occlusion: list[tuple[Index, Index, Index]]
    """Occluder, occluded, pixels."""
    support: list[tuple[Index, Supporter, Annotated[float, Meta(ge=0.0, le=1e9)]]] | UnsetType = UNSET
    """Object, supporter (-1: none that has a label), upward force [N]."""
    order: list[list[Index]] | UnsetType = UNSET
    """Strongly connected components of the support graph, none of which carries a later one."""


class TargetEntry(Struct, gc=False):
    """Schema of a record of a target list, such as test_targets_bop19.json; those of 2024 have neither object nor count."""

    scene_id: Index
    im_id: Index | list[tuple[str, Index]]
    """Several sensors: name of each, and its image (test_targets_multiview_bop25.json)."""
    obj_id: Index | UnsetType | None = UNSET
    inst_count: Index | UnsetType = UNSET
    sensor: str = ""
    """Camera of the image in a data set of several sensors, such as "cam1"; empty there: the first one, as BOP's lists have it."""


class EpisodeRow(Struct, gc=False):
    """Schema of a row of the episode list: frames and ending, which every row has."""

    frames: Index
    ending: str


class EpisodeEntry(Struct, gc=False):
    """Schema of an episode's manifest entry for readers, who take entries of all versions: row and attempts."""

    row: EpisodeRow
    attempts: list[dict[str, Any]] = []


VIEW_SCHEMAS: dict[str, Any] = {"camera": camera_schema("cam_K", "depth_scale"), "gt": list[TruthEntry], "gt_info": list[InfoEntry]}
"""Schema of a view's entry in scene_camera.json, scene_gt.json and scene_gt_info.json."""
GRAPH_SCHEMA = dict[Key, GraphEntry]
"""Schema of scene_graph.json: the entries by frame."""
MASK_SCHEMA = dict[Key, RunLengths]
"""Schema of a view's run lengths in a shard: masks by instance index."""


def check_json(data: bytes, schema: Any, source: object) -> Any:
    """Check JSON against a schema; returns its content as dictionaries, lists and numbers, with keys that the schema does not name. Keys of
    the outermost object become integers if the schema has them so. Raises DatasetError, of one line, if it is not JSON of this schema."""
    decode_json(data, schema, source, DatasetError, ADVICE)
    by_index = getattr(schema, "__origin__", None) is dict and schema.__args__[0] is Key
    return decode_json(data, dict[int, Any] if by_index else Any, source, DatasetError, ADVICE)


def read_checked(path: Path, schema: Any) -> Any:
    """Read a JSON file; schema, result and errors as `check_json`."""
    return check_json(read_file(path, MAX_JSON, DatasetError), schema, path)


def check_content(content: Any, schema: type[_Content], source: object) -> _Content:
    """Check decoded JSON against a schema; returns it as the schema's types, or raises DatasetError, of one line."""
    try:
        return msgspec.convert(content, schema)
    except (ValueError, RecursionError) as fault:
        text = str(fault).replace("`", "")
        raise DatasetError(f"{source} is damaged: {text[:1].lower()}{text[1:]}; {ADVICE}") from None


Number = Annotated[int, msgspec.Meta(ge=-(2**31), le=2**31 - 1)]
"""32-bit integer."""
Checksum = Annotated[str, msgspec.Meta(pattern=r"\A[0-9a-f]{64}\Z")]
"""SHA-256 in hexadecimal."""
MAX_INSTANCES = 255
"""Most instances of a scene: their ids are bytes of an image."""
Instances = Annotated[list[Index], msgspec.Meta(max_length=MAX_INSTANCES)]
Amount = Annotated[float, msgspec.Meta(ge=0.0, le=1e9)]
"""Non-negative quantity in any unit; small enough for every drawing."""
Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
Pixel = tuple[float, float]
"""Column and row in the perception image; integers are pixel centres."""
_Value = bool | int | float | str | None
_Section = dict[str, _Value | list[_Value | list[_Value]] | dict[str, Any]]
"""Settings of a section, or of a row of a list; distributions and tables are objects."""
_Schema = TypeVar("_Schema", bound=msgspec.Struct)


class Manifest(msgspec.Struct):
    """Schema of manifest.json: format version, seed, package versions, settings with checksum, digests of the inputs."""

    format: int
    seed: int
    versions: dict[str, str]
    settings_checksum: str
    settings: dict[str, _Section | list[_Section]]
    inputs: dict[str, str] = msgspec.field(default_factory=dict)


class Entry(msgspec.Struct):
    """Schema of a manifest entry: number and size [B] of its files, and SHA-256 of its checksum list."""

    files: Index
    bytes: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
    checksum: Checksum


class IndicesEntry(Entry):
    """Schema of the manifest entry of files over all episodes, with the episodes that they cover, sorted."""

    episodes: list[Index]


class BinRecord(msgspec.Struct):
    """Schema of the record of an episode's bin; see `views.frames.bin_record`."""

    name: str
    position: Vector
    yaw: float


class CameraRecord(msgspec.Struct):
    """Schema of the record of a camera in an episode; see `scenes.cameras.EpisodeCameras.record`."""

    matrix: Matrix
    rotation: Matrix
    translation: Vector
    fixed_to: str = WORLD


class Row(msgspec.Struct):
    """Schema of a line of episodes.jsonl; see `factory.episodes.EpisodeOutcome`."""

    episode: Index
    arrangement: Index
    ending: str
    frames: Index
    seconds: Annotated[float, msgspec.Meta(ge=0.0)]
    mode: str
    objects: Index
    attempts: Index
    picked: Index
    lost: Number
    left: Index
    sentence: str
    split: str = ""
    looks: dict[str, Any] | None = None
    bin: BinRecord | None = None
    cameras: dict[str, CameraRecord] | None = None

    def __post_init__(self) -> None:
        _check_name("ending", self.ending, names(Ending)[1:])
        _check_name("mode", self.mode, names(Mode))


class InstanceObservation(msgspec.Struct):
    """Perception result of one instance; see `stages.perception.arrays` for units and meaning."""

    instance: Index
    object_id: Index
    visible: Index
    visible_fraction: Amount
    pole: Pixel
    centroid: Pixel
    midpoint: Pixel
    distances: tuple[Amount, Amount, Amount]
    grasp_pixel: tuple[Number, Number]
    depth: float
    above: Instances
    """Parents: instances with an edge of the clutter graph to this one."""
    ancestors: Instances
    """Instances with a path to this one (transitive closure)."""

    @property
    def candidates(self) -> tuple[Pixel, Pixel, Pixel]:
        """Candidates of the suction point, in the order of `distances`."""
        return self.pole, self.centroid, self.midpoint


class RecordedObservation(msgspec.Struct):
    """Perception result on which an attempt is based."""

    resolution: tuple[Side, Side]
    """Width and height of the perception image [px]."""
    instances: Annotated[list[InstanceObservation], msgspec.Meta(max_length=MAX_OBSERVED)]
    """Instances in the scene, visible or not."""
    votes: Annotated[list[tuple[Index, Index, Amount]], msgspec.Meta(max_length=MAX_OBSERVED * (MAX_OBSERVED - 1))]
    """(lower, upper, votes): occlusion votes of the contour of `lower` for `upper` lying above it; only nonzero ones."""


class AttemptKey(msgspec.Struct):
    """Schema of what a line of attempts.jsonl is found by: episode and index of the attempt."""

    episode: Index
    attempt: Index


class Attempt(AttemptKey, omit_defaults=True):
    """Record of a pick attempt, one line of attempts.jsonl: frames, outcome, target, grasp in the world frame (None: nothing was visible),
    suction rays, seals and perception."""

    mode: Literal["pick", "target"]
    frame: Index
    """Frame on which perception ran; its image does not show the gripper."""
    end_frame: Index
    """Frame in which the attempt had ended."""
    outcome: str
    sentence: Annotated[str, msgspec.Meta(max_length=1000)]
    target: Index | None
    object_id: Number | None
    """obj_id of the target."""
    point: Vector | None
    """Grasp point [m]."""
    normal: Vector | None
    """Unit surface normal at the grasp point."""
    yaw: float | None
    """Yaw of the gripper shaft about the vertical [rad]."""
    tilt: Annotated[float, msgspec.Meta(ge=-4.0, le=4.0)] | None
    """Tilt of the cup about the wrist axis, the shaft's y axis [rad]."""
    rays: Index
    hits: Index
    """Rays that hit an object when suction was switched on."""
    good_seal: bool
    """Whether the seals were good, with the break force of a good seal: at most `suction.tolerated_misses` rays of each cup missed. With
    `suction.vacuum`: leaks left each cup at least half of the vacuum."""
    engaged: Instances
    """Instances that rays hit."""
    picked: Instances
    """Instances that left the scene on the cup."""
    peak_force: Annotated[list[Amount], msgspec.Meta(max_length=100_000)]
    """Peak seal force [N] in each tick of the lift, that of a seal that broke included; 0 in the first, which ends as suction begins."""
    observation: RecordedObservation
    sealed: Annotated[list[Index], msgspec.Meta(max_length=MAX_CUPS)] | None = None
    """Cups with a good seal; None, and not in the file, for a gripper of one cup."""
    break_force: Amount | None = None
    """Least break force of the cups that had something below them [N]; None, and not in the file, without `suction.vacuum` or hits."""

    def __post_init__(self) -> None:
        _check_name("outcome", self.outcome, names(Outcome)[1:])


class RecordedEpisode(Entry):
    """Schema of the manifest entry of a committed episode: its line of episodes.jsonl, and its attempts."""

    episode: Index
    row: Row
    attempts: list[Attempt]

    def __post_init__(self) -> None:
        if any(record.episode != self.episode for record in (self.row, *self.attempts)):
            raise ValueError(f"its row or an attempt is of another episode than {self.episode}")
        if self.row.attempts != len(self.attempts):
            raise ValueError(f"its row counts {self.row.attempts} attempts, but it has {len(self.attempts)}")


def _check_name(key: str, value: str, allowed: tuple[str, ...]) -> None:
    """Raise ValueError if a value is not one of the allowed names."""
    if value not in allowed:
        raise ValueError(f"the {key} is {msgspec.json.encode(value[:40]).decode()}, allowed: {', '.join(allowed)}")


def read_record(path: Path, schema: type[_Schema], advice: str) -> tuple[_Schema, dict[str, Any]]:
    """Read and validate a JSON file; returns its content as `schema`, and as it stands in the file, with unknown keys and the order of
    keys. Raises DatasetError, with `advice`, if it cannot be read, or is damaged."""
    data = read_file(path, MAX_JSON, DatasetError)
    return decode_json(data, schema, path, DatasetError, advice), decode_json(data, dict[str, Any], path, DatasetError, advice)
