"""Settings schema of a bake: frozen dataclasses, each field with default, unit, range and meaning. Nothing else has defaults.

The defaults are the paper's values (preset `synpick`); where the paper names none, the help text says where a value comes from.
"Released" means the generator that the paper's authors published. Sections: here, `cameras`, `gripper`, `manipulation`, `objects`,
`picks`, `randomize` and `sensors`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from synpick_warp.codes import MAX_INSTANCES, Tone, names
from synpick_warp.configs.cell.bins import BinRow, Bins, Tote
from synpick_warp.configs.cell.cameras import CameraRow, Cameras
from synpick_warp.configs.cell.extents import Cell
from synpick_warp.configs.cell.gripper import Gripper, Suction
from synpick_warp.configs.cell.rig import Rig
from synpick_warp.configs.cell.sensors import DepthSensor, Effects
from synpick_warp.configs.episodes.fills import COUNTS, Counts, parse_counts
from synpick_warp.configs.episodes.manipulation import Move, Perception, Pick, Target
from synpick_warp.configs.episodes.objects import ObjectRow, Objects
from synpick_warp.configs.episodes.picks import Picks
from synpick_warp.configs.episodes.randomize import Randomize
from synpick_warp.configs.fields import INT32_MAX, setting
from synpick_warp.views.layers import LAYER_TABLE

MODES = ("pick", "target", "move")
"""Tasks of the gripper in an episode."""
MIXED = "mixed"
"""Each episode draws its mode."""
CYCLE = "cycle"
"""Round robin: episode i has the mode MODES[i % 3], so every three episodes in a row have one of each."""
FAST = "fast"
REFERENCE = "reference"
UNOCCLUDED = "unoccluded"
RENDER_MODES = (FAST, REFERENCE, UNOCCLUDED)
"""Colour renderers."""
LAYERS = tuple(LAYER_TABLE)
"""Annotation layers (AOVs) that a view can have besides colour, depth and masks; see `synpick_warp.views.layers`."""
CLASSIC = "classic"
MULTISENSOR = "multisensor"
LAYOUTS = (CLASSIC, MULTISENSOR)
"""Layouts of scene folders: BOP's classic one, and that of BOP-Industrial 2025."""
EXCEED = "exceed"
WITHIN = "within"
COLUMN, LAYERED, SCATTERED = "column", "layers", "scattered"
"""Stacks from which objects begin to fall."""
FILLS = (EXCEED, WITHIN)
"""Rules that end the draw of an episode's objects at the volume budget."""
FORMATS = ("bop", "shards", "usd", "zarr", "picks", "lerobot", "coco", "yolo")
"""Output formats."""


@dataclass(frozen=True)
class Bake:
    """What is simulated, how much of it, where it runs and where inputs come from."""

    mode: str = setting(
        "pick",
        "",
        "Task of the gripper: pick (empty the tote), target (dig for the most occluded object), move (stir), mixed (drawn per episode), "
        "cycle (pick, target, move in turn: equal numbers).",
        choices=(*MODES, MIXED, CYCLE),
    )
    mix: tuple[float, float, float] = setting(
        (1.0, 1.0, 1.0), "", "Weights with which mode mixed draws pick, target and move for an episode.", low=0.0, high=1000
    )
    worlds: int = setting(
        0,
        "",
        "Totes simulated in parallel, on each device; 0: chosen by episodes, device and memory. A GPU simulates at least 8.",
        low=0,
        high=65536,
    )
    episodes: int = setting(
        4,
        "",
        "Episodes (sequences) to generate; each becomes one BOP scene per camera. As many as bake.worlds, where only those are set.",
        low=1,
        high=INT32_MAX,
    )
    seed: int = setting(0, "", "Random seed, from which every random number of the bake follows.", low=0, high=2**63 - 1)
    device: str = setting("auto", "", "Device: cpu, cuda:N, or auto (the first GPU if there is one).")
    models: str = setting(
        "",
        "",
        "Folder of BOP models, of PLY, OBJ, glTF, STL and STEP files, or of a folder per object; empty: the embedded procedural objects.",
        path=True,
    )
    lights: str = setting("", "", "Folder of HDR environment maps (.hdr) and sIBL sets; empty: the embedded procedural maps.", path=True)
    formats: tuple[str, ...] = setting(
        ("bop",),
        "",
        "Output formats: bop (scene folders), shards (webdataset), usd (a stage per episode), zarr (trajectories), picks (grasp trials), "
        "lerobot, coco, yolo.",
        choices=FORMATS,
    )
    writers: int = setting(0, "", "Processes that write files, for all devices; 0: one per CPU core, if memory suffices.", low=0, high=1024)


