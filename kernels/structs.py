"""Constants that several kernels share, in groups, so that a kernel's parameters stay readable."""

import warp as wp

wp.set_module_options({"enable_backward": False})


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


@wp.struct
class CatalogData:
    """What the simulation knows of each catalog entry."""

    count: int
    volume: wp.array[float]
    radius: wp.array[float]
    compound: wp.array[int]
    variant: wp.array[int]
    empty_single: int
    empty_compound: int
    empty_mass: float


@wp.struct
class DropData:
    """How objects are drawn and dropped."""

    volume: float
    repeats: int
    clearance: float
    spread: float
    rim_length: float
    rim_width: float
    rim_height: float
    gravity: float
    gripper_home: wp.vec3
    lights: int
    turn_lights: int


@wp.struct
class SettleData:
    """When a pile is at rest, and what is dropped again. Times in ticks."""

    min_ticks: int
    max_ticks: int
    rest_ticks: int
    stuck_ticks: int
    late_ticks: int
    rest_shift: float
    last_shift: float
    stuck_depth: float
    max_redrops: int


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
    tip: float
