"""Every setting of a bake: frozen, complete, with unit, range and meaning. Nothing else in the project has defaults.

The defaults are the numbers of the paper (the preset `synpick`); where the paper is silent, the docstring says where a
number comes from. "Released" means the generator that the paper's authors published.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from synpick_warp.codes import Tone, names
from synpick_warp.configs.fields import setting
from synpick_warp.configs.sensors import DepthSensor, Effects
from synpick_warp.layers import LAYER_TABLE

MODES = ("pick", "target", "move")
"""What the gripper does in an episode."""
MIXED = "mixed"
"""Every episode draws its mode."""


FAST = "fast"
REFERENCE = "reference"
RENDER_MODES = (FAST, REFERENCE)
"""How colour is made."""
LAYERS = tuple(LAYER_TABLE)
"""Annotation layers that a view can have besides colour, depth and masks; see `synpick_warp.layers`."""


FORMATS = ("bop", "shards", "usd", "zarr")
"""What a bake can write."""


@dataclass(frozen=True)
class Bake:
    """What to make, and where."""

    mode: str = setting(
        "pick",
        "",
        "pick: empty the tote; target: dig for what lies lowest; move: stir; mixed: drawn for each episode.",
        choices=(*MODES, MIXED),
    )
    mix: tuple[float, float, float] = setting((1.0, 1.0, 1.0), "", "With mode mixed: weights of pick, target and move.", low=0.0, high=1000)
    worlds: int = setting(4, "", "Totes simulated side by side; a GPU has at least 8.", low=1, high=65536)
    episodes: int = setting(4, "", "Sequences to make; each becomes one BOP scene a camera.", low=1)
    seed: int = setting(0, "", "Every random draw follows from it.", low=0, high=2**63 - 1)
    device: str = setting("auto", "", "cpu, cuda:N, or auto: the first GPU if there is one.")
    models: str = setting("", "", "Folder of BOP models, or of OBJ/GLB/PLY meshes; empty: the embedded objects.")
    lights: str = setting("", "", "Folder of .hdr maps and sIBL sets; empty: the embedded skies.")
    formats: tuple[str, ...] = setting(
        ("bop",), "", "bop: BOP, a folder a scene; shards: BOP as webdataset; usd: one scene an episode; zarr: physics.", choices=FORMATS
    )
    writers: int = setting(0, "", "Processes that write files; 0: one a processor core.", low=0, high=1024)


@dataclass(frozen=True)
class Objects:
    """How a mesh becomes a body."""

    hull_vertices: int = setting(64, "", "Most vertices of a convex hull; 64 keep 94.5 to 99.5 % of the volume.", low=8, high=256)
    piece_vertices: int = setting(32, "", "Most vertices of one piece of a convex decomposition.", low=8, high=256)
    pieces: int = setting(16, "", "Most pieces of a convex decomposition.", low=1, high=64)
    concavity: float = setting(0.05, "", "CoACD's threshold: smaller follows the surface more closely.", low=0.01, high=1.0)
    concave_ratio: float = setting(
        0.6, "", "Objects without a row in the object table are concave if mesh volume / hull volume is below this.", low=0.0, high=1.0
    )
    density: float = setting(400.0, "kg/m³", "Density over the hull's volume, for objects without a mass.", above=0.0)
    metallic: float = setting(0.1, "", "Metallic, for objects without a material of their own.", low=0.0, high=1.0)
    roughness: float = setting(0.5, "", "Roughness, for objects without a material of their own.", low=0.0, high=1.0)
    diameter_tolerance: float = setting(
        0.1, "", "A row of the object table is used only for a model whose diameter differs by less than this share.", above=0.0, high=1.0
    )


@dataclass(frozen=True)
class ObjectRow:
    """One row of the object table: what a model folder does not say."""

    id: int = setting(0, "", "The model's obj_id.", low=0)
    name: str = setting("", "", "Name, for people.")
    diameter: float = setting(0.0, "m", "Diameter by which the model is recognised.", low=0.0)
    mass: float = setting(0.1, "kg", "Mass.", above=0.0)
    concave: bool = setting(False, "", "Decompose into convex pieces instead of taking the hull.")
    metallic: float = setting(0.1, "", "Metallic.", low=0.0, high=1.0)
    roughness: float = setting(0.5, "", "Roughness.", low=0.0, high=1.0)


@dataclass(frozen=True)
class Tote:
    """The box. Its origin is the centre of the inner floor, z up. Measures of the released mesh."""

    outer_size: tuple[float, float, float] = setting((0.615, 0.373, 0.200), "m", "Outer length, width and height.", above=0.0)
    floor_size: tuple[float, float] = setting((0.513, 0.319), "m", "Inner floor.", above=0.0)
    rim_size: tuple[float, float] = setting((0.545, 0.352), "m", "Inner opening at the rim.", above=0.0)
    wall: float = setting(0.0045, "m", "Thickness of walls and floor.", above=0.0)
    color: tuple[float, float, float] = setting((0.65, 0.05, 0.04), "sRGB", "Base colour.", low=0.0, high=1.0)
    metallic: float = setting(0.0, "", "Metallic.", low=0.0, high=1.0)
    roughness: float = setting(0.5, "", "Roughness.", low=0.0, high=1.0)


@dataclass(frozen=True)
class Gripper:
    """A cone-shaped finger that moves in x, y and z, and a suction cup that tilts about the y axis."""

    finger_length: float = setting(0.35, "m", "Length of the finger, from its top to the tilt axis.", above=0.0)
    finger_width: float = setting(0.075, "m", "Width of the finger at its top.", above=0.0)
    cup_width: float = setting(0.042, "m", "Diameter of the suction cup.", above=0.0)
    cup_length: float = setting(0.055, "m", "From the tilt axis to the tip of the cup.", above=0.0)
    finger_mass: float = setting(1.5, "kg", "Mass of the finger.", above=0.0)
    cup_mass: float = setting(0.5, "kg", "Mass of the cup.", above=0.0)
    tilt_limit: float = setting(90.0, "°", "Largest tilt of the cup.", above=0.0, high=90.0)
    tilt_stiffness: float = setting(2500.0, "N·m/rad", "Stiffness of the tilt drive.", above=0.0)
    tilt_damping: float = setting(200.0, "N·m·s/rad", "Damping of the tilt drive.", low=0.0)
    tilt_torque: float = setting(200.0, "N·m", "Limit of the tilt drive.", above=0.0)
    color: tuple[float, float, float] = setting((0.55, 0.56, 0.58), "sRGB", "Base colour of the finger.", low=0.0, high=1.0)
    cup_color: tuple[float, float, float] = setting((0.05, 0.05, 0.055), "sRGB", "Base colour of the cup.", low=0.0, high=1.0)
    metallic: float = setting(0.01, "", "Metallic (released).", low=0.0, high=1.0)
    roughness: float = setting(0.9, "", "Roughness (released).", low=0.0, high=1.0)


@dataclass(frozen=True)
class Cameras:
    """Three cameras above the tote: pinhole, pixel centres at +0.5, principal point in the middle."""

    resolution: tuple[int, int] = setting((1920, 1080), "px", "Width and height.", low=1, high=8192)
    fov: float = setting(20.0, "°", "Horizontal field of view.", low=1.0, high=170.0)
    positions: tuple[tuple[float, float, float], ...] = setting(
        ((0.0, 0.0, 2.0), (0.0, 0.573, 2.0), (0.0, -0.573, 2.0)), "m", "Where the cameras stand (released)."
    )
    target: tuple[float, float, float] = setting((0.0, 0.0, 0.16), "m", "What all cameras look at (released).")
    ups: tuple[tuple[float, float, float], ...] = setting(
        ((0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0)), "", "Direction of the image's upper edge: +y, then the tote's centre line."
    )


@dataclass(frozen=True)
class Arrangement:
    """Which objects an episode has, and how they are dropped."""

    volume: float = setting(7e-3, "m³", "Objects are drawn while their collision shapes' total stays within this.", above=0.0)
    max_objects: int = setting(24, "", "Most objects of an episode; the draw stops there.", low=1, high=32)
    slot_shortfall: float = setting(
        1e-3, "", "Accepted share of draws that need more slots than a world has; they are repeated, and counted.", above=0.0, high=0.5
    )
    clearance: float = setting(0.01, "m", "Gap between bounding spheres in the drop column.", low=0.0)
    spread: float = setting(0.3, "", "Drop positions are spread over this share of the free floor.", low=0.0, high=1.0)


@dataclass(frozen=True)
class Settle:
    """When a pile counts as at rest, and what is dropped again."""

    min_time: float = setting(1.0, "s", "Shortest time from the drop to the first frame.", low=0.0)
    max_time: float = setting(10.0, "s", "A world that has not settled by then draws its arrangement again.", above=0.0)
    rest_shift: float = setting(1e-4, "m", "An object rests if no point of it moves by more in a tick.", above=0.0)
    late_time: float = setting(4.0, "s", "From then on, a pile that still buzzes a little may rest as well.", low=0.0)
    last_shift: float = setting(2e-3, "m", "What counts as rest from then on.", above=0.0)
    rest_ticks: int = setting(8, "", "All objects must rest for this many ticks in a row.", low=1)
    stuck_depth: float = setting(0.01, "m", "An object that penetrates another by more is stuck (released).", above=0.0)
    stuck_time: float = setting(0.4, "s", "A stuck object is dropped again after this time (released).", above=0.0)
    max_redrops: int = setting(8, "", "An arrangement with more re-drops is drawn again.", low=0)
    tries: int = setting(20, "", "Arrangements tried before an episode is given up.", low=1)


@dataclass(frozen=True)
class Physics:
    """Solver and contact. Values measured with Newton 1.8; see the README."""

    step: float = setting(2e-3, "s", "Time step (paper).", above=0.0, high=0.02)
    steps_per_tick: int = setting(33, "", "Steps between two frames: 15 Hz (paper).", low=1, high=1000)
    gravity: float = setting(9.81, "m/s²", "Gravity.", low=0.0)
    substeps: int = setting(2, "", "Solver steps in a step: two of 12 iterations calm a pile more than one of 48.", low=1, high=100)
    iterations: int = setting(16, "", "Projected Gauss-Seidel iterations a solver step.", low=1, high=1000)
    friction: float = setting(0.5, "", "Coulomb friction of every shape.", low=0.0, high=10.0)
    gap: float = setting(2e-3, "m", "Half the distance at which contacts are made; 5 mm costs a third more and settles no better.", low=0.0)
    angular_damping: float = setting(0.05, "1/s", "Angular damping of the objects (PhysX's default).", low=0.0)
    max_speed: float = setting(
        4.0, "m/s", "No object is faster: 4 mm a solver step are no more than two shapes' gap, so none passes a surface.", above=0.0
    )
    contacts_per_world: int = setting(512, "", "Room for contacts in a world; about 140 are usual.", low=16)
    pairs_per_world: int = setting(1024, "", "Room for pairs of near shapes in a world.", low=16)
    rows_per_world: int = setting(1536, "", "Room for the objects' contact rows in a world.", low=48)
    gripper_rows_per_world: int = setting(256, "", "Room for the gripper's constraint rows in a world.", low=48)
    deterministic: bool = setting(True, "", "On a GPU, rows of contacts have a fixed order, so that a bake can be repeated bit by bit.")
    guide_height: float = setting(8.0, "m", "Height of the walls that guide the drop and vanish afterwards.", above=0.0)


@dataclass(frozen=True)
class Move:
    """Moving: the gripper, with locked rotation, visits the corners of the tote and stirs the pile."""

    stiffness: float = setting(1000.0, "N/m", "Stiffness of the position controller (paper).", above=0.0)
    damping: float = setting(
        60.0, "N·s/m", "Damping of the position controller; the paper names none. With the released 1, objects sink in by 7 mm.", low=0.0
    )
    force: float = setting(30.0, "N", "Largest force of the position controller (paper).", above=0.0)
    speed: float = setting(0.1, "m/s", "Speed of the goal (paper).", above=0.0)
    corner: float = setting(0.75, "", "Corners lie at this share of half the inner floor (released).", above=0.0, high=1.0)
    height: float = setting(0.02, "m", "Height of the cup's tip above the floor at a corner (released).", low=0.0)
    start_height: float = setting(0.35, "m", "Height of the cup's tip above the first corner at the first frame.", above=0.0)
    rounds: int = setting(2, "", "How often all four corners are visited (released: eight corners, with replacement).", low=1)
    repeats: bool = setting(True, "", "An object may come several times in a tote (paper).")


@dataclass(frozen=True)
class Pick:
    """Picking: look, approach, suck, lift, until the tote is empty or too many attempts have failed."""

    stiffness: float = setting(2500.0, "N/m", "Stiffness of the position controller (paper).", above=0.0)
    damping: float = setting(200.0, "N·s/m", "Damping of the position controller (paper).", low=0.0)
    force: float = setting(200.0, "N", "Largest force of the position controller (paper).", above=0.0)
    appear_height: float = setting(1.0, "m", "The gripper appears so far above the grasp (released).", above=0.0)
    speed: float = setting(1.0, "m/s", "Speed of the goal far from the grasp point (released).", above=0.0)
    near: float = setting(0.05, "m", "So near to the grasp point the goal is slow and moves along the normal (released).", low=0.0)
    near_speed: float = setting(0.1, "m/s", "Speed of the goal from there (released).", above=0.0)
    press_time: float = setting(0.1, "s", "The goal rests at the grasp point, so that the cup, which lags, touches.", low=0.0)
    lift_height: float = setting(1.0, "m", "How far the goal is lifted (released).", above=0.0)
    lift_speed: float = setting(0.5, "m/s", "Speed of the goal then (released).", above=0.0)
    failures: int = setting(3, "", "So many failed attempts end the episode (released: four).", low=1)
    floor: float = setting(-0.1, "m", "An object that falls lower leaves the scene (released).", high=0.0)
    repeats: bool = setting(False, "", "An object may come several times in a tote (paper: no).")


@dataclass(frozen=True)
class Target:
    """Targeted picking: as picking, but for the object that is occluded most.

    The paper does not name these two rules of the released generator, but its 687 frames a sequence need them: with both we have 611,
    without the second 449, with neither 389.
    """

    forgive: bool = setting(True, "", "A success sets the count of failed attempts back to zero (released).")
    random_after_failure: bool = setting(True, "", "After a failed attempt the next target is drawn at random (released).")


@dataclass(frozen=True)
class Sight:
    """How the gripper's side sees: an image of camera 0 without the gripper, and the rules by which it chooses."""

    resolution: tuple[int, int] = setting(
        (1920, 1080),
        "px",
        "Width and height of the image; its field of view is cameras.fov across the width, so a flatter one sees less.",
        low=16,
        high=8192,
    )
    views: int = setting(0, "", "Images worked on at once; 0: chosen by device and resolution.", low=0)
    contour_points: int = setting(8192, "", "Room for the points of one contour; more end the episode.", low=16)
    center_share: float = setting(
        0.8, "", "Centroid, or the point half-way to it, is taken if its distance to the contour exceeds this share of the pole's.", low=0.0
    )
    heavy_mass: float = setting(0.8, "kg", "Heavier objects are gripped nearer to their centroid.", low=0.0)
    heavy_center_share: float = setting(0.4, "", "As center_share, for heavy objects.", low=0.0)
    contour_offset: float = setting(3.0, "px", "Neighbours are compared so far inside and outside of the contour.", above=0.0)
    deep_distance: float = setting(0.02, "m", "A neighbour lower than the suction point by more has little weight.", low=0.0)
    deep_weight: float = setting(0.1, "", "That weight.", low=0.0, high=1.0)
    min_votes: float = setting(5.0, "", "Votes that make an edge of the clutter graph.", above=0.0)
    reach: float = setting(
        1.2, "", "A neighbour gets no vote where its contour reaches farther from the compared pixel than this many diagonals.", above=0.0
    )
    exact_cycle: int = setting(10, "", "Cycles of at most so many objects are broken at least cost; larger ones greedily.", low=2, high=12)
    normal_window: int = setting(10, "px", "The normal is averaged so far to each side of the suction point.", low=0, high=256)


