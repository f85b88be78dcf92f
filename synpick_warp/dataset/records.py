"""JSON schemas of a data set's own records: the manifest and the entries of constants, episodes and indices.

The files are validated when they are read; code behind may index their content without checks. Unknown keys are allowed and kept.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from synpick_warp.codes import MAX_CUPS, Ending, Mode, Outcome, names
from synpick_warp.codes import MAX_INSTANCES as MAX_OBSERVED
from synpick_warp.configs.cell.cameras import WORLD
from synpick_warp.dataset.annotations import Index, Side
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import MAX_JSON, decode_json, read_file

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
    """A line of attempts.jsonl: frames, outcome, target and grasp in the world (None: nothing was visible), rays, seals, perception."""

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
    """True if at most `suction.tolerated_misses` rays of each cup missed, so that seals had the break force of a good seal; with
    `suction.vacuum`, if leaks left at least half of it below each cup."""
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