@dataclass(frozen=True)
class Arrangement:
    """Which objects an episode contains, and how they are dropped into the tote."""

    counts: Counts = setting(
        (),
        "",
        "Parts, by name or obj_id, and how many of each an episode has: one (homogeneous) or several (kitted), with a range drawn anew for "
        "each episode (mixed); empty: objects are drawn up to volume. Parts mix in the drop.",
        low=0,
        high=INT32_MAX,
        parse=parse_counts,
        allowed=COUNTS,
    )
    volume: float = setting(
        7e-3,
        "m³",
        "Budget for the total volume of the collision shapes of an episode's objects (paper: 7 l); fill says how it ends the draw.",
        above=0.0,
        high=1.0,
    )
    fill: str = setting(
        EXCEED,
        "",
        "How the budget ends the draw: exceed (the object that reaches or exceeds it is the last; the paper's tables, released) or within "
        "(that object is left out). An object that alone is larger is never drawn.",
        choices=FILLS,
    )
    max_objects: int = setting(24, "", "Maximum objects of an episode.", low=1, high=MAX_INSTANCES)
    repeat_to_fill: bool = setting(
        True, "", "Let objects repeat in an episode, as pick.repeats does, where all of the catalog together stay below the budget."
    )
    slot_shortfall: float = setting(
        1e-3,
        "",
        "Accepted fraction of draws that need more body slots than a world has; such draws are repeated, and counted.",
        above=0.0,
        high=0.5,
    )
    drop: str = setting(
        COLUMN,
        "",
        "Where objects begin to fall: column (one above the other, over the middle), layers (side by side over the whole opening: many "
        "from a low height) or scattered (each at the lowest of random places, beside those before it or right above them).",
        choices=(COLUMN, LAYERED, SCATTERED),
    )
    clearance: float = setting(
        0.01, "m", "Gap between the bounding spheres of objects as they begin to fall; scattered: of cylinders.", low=0.0, high=1.0
    )
    upright: float = setting(
        0.0, "", "Fraction of the objects that begin to fall with the z axis of their model upwards, so that most stand.", low=0.0, high=1.0
    )
    spread: float = setting(
        0.3,
        "",
        "Drop positions are uniform over this fraction of the tote's opening, in layers of an object's cell, less the object's radius.",
        low=0.0,
        high=1.0,
    )


@dataclass(frozen=True)
class Settle:
    """When a dropped pile counts as at rest, and which objects are dropped again."""

    min_time: float = setting(1.0, "s", "Minimum simulated time from the drop to the first frame.", low=0.0, high=3600.0)
    max_time: float = setting(
        10.0, "s", "A world whose pile is not at rest after this time resamples its arrangement.", above=0.0, high=3600.0
    )
    rest_displacement: float = setting(
        1e-4, "m", "An object is at rest if none of its points is displaced by more in a tick.", above=0.0, high=0.1
    )
    relax_time: float = setting(
        4.0,
        "s",
        "Time after which relaxed_displacement replaces rest_displacement, since some piles keep jittering slightly.",
        low=0.0,
        high=3600.0,
    )
    relaxed_displacement: float = setting(
        2e-3, "m", "Relaxed rest threshold after relax_time: displacement in a tick.", above=0.0, high=0.1
    )
    rest_ticks: int = setting(8, "", "Consecutive ticks for which all objects must be at rest.", low=1, high=INT32_MAX)
    restless: float = setting(
        0.0,
        "",
        "Fraction of the objects that may move by more than rest_displacement, though not by more than relaxed_displacement, in a pile at "
        "rest: of 150, a few hardly noticeably do for seconds.",
        low=0.0,
        high=0.5,
    )
    stuck_depth: float = setting(0.01, "m", "An object that penetrates another by more is stuck (released).", above=0.0, high=1.0)
    stuck_time: float = setting(0.4, "s", "An object stuck for this long is dropped again (released).", above=0.0, high=3600.0)
    max_redrops: int = setting(8, "", "Maximum objects dropped again in an arrangement; one with more is resampled.", low=0, high=INT32_MAX)
    tries: int = setting(20, "", "Arrangements tried before an episode is given up.", low=1, high=INT32_MAX)