@dataclass(frozen=True)
class Suction:
    """The suction cup: which objects it catches, and what holds them."""

    rays: int = setting(10, "", "Rays on a circle at the cup's tip (paper).", low=3, high=64)
    radius: float = setting(0.01, "m", "Radius of that circle (released).", above=0.0)
    reach: float = setting(0.03, "m", "Length of the rays (paper).", above=0.0)
    surface: str = setting(
        "hull",
        "",
        "What the rays hit: collision hulls, on which the cup rests, or the visual mesh, where an open pitcher is open.",
        choices=("hull", "mesh"),
    )
    tolerated_misses: int = setting(0, "", "A seal is good if no more rays miss (paper: 0; released: 2).", low=0)
    good_force: float = setting(40.0, "N", "Break force of a good seal (paper).", above=0.0)
    poor_force: float = setting(2.0, "N", "Break force of any other (paper; released: 0.2).", above=0.0)
    stiffness: float = setting(2e4, "N/m", "Stiffness of a seal: 40 N stretch it by 2 mm, within the paper's 5 mm.", above=0.0)
    damping: float = setting(100.0, "N·s/m", "Damping of a seal.", low=0.0)
    twist_stiffness: float = setting(50.0, "N·m/rad", "Stiffness against twist about the cup's axis.", low=0.0)
    twist_damping: float = setting(0.1, "N·m·s/rad", "Damping of twist and swing.", low=0.0)
    swing_limit: float = setting(5.0, "°", "An object swings freely so far (released).", low=0.0, high=90.0)
    swing_stiffness: float = setting(
        50.0, "N·m/rad", "Stiffness against swing beyond that; with 10, what weighs 1.1 kg and hangs by its end swings by 18°.", low=0.0
    )


