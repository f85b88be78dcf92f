"""Constants of kernels, grouped into structs by subject; `stages.constants` fills them from settings and catalog."""

import warp as wp

wp.set_module_options({"enable_backward": False})


# Index of the cup's tilt among the gripper's coordinates and degrees of freedom: x, y, z, tilt.
TILT = wp.constant(3)


@wp.struct
class LayoutData:
    """Sizes and offsets of one world in the model's flat arrays; see `scenes.build.Layout`. A body slot is a body that can become any
    object of its class: single (one convex piece) or compound (several).
    """

    instances: int
    """Capacity for objects of an episode."""
    single_slots: int
    """Number of single slots, which come before the compound ones."""
    slots: int
    """Number of body slots of both classes."""
    gripper_bodies: int
    """Bodies of the gripper, which precede the slots: shaft and cup."""
    gripper_dofs: int
    """Degrees of freedom of the gripper: x, y, z, tilt."""
    bodies: int
    coords: int
    """Joint coordinates of a world: the gripper's, then 7 a slot."""
    dofs: int
    """Degrees of freedom of a world: the gripper's, then 6 a slot."""
    shapes: int
    finger_shape: int
    """Index of the shape of the finger, which is the gripper's shaft, in its world."""


@wp.struct
class CatalogData:
    """Catalog of objects, an element per object, and what empty body slots are. A variant is the index of the body that a slot becomes:
    those of a class are its objects in catalog order, then the empty one.
    """

    count: int
    """Objects in the catalog that have labels; they come first."""
    distractors: int
    """Objects behind them, without labels."""
    volume: wp.array[float]
    """Volume of the collision shape [m³]."""
    radius: wp.array[float]
    """Radius of the bounding sphere about the origin [m]."""
    mass: wp.array[float]
    """Mass [kg]."""
    area: wp.array[float]
    """Product of the two larger side lengths of the mesh's bounding box [m²]."""
    diagonal: wp.array[float]
    """Diagonal of that box [m]."""
    compound: wp.array[int]
    """1: several convex pieces, in a compound slot; 0: one, in a single slot."""
    least: wp.array[int]
    """Least number of the object in an episode, where numbers are set ..."""
    most: wp.array[int]
    """... and largest number; all 0: objects are drawn up to the volume budget."""
    counted: int
    """Largest number of an episode's objects where numbers are set; 0: they are not."""
    variant: wp.array[int]
    """Variant of the object, in slots of its class (single or compound)."""
    empty_single: int
    empty_compound: int
    empty_mass: float
    """Mass of an empty slot's body [kg]."""


@wp.struct
class DropData:
    """Volume budget, heights and clearances of the drop, and the distribution of the light; see `configs.schema`."""

    objects: int
    """Maximum number of an episode's objects with labels."""
    volume: float
    """Budget for the total volume of an episode's objects [m³]."""
    exceed: int
    """1: sampling ends with the object that reaches or exceeds the budget, which is kept; 0: before one that exceeds it."""
    move_repeats: int
    """1: an object may occur several times in mode MOVE."""
    pick_repeats: int
    """The same for the picking modes."""
    clearance: float
    """Gap between bounding spheres in the drop column, or between layers and within them [m]."""
    spread: float
    """Fraction of the opening of a compartment, or in layers of a cell, less the bounding radius, over which drop positions spread."""
    layers: int
    """1: objects begin to fall from layers of cells; 0: from a column."""
    gravity: float
    """Gravitational acceleration [m/s²]."""
    gripper_home: wp.vec3
    """Wrist position while the gripper waits [m]."""
    lights: int
    random_yaw: int
    """1: sample the yaw of environment maps."""
    exposure_spread: float
    """Half-width of the sampled exposure range [EV]."""