@dataclass(frozen=True)
class Physics:
    """Rigid-body solver and contacts. Values without a source were measured with Newton 1.8."""

    step: float = setting(2e-3, "s", "Time step (paper).", low=1e-5, high=0.02)
    steps_per_tick: int = setting(
        33, "", "Steps per tick, which is one output frame: 33 steps of 2 ms are 15 Hz (paper).", low=1, high=1000
    )
    gravity: float = setting(9.81, "m/s²", "Gravitational acceleration.", low=0.0, high=100.0)
    substeps: int = setting(
        1,
        "",
        "Solver substeps per step, with collision detection in each; two take twice as long, and piles come to rest a little sooner.",
        low=1,
        high=100,
    )
    iterations: int = setting(16, "", "Projected Gauss-Seidel iterations per solver substep.", low=1, high=1000)
    match_all: bool = setting(
        False,
        "",
        "Warm start every contact from one of the last substep. Newton leaves one of two coincident contacts out, as edges on a face have: "
        "up to half of their load is lost in every substep, and boxes that lie ten deep move five times as fast.",
    )
    sleep: float = setting(
        0.0,
        "m",
        "Island sleeping: displacement in a tick up to which an object is at rest, such as 2e-4; 0: off. Islands of touching objects that "
        "all rest for three ticks are not simulated until one is touched; records lack contact forces of sleeping objects.",
        low=0.0,
        high=0.01,
    )
    friction: float = setting(0.5, "", "Coulomb friction coefficient of every shape.", low=0.0, high=10.0)
    gap: float = setting(4e-3, "m", "Contact margin of a shape: contacts are generated below twice this distance.", low=0.0, high=0.1)
    angular_damping: float = setting(0.05, "1/s", "Angular damping of the objects (PhysX's default).", low=0.0, high=1e3)
    max_speed: float = setting(
        4.0,
        "m/s",
        "Speed limit of the objects: 8 mm per solver substep are no more than the contact margin of two shapes, so nothing tunnels.",
        above=0.0,
        high=100.0,
    )
    contacts_per_world: int = setting(512, "", "Contact capacity per world; about 140 contacts are usual.", low=16, high=INT32_MAX)
    pairs_per_world: int = setting(1024, "", "Broad-phase pair capacity per world.", low=16, high=INT32_MAX)
    rows_per_world: int = setting(1536, "", "Capacity for the objects' contact constraint rows per world.", low=48, high=INT32_MAX)
    gripper_rows_per_world: int = setting(256, "", "Capacity for the gripper's constraint rows per world.", low=48, high=INT32_MAX)
    deterministic: bool = setting(True, "", "On a GPU, sort contact rows, so that a bake can be reproduced bit for bit.")
    guide_height: float = setting(8.0, "m", "Height of the temporary walls on the rim that guide the drop.", above=0.0, high=100.0)

    @property
    def tick_time(self) -> float:
        """Time between two frames [s]."""
        return self.step * self.steps_per_tick