@dataclass(frozen=True)
class Render:
    """Light and picture."""

    mode: str = setting(
        FAST, "", "fast: few paths and a filter; reference: many paths, slow. Depth, masks and boxes are the same.", choices=RENDER_MODES
    )
    samples: int = setting(64, "", "Paths a pixel with mode reference; powers of two are spread most evenly.", low=1, high=65536)
    bounces: int = setting(4, "", "Most surfaces that a path meets; 1: direct light alone.", low=1, high=64)
    turn_lights: bool = setting(True, "", "Turn each episode's light map by a random angle about the vertical.")
    exposure: float = setting(1.0, "", "Factor on the automatic exposure.", above=0.0)
    exposure_spread: float = setting(
        0.3, "stops", "Each episode's exposure is off by up to so much, evenly: cameras step by a third of a stop.", low=0.0, high=5.0
    )
    cell: int = setting(
        0, "px", "With mode fast: paths start from the middles of cells so wide; 0: as many as leave at least 384 across.", low=0, high=64
    )
    cell_paths: int = setting(
        0,
        "",
        "With mode fast: paths a cell; powers of two are spread most evenly; 0: 2, or 1 if more than 480 cells lie across.",
        low=0,
        high=1024,
    )
    antialias: bool = setting(True, "", "With mode fast: a pixel where surfaces meet mixes their colours; reference always does.")
    tone: str = setting(
        "shoulder",
        "",
        "shoulder: linear up to 0.6, highlights compressed; linear: cut off at 1; filmic: ACES' curve, middle grey kept.",
        choices=names(Tone),
    )
    table: bool = setting(True, "", "A table under the tote; without it the light map shows.")
    table_color: tuple[float, float, float] = setting((0.45, 0.45, 0.44), "sRGB", "Base colour of the table.", low=0.0, high=1.0)
    layers: tuple[str, ...] = setting((), "", "What each view has besides colour, depth and masks: a list of these.", choices=LAYERS)
    views_per_batch: int = setting(0, "", "Views rendered and copied at once; 0: chosen by device and resolution.", low=0)