@wp.struct
class BinData:
    """Bins from which an episode draws its own, where it is placed, and their collision shapes. Lengths are in a bin's frame: origin at the
    centre of the inner floor, z up. A bin without dividers is one compartment.
    """

    count: int
    visible: int
    """1: bins are rendered; 0: there is a table alone."""
    share: wp.array[float]
    """(bin): share of the episodes that have this bin or one before it."""
    origin: wp.array[wp.vec3]
    """(bin): origin of the bin's frame in the world, without offset, where it stands on the table [m]."""
    shift: wp.vec2
    """Half widths of the uniform distribution of the bin's offset in x and y [m]."""
    turn: wp.array[float]
    """(bin): angle about z of the bin's frame in the world, without rotation [rad]."""
    yaw: float
    """Half width of the rotation about z [rad]."""
    reach: wp.array[wp.vec2]
    """(bin): half length and width beyond which an object lies beside the bin [m]."""
    rim_height: wp.array[float]
    """(bin): height of the rim, over which objects are dropped [m]."""
    wall_height: wp.array[float]
    """(bin): height below which an object beside the bin is outside [m]."""
    limit: wp.array3d[float]
    """(bin, column, row): height below which an object's origin is outside, of bins with pitch [m]."""
    pitch: wp.array[wp.vec2]
    """(bin): sides of a cell of `limit`, whose middle is the origin [m]; 0: the bin's inside is a box."""
    first_compartment: wp.array[int]
    """(bin + 1): index of the bin's first compartment; the last entry is their number."""
    center: wp.array[wp.vec2]
    """(compartment): centre of the opening [m]."""
    half: wp.array[wp.vec2]
    """(compartment): half length and width of the opening [m]."""
    waypoint: wp.array2d[wp.vec3]
    """(compartment, corner): TCP near the corners of the floor; bits 0 and 1 of the corner: at negative x, at negative y [m]."""
    chosen: wp.array[int]
    """(world): bin of the world's episode."""
    pose: wp.array[wp.transform]
    """(world): its pose in the world [m]."""
    shape: wp.array[int]
    """(part): index of a collision shape of a bin, or of a guide wall on its rim, among a world's shapes."""
    shape_bin: wp.array[int]
    """(part): the bin that it belongs to."""
    shape_guide: wp.array[int]
    """(part): 1: a guide wall."""


@wp.struct
class SettleData:
    """Rest of dropped objects, and re-drops of stuck ones; see `configs.schema.Settle`."""

    min_ticks: int
    """Shortest time from drop to rest [ticks]."""
    max_ticks: int
    """Longest [ticks]."""
    rest_ticks: int
    """Consecutive ticks at rest that are needed."""
    stuck_ticks: int
    """Time in deep penetration after which an object is dropped again [ticks]."""
    late_ticks: int
    """Time from which the relaxed threshold applies [ticks]."""
    rest_threshold: float
    """Largest displacement of an object at rest in a tick [m]."""
    relaxed_rest_threshold: float
    """The same from `late_ticks` on [m]."""
    stuck_depth: float
    """Penetration from which an object counts as stuck [m]."""
    max_redrops: int
    """Re-drops after which an arrangement is resampled."""


@wp.struct
class ModeData:
    """Distribution of a split's episodes over the modes: independent samples, or a round robin."""

    first: int
    """Index of the split's first episode."""
    pick_share: float
    """Probability of PICK."""
    pick_or_target_share: float
    """Probability of PICK or TARGET."""
    cycle: int
    """Period of a round robin [episodes], in which evenly spaced numbers, instead of random ones, choose the modes; 0: random."""
    still: int
    """1: all episodes are STILL."""


@wp.struct
class MoveData:
    """Waypoints, speed and impedance of mode MOVE; mass, gravity, step and TCP offset serve the picking modes, too."""

    stiffness: float
    """Stiffness [N/m]."""
    damping: float
    """Damping [N·s/m]."""
    force: float
    """Largest force of the impedance control [N]."""
    speed: float
    """Speed of the setpoint [m/s]."""
    start_height: float
    """Height of the TCP above the floor in the first frame, over the first corner [m]."""
    waypoints: int
    """Number of corners to visit, repeats included."""
    mass: float
    """Mass of shaft and cup [kg]."""
    gravity: float
    """Gravitational acceleration [m/s²]."""
    step: float
    """Time step [s]."""
    tcp_offset: float
    """Distance from wrist axis to TCP [m]."""