@dataclass(frozen=True)
class Render:
    """Rendering of RGB images: light transport, environment lighting, exposure, tone mapping, layers."""

    mode: str = setting(
        FAST,
        "",
        "Colour renderer: fast (few paths per coarse pixel, denoised), reference (path tracing, slow) or unoccluded "
        "(unoccluded environment light and shadows of one lamp: for small images of many worlds); depth and masks are equal.",
        choices=RENDER_MODES,
    )
    samples: int = setting(64, "", "Mode reference: paths per pixel; powers of two are stratified best.", low=1, high=65536)
    bounces: int = setting(4, "", "Maximum surfaces along a path; 1: direct light only.", low=1, high=64)
    random_yaw: bool = setting(True, "", "Rotate each episode's environment map by a random yaw about the vertical.")
    exposure: float = setting(1.0, "", "Factor on the automatic exposure.", low=0.01, high=100.0)
    exposure_spread: float = setting(
        0.3,
        "EV",
        "Half width of the uniform random exposure offset of each episode; real cameras step by a third of an EV.",
        low=0.0,
        high=5.0,
    )
    coarse_pixel: int = setting(
        0,
        "px",
        "Mode fast: width of a coarse pixel, at whose centre paths start; 0: the widest with 384 per row, 480 with `history`. At full HD "
        "5 px instead of these 4 px take 6 % less time, and PSNR is 0.2 to 0.7 dB lower. Shadow rays are spaced as wide, at most 32 px.",
        low=0,
        high=64,
    )
    coarse_paths: int = setting(
        0,
        "",
        "Mode fast: paths per coarse pixel, best a power of two; 0: 2, or 1 with over 480 per row or where `history` narrows them, "
        "and up to 32 in an episode's first frame with `history`.",
        low=0,
        high=1024,
    )
    history: int = setting(
        32,
        "",
        "Mode fast: paths per coarse pixel that are averaged over the frames of an episode where nothing moves; 0: each frame by itself.",
        low=0,
        high=255,
    )
    lamps: int = setting(
        8,
        "",
        "Maximum number of a map's lamps, small bright lights with shadow rays of their own; mode unoccluded: 1 if it is at least 1.",
        low=0,
        high=8,
    )
    antialias: bool = setting(True, "", "Modes fast and unoccluded: anti-alias the edges of surfaces; mode reference always does.")
    tone: str = setting(
        "shoulder",
        "",
        "Tone curve: shoulder (linear up to 0.6, highlights compressed), linear (clipped at 1) or filmic (ACES, middle grey kept).",
        choices=names(Tone),
    )
    table: bool = setting(True, "", "Render a table under the tote; without it the environment map is the background.")
    table_size: tuple[float, float] = setting(
        (0.0, 0.0),
        "m",
        "Length and width of the table that cameras see, about the world's origin; 0: endless. Light and objects meet an endless one.",
        low=0.0,
        high=20.0,
    )
    table_color: tuple[float, float, float] = setting((0.45, 0.45, 0.44), "sRGB", "Base colour of the table.", low=0.0, high=1.0)
    layers: tuple[str, ...] = setting(
        (), "", "Additional ground-truth layers (AOVs) of each view: any of the allowed names.", choices=LAYERS
    )
    views_per_batch: int = setting(
        0, "", "Views rendered and copied to the host in one batch; 0: chosen by device and resolution.", low=0, high=INT32_MAX
    )


@dataclass(frozen=True)
class Bop:
    """The BOP data set, as folders or shards."""

    split: str = setting("train_pbr", "", "Name of the split's folder; the BOP toolkit reads JPEG only from splits named *_pbr.")
    color_format: str = setting("jpg", "", "File format of RGB images.", choices=("jpg", "png"))
    jpeg_quality: int = setting(95, "", "JPEG quality.", low=1, high=100)
    depth_scale: float = setting(0.1, "mm", "Depth of one count in 16-bit depth images; 0.1 mm reaches 6.5 m.", above=0.0, high=10.0)
    masks: bool = setting(True, "", "Write mask/ (amodal) and mask_visib/ (visible): one file per instance and view.")
    coco: bool = setting(True, "", "Write COCO annotations (scene_gt_coco.json).")
    polygons: bool = setting(
        False,
        "",
        "Segmentation in the format coco: polygons on the borders of pixels, exact, with holes, for tools that read no run lengths.",
    )
    layout: str = setting(
        CLASSIC,
        "",
        "Scene folders: classic (a scene per episode and camera) or multisensor (a scene per episode, with rgb_cam0/, scene_gt_cam0.json "
        "and so on for each camera, as BOP-Industrial 2025); shards are always classic.",
        choices=LAYOUTS,
    )
    rectified: bool = setting(
        False,
        "",
        "Render cameras as pinholes of the same camera matrices, without the distortion of their lenses, in all formats: for readers that "
        "know none. Undistort real pictures to the same matrix.",
    )
    keypoints: int = setting(
        0,
        "",
        "Keypoints of each object in COCO annotations: points of its surface far from each other (8: as PVNet); 0: none.",
        low=0,
        high=64,
    )
    graph: bool = setting(
        False,
        "",
        "Write who lies on whom and who hides whom in each frame: scene_graph.json, with an unstacking order, and support in zarr; and "
        "into models_info.json mass, centre of mass, inertia and suctionable area.",
    )
    target_visibility: float = setting(
        0.1, "", "Minimum visible fraction of an instance listed in test_targets_bop19.json.", low=0.0, high=1.0
    )


