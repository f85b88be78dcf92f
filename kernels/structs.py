"""Constants that several kernels share, in groups, so that a kernel's parameters stay readable."""

import warp as wp

wp.set_module_options({"enable_backward": False})


# The cup's tilt among the gripper's coordinates and degrees of freedom: x, y, z, tilt.
TILT = wp.constant(3)


@wp.struct
class LayoutData:
    """Where a world's things lie in the model's arrays; see scenes.build.Layout."""

    instances: int
    single_slots: int
    slots: int
    gripper_bodies: int
    gripper_dofs: int
    bodies: int
    coords: int
    dofs: int
    shapes: int
    finger_shape: int
    cup_shape: int


@wp.struct
class CatalogData:
    """What the simulation knows of each catalog entry: `area` is the product of the two larger extents of its mesh's box [m²]."""

    count: int
    volume: wp.array[float]
    radius: wp.array[float]
    mass: wp.array[float]
    area: wp.array[float]
    diagonal: wp.array[float]
    compound: wp.array[int]
    variant: wp.array[int]
    empty_single: int
    empty_compound: int
    empty_mass: float


@wp.struct
class DropData:
    """How objects are drawn and dropped."""

    volume: float
    move_repeats: int
    pick_repeats: int
    clearance: float
    spread: float
    rim_length: float
    rim_width: float
    rim_height: float
    gravity: float
    gripper_home: wp.vec3
    lights: int
    turn_lights: int
    exposure_spread: float


@wp.struct
class SettleData:
    """When a pile is at rest, and what is dropped again. Times in ticks."""

    min_ticks: int
    max_ticks: int
    rest_ticks: int
    stuck_ticks: int
    late_ticks: int
    rest_threshold: float
    relaxed_rest_threshold: float
    stuck_depth: float
    max_redrops: int


@wp.struct
class ModeData:
    """How episodes get their mode: shares of PICK and of PICK or TARGET among all, from 0 to 1."""

    pick_share: float
    pick_or_target_share: float


@wp.struct
class MoveData:
    """The gripper's task and controller in move mode."""

    stiffness: float
    damping: float
    force: float
    speed: float
    corner: wp.vec3
    start_height: float
    waypoints: int
    mass: float
    gravity: float
    step: float
    tcp_offset: float


@wp.struct
class PickData:
    """The gripper's task and controller in the modes PICK and TARGET. Lengths of time in steps."""

    stiffness: float
    damping: float
    force: float
    appear_height: float
    speed: float
    near: float
    near_speed: float
    press_steps: int
    lift_height: float
    lift_speed: float
    failures: int
    floor: float
    tilt_limit: float
    forgive: int
    random_after_failure: int


@wp.struct
class PerceptionData:
    """Parameters of perception and grasp planning, named as in configs.schema.Sight. Lengths in the image [px], heights [m]."""

    center_share: float
    heavy_mass: float
    heavy_center_share: float
    contour_offset: float
    deep_distance: float
    deep_weight: float
    min_votes: float
    reach: float
    exact_cycle: int
    normal_window: int


@wp.struct
class SuctionData:
    """The cup's rays and seals; see configs.schema.Suction. Angles in radians.

    `tilt_inertia` is what a torque of one step meets at the tilt axis: its drive, implicit in velocity and position [kg·m²].
    """

    rays: int
    radius: float
    reach: float
    tolerated_misses: int
    good_force: float
    poor_force: float
    stiffness: float
    damping: float
    twist_stiffness: float
    twist_damping: float
    swing_limit: float
    swing_stiffness: float
    tcp_offset: float
    finger_mass: float
    cup_mass: float
    tilt_inertia: float
    step: float