@wp.struct
class PickData:
    """Speeds, distances, tasks and impedance of the picking modes; see `configs.schema.Pick`."""

    stiffness: float
    """Stiffness [N/m]."""
    damping: float
    """Damping [N·s/m]."""
    force: float
    """Largest force of the impedance control [N]."""
    appear_height: float
    """Height above the grasp at which the gripper appears [m]."""
    speed: float
    """Speed of the setpoint in APPROACH [m/s]."""
    near: float
    """Distance before the grasp point at which APPROACH ends [m]."""
    near_speed: float
    """Speed of the setpoint in DESCEND [m/s]."""
    press_steps: int
    """Duration of PRESS [steps]."""
    lift_height: float
    """Height of the lift [m]."""
    lift_speed: float
    """Speed of the setpoint in LIFT [m/s]."""
    failures: int
    """Number of failed attempts that ends an episode; not only those in a row, but see `forgive`."""
    floor: float
    """Height below which an object is lost [m]."""
    tilt_limit: float
    """Largest tilt of the cup [rad]."""
    forgive: int
    """Bit m: a success in mode m (`Mode`) resets the count of failures."""
    random_after_failure: int
    """1: after a failure in mode TARGET the next target is sampled at random."""


@wp.struct
class PerceptionData:
    """Thresholds, weights and windows of grasp points, occlusion votes and the clutter graph, named as in configs.schema.Perception.

    Where a neighbour's surface across the contour is nearer to the camera, it casts a vote that it lies above.
    """

    center_fraction: float
    """The suction point is the centroid, or its midpoint with the mask's innermost point (pole), if that is farther from the contour
    than this fraction of the pole's distance; else the pole."""
    heavy_mass: float
    """Mass above which an object is grasped nearer to its centroid [kg]."""
    heavy_center_fraction: float
    """`center_fraction` of heavy objects."""
    contour_offset: float
    """Distance from the contour, inside and outside, at which the depths of neighbours are compared [px]."""
    deep_distance: float
    """Depth below the suction point from which a neighbour's votes are down-weighted [m]."""
    deep_weight: float
    """Weight of those votes."""
    min_votes: float
    """Minimum occlusion votes for an edge of the clutter graph."""
    reach: float
    """A neighbour votes only if its contour stays this near to the compared pixel [diagonals of its own 3-D bounding box]."""
    exact_cycle: int
    """Maximum size of a cycle that is broken at minimum cost."""
    normal_window: int
    """Half width of the window over which the surface normal is averaged [px]."""


@wp.struct
class SuctionData:
    """Geometry of a cup's rays, and stiffness, damping, masses and break forces of the seals; see `configs.schema.Suction`."""

    rays: int
    """Rays on the ring."""
    radius: float
    """Radius of the ring [m]."""
    reach: float
    """Length of the rays [m]."""
    tolerated_misses: int
    """Rays of a good seal that may miss."""
    good_force: float
    """Break force of a good seal [N]."""
    poor_force: float
    """Break force of any other seal [N]."""
    stiffness: float
    """Stiffness [N/m]."""
    damping: float
    """Damping [N·s/m]."""
    twist_stiffness: float
    """Stiffness against twist [N·m/rad]."""
    twist_damping: float
    """Damping of twist and swing [N·m·s/rad]."""
    swing_limit: float
    """Angle of free swing [rad]."""
    swing_stiffness: float
    """Stiffness beyond it [N·m/rad]."""
    tcp_offset: float
    """Distance from wrist axis to TCP [m]."""
    finger_mass: float
    """Mass of the gripper shaft [kg]."""
    cup_mass: float
    """Mass of the gripper head [kg]."""
    tilt_inertia: float
    """Effective inertia about the wrist axis in one step: armature + step · damping + step² · stiffness of the implicit drive [kg·m²]."""
    step: float
    """Time step [s]."""


@wp.struct
class CupData:
    """Cups of the gripper head.

    Apart from `SuctionData`: a struct with an array is read from memory where it is used, which changes what the compiler fuses there.
    """

    count: int
    place: wp.array[wp.vec3]
    """(cup): centre of the lip, in the frame of the gripper head, whose origin is on the wrist axis [m]."""
    common_valve: int
    """1: all cups share one vacuum, which a leak at one spoils; 0: a valve each."""