@dataclass(frozen=True)
class Trajectory:
    """The zarr store of simulated trajectories."""

    steps: bool = setting(True, "", "Store every physics step; without it every tick only.")
    chunk_ticks: int = setting(16, "ticks", "Chunk length: the unit of compression and reading.", low=1, high=4096)
    shard_chunks: int = setting(64, "chunks", "Chunks per shard, which is one file.", low=1, high=4096)
    level: int = setting(3, "", "Compression level of zstd.", low=1, high=22)


@dataclass(frozen=True)
class Split:
    """A split, such as [splits.train]: a range of the data set's episodes with a mode and a BOP folder of its own.

    Splits share seed and settings, never an episode index, and so no random number.
    """

    name: str = ""
    """Key of its table; no setting of its own."""
    episodes: int = setting(1, "", "Episodes of the split; a finished data set can grow where indices are free.", low=1, high=INT32_MAX)
    first: int = setting(
        -1,
        "",
        "Index of its first episode; -1: the next index after the split before it. A gap leaves room to grow.",
        low=-1,
        high=INT32_MAX,
    )
    mode: str = setting(
        "", "", "Task of the gripper, as bake.mode, which is the default if this is empty.", choices=("", *MODES, MIXED, CYCLE)
    )
    folder: str = setting(
        "", "", "BOP name of the split and of its folder; empty: the split's name, with _pbr if bop.color_format is jpg, as in test_pbr."
    )


@dataclass(frozen=True)
class Config:
    """All settings of a bake, by section."""

    bake: Bake = field(default_factory=Bake)
    objects: Objects = field(default_factory=Objects)
    tote: Tote = field(default_factory=Tote)
    bins: Bins = field(default_factory=Bins)
    gripper: Gripper = field(default_factory=Gripper)
    cameras: Cameras = field(default_factory=Cameras)
    arrangement: Arrangement = field(default_factory=Arrangement)
    settle: Settle = field(default_factory=Settle)
    physics: Physics = field(default_factory=Physics)
    move: Move = field(default_factory=Move)
    pick: Pick = field(default_factory=Pick)
    target: Target = field(default_factory=Target)
    perception: Perception = field(default_factory=Perception)
    suction: Suction = field(default_factory=Suction)
    render: Render = field(default_factory=Render)
    effects: Effects = field(default_factory=Effects)
    depth_sensor: DepthSensor = field(default_factory=DepthSensor)
    randomize: Randomize = field(default_factory=Randomize)
    bop: Bop = field(default_factory=Bop)
    trajectory: Trajectory = field(default_factory=Trajectory)
    picks: Picks = field(default_factory=Picks)
    camera: tuple[CameraRow, ...] = ()
    bin: tuple[BinRow, ...] = ()
    object_rows: tuple[ObjectRow, ...] = ()
    splits: tuple[Split, ...] = ()
    """Resolved splits, by first episode; empty: one split, bop.split, of bake.episodes episodes."""

    @property
    def rig(self) -> Rig:
        """All cameras."""
        return Rig.of(self.cameras, self.camera, self.bop.rectified)

    @property
    def cell(self) -> Cell:
        """What stands under the cameras."""
        return Cell.of(self.tote, self.bins, self.bin)

    def value(self, key: str) -> Any:
        """Value of a setting by its full key, such as "physics.step"."""
        section, _, name = key.partition(".")
        return getattr(getattr(self, section), name)

    def with_values(self, values: Mapping[str, object]) -> Config:
        """Copy with other values of settings, by full key. They are not validated; see `load.override_config`."""
        parts: dict[str, Any] = {}
        for key, value in values.items():
            section, _, name = key.partition(".")
            parts[section] = replace(parts.get(section, getattr(self, section)), **{name: value})
        return replace(self, **parts)