@dataclass(frozen=True)
class Bop:
    """The BOP data set."""

    split: str = setting("train_pbr", "", "Name of the split's folder; the toolkit reads JPEG only from *_pbr.")
    color_format: str = setting("jpg", "", "Format of colour images.", choices=("jpg", "png"))
    jpeg_quality: int = setting(95, "", "JPEG quality.", low=1, high=100)
    depth_scale: float = setting(0.1, "mm", "Depth of one count in a depth image; 0.1 reaches 6.5 m.", above=0.0)
    masks: bool = setting(True, "", "Write mask/ and mask_visib/: one file an instance and view.")
    coco: bool = setting(True, "", "Write scene_gt_coco.json.")
    target_visibility: float = setting(0.1, "", "Least visible share of an instance in test_targets_bop19.json.", low=0.0, high=1.0)


@dataclass(frozen=True)
class Trajectory:
    """The zarr store of physics."""

    steps: bool = setting(True, "", "Write what happens in every step; without it, in every tick alone.")
    chunk_ticks: int = setting(16, "ticks", "What is compressed, and read, at once.", low=1, high=4096)
    shard_chunks: int = setting(64, "chunks", "Chunks in a file.", low=1, high=4096)
    level: int = setting(3, "", "Level of zstd.", low=1, high=22)


@dataclass(frozen=True)
class Config:
    """All settings of a bake."""

    bake: Bake = field(default_factory=Bake)
    objects: Objects = field(default_factory=Objects)
    tote: Tote = field(default_factory=Tote)
    gripper: Gripper = field(default_factory=Gripper)
    cameras: Cameras = field(default_factory=Cameras)
    arrangement: Arrangement = field(default_factory=Arrangement)
    settle: Settle = field(default_factory=Settle)
    physics: Physics = field(default_factory=Physics)
    move: Move = field(default_factory=Move)
    pick: Pick = field(default_factory=Pick)
    target: Target = field(default_factory=Target)
    sight: Sight = field(default_factory=Sight)
    suction: Suction = field(default_factory=Suction)
    render: Render = field(default_factory=Render)
    effects: Effects = field(default_factory=Effects)
    depth_sensor: DepthSensor = field(default_factory=DepthSensor)
    bop: Bop = field(default_factory=Bop)
    trajectory: Trajectory = field(default_factory=Trajectory)
    object_rows: tuple[ObjectRow, ...] = ()
