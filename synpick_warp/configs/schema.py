"""Settings schema of a bake: frozen dataclasses, each field with default, unit, range and meaning. Nothing else has defaults.

The defaults are the paper's values (preset `synpick`); where the paper names none, the help text says where a value comes from.
"Released" means the generator that the paper's authors published. Sections: here, `cameras`, `gripper`, `manipulation`, `objects`,
`picks`, `randomize` and `sensors`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

from synpick_warp.codes import MAX_INSTANCES, Tone, names
from synpick_warp.configs.cell.bins import BinRow, Bins, Cell, PropRow, Tote
from synpick_warp.configs.cell.cameras import CameraRow, Cameras, DepthSensor, Effects, Rig, Still
from synpick_warp.configs.cell.gripper import Gripper, Suction
from synpick_warp.configs.episodes.manipulation import Move, Perception, Pick, Picks, Target
from synpick_warp.configs.episodes.objects import COUNTS, Counts, ObjectRow, Objects, parse_counts
from synpick_warp.configs.episodes.randomize import Randomize
from synpick_warp.configs.fields import INT32_MAX, Color, Fraction, setting
from synpick_warp.system.plugins import plugin_names
from synpick_warp.views.layers import LAYER_TABLE

MODES = ("pick", "target", "move")
"""Tasks of the gripper in an episode."""
MIXED = "mixed"
"""Each episode draws its mode."""
CYCLE = "cycle"
"""Round robin: episode i has the mode MODES[i % 3], so every three episodes in a row have one of each."""
STILL = "still"
"""Mode of all episodes of a data set or of none: one frame of the settled pile."""
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
OWN_FORMATS = ("bop", "shards", "usd", "zarr", "picks", "lerobot", "coco", "yolo", "points")
FORMATS = (*OWN_FORMATS, *plugin_names("formats", OWN_FORMATS))
"""Output formats: of this package, and of others."""


@dataclass(frozen=True)
class Bake:
    """What is simulated, how much of it, where it runs and where inputs come from."""

    mode: str = setting(
        "pick",
        "Task of the gripper: pick (empty the tote), target (dig for the most occluded object), move (stir), mixed (drawn per episode), "
        "cycle (pick, target, move in turn), still (one frame of the settled pile without gripper, see [still]; objects as in mode pick).",
        choices=(*MODES, MIXED, CYCLE, STILL),
    )
    mix: Annotated[tuple[float, float, float], "[0, 1000]"] = setting((1.0, 1.0, 1.0), "Weights of pick, target and move in mode mixed.")
    worlds: Annotated[int, "[0, 65536]"] = setting(
        0, "Worlds simulated in parallel on each device; 0: chosen by episodes, device and memory. A GPU simulates at least 8."
    )
    episodes: Annotated[int, f"[1, {INT32_MAX}]"] = setting(
        4, "Episodes to generate; each becomes one BOP scene per camera. As many as bake.worlds, where only those are set."
    )
    seed: Annotated[int, f"[0, {2**63 - 1}]"] = setting(0, "Seed of all random numbers.")
    device: str = setting("auto", "Device: cpu, cuda:N, or auto (the first GPU if there is one).")
    models: str = setting(
        "", "Folder of BOP models, of PLY, OBJ, glTF, STL and STEP files, or of a folder per object; empty: embedded objects.", path=True
    )
    lights: str = setting("", "Folder of HDR environment maps (.hdr) and sIBL sets; empty: embedded maps.", path=True)
    formats: tuple[str, ...] = setting(
        ("bop",),
        "Output formats: bop (scene folders), shards (webdataset), usd (a stage per episode), zarr (trajectories), picks (grasp trials), "
        "lerobot, coco, yolo, points (PLY clouds).",
        choices=FORMATS,
    )
    writers: Annotated[int, "[0, 1024]"] = setting(
        0, "Processes that write files, for all devices; 0: one per CPU core, if memory suffices."
    )


@dataclass(frozen=True)
class Arrangement:
    """Which objects an episode contains, and how they are dropped into the tote."""

    counts: Annotated[Counts, f"[0, {INT32_MAX}]"] = setting(
        (),
        "Parts, by name or obj_id, with the number, or range of numbers, of each in an episode; empty: objects are drawn up to volume.",
        parse=parse_counts,
        allowed=COUNTS,
    )
    volume: Annotated[float, "(0, 1] m³"] = setting(
        7e-3, "Budget for the total volume of collision shapes of an episode's objects (paper)."
    )
    fill: str = setting(
        EXCEED,
        "How the budget ends the draw: exceed (the object that reaches or exceeds it is the last; released) or within (it is left out). "
        "An object that alone is larger is never drawn.",
        choices=FILLS,
    )
    max_objects: Annotated[int, f"[1, {MAX_INSTANCES}]"] = setting(24, "Maximum objects of an episode.")
    repeat_to_fill: bool = setting(
        True, "Let objects repeat in an episode, as pick.repeats does, where the whole catalog stays below the budget."
    )
    slot_shortfall: Annotated[float, "(0, 0.5]"] = setting(
        1e-3, "Accepted fraction of draws that need more body slots than a world has; they are repeated."
    )
    drop: str = setting(
        COLUMN,
        "Where objects begin to fall: column (one above the other), layers (side by side over the whole opening) or scattered (each at "
        "the lowest of random places).",
        choices=(COLUMN, LAYERED, SCATTERED),
    )
    clearance: Annotated[float, "[0, 1] m"] = setting(
        0.01, "Gap between bounding spheres of objects as they begin to fall; scattered: of cylinders."
    )
    upright: Fraction = setting(0.0, "Fraction of the objects that begin to fall with their z axis upwards, so that most stand.")
    spread: Fraction = setting(
        0.3, "Drop positions are uniform over this fraction of the tote's opening, in layers of a cell, less the object's radius."
    )


@dataclass(frozen=True)
class Settle:
    """When a dropped pile counts as at rest, and which objects are dropped again."""

    min_time: Annotated[float, "[0, 3600] s"] = setting(1.0, "Minimum simulated time from the drop to the first frame.")
    max_time: Annotated[float, "(0, 3600] s"] = setting(10.0, "Time after which a pile that is not at rest is resampled.")
    rest_displacement: Annotated[float, "(0, 0.1] m"] = setting(1e-4, "Largest displacement in a tick of any point of an object at rest.")
    relax_time: Annotated[float, "[0, 3600] s"] = setting(
        4.0, "Time after which relaxed_displacement replaces rest_displacement: some piles keep jittering."
    )
    relaxed_displacement: Annotated[float, "(0, 0.1] m"] = setting(2e-3, "Rest threshold after relax_time: displacement in a tick.")
    rest_ticks: Annotated[int, f"[1, {INT32_MAX}]"] = setting(8, "Consecutive ticks for which all objects must be at rest.")
    restless: Annotated[float, "[0, 0.5]"] = setting(
        0.0, "Fraction of the objects that may move by more than rest_displacement, but not relaxed_displacement, in a pile at rest."
    )
    stuck_depth: Annotated[float, "(0, 1] m"] = setting(0.01, "Penetration above which an object is stuck (released).")
    stuck_time: Annotated[float, "(0, 3600] s"] = setting(0.4, "Time after which a stuck object is dropped again (released).")
    max_redrops: Annotated[int, f"[0, {INT32_MAX}]"] = setting(8, "Maximum objects dropped again before an arrangement is resampled.")
    tries: Annotated[int, f"[1, {INT32_MAX}]"] = setting(20, "Arrangements tried before an episode is given up.")


@dataclass(frozen=True)
class Physics:
    """Rigid-body solver and contacts. Values without a source were measured with Newton 1.8."""

    step: Annotated[float, "[1e-5, 0.02] s"] = setting(2e-3, "Time step (paper).")
    steps_per_tick: Annotated[int, "[1, 1000]"] = setting(33, "Steps per tick, one output frame: 33 steps of 2 ms are 15 Hz (paper).")
    gravity: Annotated[float, "[0, 100] m/s²"] = setting(9.81, "Gravitational acceleration.")
    substeps: Annotated[int, "[1, 100]"] = setting(1, "Solver substeps per step, with collision detection in each; two take twice as long.")
    iterations: Annotated[int, "[1, 1000]"] = setting(16, "Projected Gauss-Seidel iterations per solver substep.")
    match_all: bool = setting(
        False,
        "Warm start every contact. Newton leaves one of two coincident contacts out: boxes that lie ten deep then move five times as fast.",
    )
    sleep: Annotated[float, "[0, 0.01] m"] = setting(
        0.0,
        "Island sleeping: displacement in a tick up to which an object is at rest, such as 2e-4; 0: off. Touching objects that all rest "
        "for three ticks are not simulated until one is touched, and lack contact forces in records.",
    )
    friction: Annotated[float, "[0, 10]"] = setting(0.5, "Coulomb friction coefficient of every shape.")
    gap: Annotated[float, "[0, 0.1] m"] = setting(4e-3, "Fast or thin objects have contacts below twice this, others at rest below 1 mm.")
    angular_damping: Annotated[float, "[0, 1e3] 1/s"] = setting(0.05, "Angular damping of the objects (PhysX's default).")
    max_speed: Annotated[float, "(0, 100] m/s"] = setting(
        4.0, "Speed limit of the objects; above twice the gap per substep they may tunnel."
    )
    contacts_per_world: Annotated[int, f"[16, {INT32_MAX}]"] = setting(512, "Contact capacity per world; about 70 are usual.")
    pairs_per_world: Annotated[int, f"[16, {INT32_MAX}]"] = setting(1024, "Broad-phase pair capacity per world.")
    rows_per_world: Annotated[int, f"[48, {INT32_MAX}]"] = setting(1536, "Capacity for the objects' contact constraint rows per world.")
    gripper_rows_per_world: Annotated[int, f"[48, {INT32_MAX}]"] = setting(256, "Capacity for the gripper's constraint rows per world.")
    deterministic: bool = setting(True, "Sort contact rows on a GPU, so that bakes are equal bit for bit.")
    guide_height: Annotated[float, "(0, 100] m"] = setting(8.0, "Height of temporary walls on the rim that guide the drop.")

    @property
    def tick_time(self) -> float:
        """Time between two frames [s]."""
        return self.step * self.steps_per_tick


@dataclass(frozen=True)
class Render:
    """Rendering: light transport, environment lighting, exposure, tone mapping, layers."""

    mode: str = setting(
        FAST,
        "Colour renderer: fast (few paths per coarse pixel, denoised), reference (path tracing, slow) or unoccluded (unoccluded light and "
        "shadows of one lamp: for small images of many worlds).",
        choices=RENDER_MODES,
    )
    samples: Annotated[int, "[1, 65536]"] = setting(64, "Mode reference: paths per pixel; powers of two are stratified best.")
    bounces: Annotated[int, "[1, 64]"] = setting(4, "Maximum surfaces along a path; 1: direct light only.")
    random_yaw: bool = setting(True, "Rotate each episode's environment map by a random yaw.")
    exposure: Annotated[float, "[0.01, 100]"] = setting(1.0, "Factor on the automatic exposure.")
    exposure_spread: Annotated[float, "[0, 5] EV"] = setting(0.3, "Half width of each episode's random exposure offset.")
    coarse_pixel: Annotated[int, "[0, 64] px"] = setting(
        0,
        "Mode fast: width of a coarse pixel, at whose centre paths start, and spacing of shadow rays, at most 32 px; 0: the widest with "
        "384 per row, 480 with `history`.",
    )
    coarse_paths: Annotated[int, "[0, 1024]"] = setting(
        0,
        "Mode fast: paths per coarse pixel, best a power of two; 0: 2, or 1 with over 480 per row or where `history` narrows them; with "
        "it up to 32 in an episode's first frame.",
    )
    history: Annotated[int, "[0, 255]"] = setting(
        32, "Mode fast: paths per coarse pixel averaged over frames where nothing moves; 0: each frame by itself."
    )
    reuse: bool = setting(
        True,
        "With `history`: keep the tiles of a picture, and the masks, in which nothing changed since the frame before; files are the same.",
    )
    reuse_worlds: Annotated[int, f"[0, {INT32_MAX}]"] = setting(0, "Worlds of which `reuse` keeps tiles; 0: as many as memory permits.")
    lamps: Annotated[int, "[0, 8]"] = setting(
        8, "Maximum lamps of a map, small bright lights with shadow rays of their own; mode unoccluded: at most 1."
    )
    antialias: bool = setting(True, "Anti-alias the edges of surfaces; mode reference always does.")
    shutter_samples: Annotated[int, "[2, 1024]"] = setting(
        8, "Sub-frames, each as costly as a picture, that exposure_time and readout_time average; motion is that since the last frame."
    )
    tone: str = setting(
        "shoulder",
        "Tone curve: shoulder (linear up to 0.6, highlights compressed), linear (clipped at 1) or filmic (ACES, middle grey kept).",
        choices=names(Tone),
    )
    table: bool = setting(True, "Render a table under the tote; without it the environment map is the background.")
    table_size: Annotated[tuple[float, float], "[0, 20] m"] = setting(
        (0.0, 0.0), "Length and width of the table that cameras see, about the origin; 0: endless. Light and objects meet an endless one."
    )
    table_color: Color = setting((0.45, 0.45, 0.44), "Base colour of the table.")
    layers: tuple[str, ...] = setting((), "Additional ground-truth layers (AOVs) of each view.", choices=LAYERS)
    views_per_batch: Annotated[int, f"[0, {INT32_MAX}]"] = setting(0, "Views rendered in one batch; 0: chosen by device and resolution.")


@dataclass(frozen=True)
class Bop:
    """The BOP data set, as folders or shards."""

    split: str = setting("train_pbr", "Folder of the split; the BOP toolkit reads JPEG only from *_pbr.")
    color_format: str = setting("jpg", "File format of RGB images.", choices=("jpg", "png"))
    jpeg_quality: Annotated[int, "[1, 100]"] = setting(95, "JPEG quality.")
    depth_scale: Annotated[float, "(0, 10] mm"] = setting(0.1, "Depth of one count; 0.1 mm reaches 6.5 m.")
    masks: bool = setting(True, "Write mask/ (amodal) and mask_visib/ (visible).")
    coco: bool = setting(True, "Write COCO annotations (scene_gt_coco.json).")
    polygons: bool = setting(False, "Segmentation of the format coco by exact polygons, for tools that read no run lengths.")
    layout: str = setting(
        CLASSIC,
        "Scene folders: classic (a scene per episode and camera) or multisensor (a scene per episode, with rgb_cam0/ and so on, as "
        "BOP-Industrial 2025); shards are always classic.",
        choices=LAYOUTS,
    )
    rectified: bool = setting(
        False, "Render cameras as pinholes of the same matrices, without distortion. Undistort real pictures to the same matrix."
    )
    keypoints: Annotated[int, "[0, 64]"] = setting(
        0, "Keypoints of each object in COCO annotations: farthest points of its surface (8: as PVNet); 0: none."
    )
    graph: bool = setting(
        False,
        "Write who lies on whom and who hides whom (scene_graph.json, support in zarr), and into models_info.json mass, centre of mass, "
        "inertia and suctionable area.",
    )
    target_visibility: Fraction = setting(0.1, "Minimum visible fraction of instances in test_targets_bop19.json.")


@dataclass(frozen=True)
class Trajectory:
    """The zarr store of simulated trajectories."""

    steps: bool = setting(True, "Store every physics step; without it every tick only.")
    chunk_ticks: Annotated[int, "[1, 4096] ticks"] = setting(16, "Chunk length: the unit of compression and reading.")
    shard_chunks: Annotated[int, "[1, 4096] chunks"] = setting(64, "Chunks per shard, which is one file.")
    level: Annotated[int, "[1, 22]"] = setting(3, "Compression level of zstd.")


@dataclass(frozen=True)
class Split:
    """A split, such as [splits.train]: a range of episodes with a mode and a BOP folder of its own. Splits share seed and settings, but no
    random number.
    """

    name: str = ""
    """Key of its table; no setting of its own."""
    episodes: Annotated[int, f"[1, {INT32_MAX}]"] = setting(1, "Episodes of the split; it can grow where indices are free.")
    first: Annotated[int, f"[-1, {INT32_MAX}]"] = setting(
        -1, "Index of its first episode; -1: the next after the split before it. A gap leaves room to grow."
    )
    mode: str = setting("", "As bake.mode; empty: that.", choices=("", *MODES, MIXED, CYCLE, STILL))
    folder: str = setting("", "Folder of the split; empty: its name, with _pbr if bop.color_format is jpg, as in test_pbr.")


@dataclass(frozen=True)
class Config:
    """All settings of a bake, by section."""

    bake: Bake = field(default_factory=Bake)
    objects: Objects = field(default_factory=Objects)
    tote: Tote = field(default_factory=Tote)
    bins: Bins = field(default_factory=Bins)
    gripper: Gripper = field(default_factory=Gripper)
    cameras: Cameras = field(default_factory=Cameras)
    still: Still = field(default_factory=Still)
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
    prop: tuple[PropRow, ...] = ()
    object_rows: tuple[ObjectRow, ...] = ()
    splits: tuple[Split, ...] = ()
    """Resolved splits, by first episode; empty: one split, bop.split, of bake.episodes episodes."""

    @property
    def rig(self) -> Rig:
        """All cameras."""
        stills = STILL in ([split.mode for split in self.splits] or [self.bake.mode])
        return Rig.of(self.cameras, self.camera, self.bop.rectified, self.still if stills else None)

    @property
    def cell(self) -> Cell:
        """What stands under the cameras."""
        return Cell.of(self.tote, self.bins, self.bin)

    def value(self, key: str) -> Any:
        """Value of a setting by its full key, such as "physics.step"."""
        section, _, name = key.partition(".")
        return getattr(getattr(self, section), name)

    def with_values(self, values: Mapping[str, object]) -> "Config":
        """Copy with other values of settings, by full key. They are not validated; see `load.override_config`."""
        parts: dict[str, dict[str, Any]] = {}
        for key, value in values.items():
            section, _, name = key.partition(".")
            parts.setdefault(section, {})[name] = value
        return replace(self, **{section: replace(getattr(self, section), **content) for section, content in parts.items()})
