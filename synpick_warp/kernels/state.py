"""State of the worlds between ticks: struct bundles of device arrays, which kernels take as one argument each.

`stages` allocates them. An array is a member if it lives across ticks; scratch has structs of its own.
"""

import warp as wp


@wp.struct
class Worlds:
    """State of each world."""

    arrangement_id: wp.array[wp.vec2i]
    """(world): episode index, and index of the arrangement in it: 0, plus 1 for each resample. Episode -1: none."""
    phase: wp.array[int]
    """(world): `Phase`."""
    ending: wp.array[int]
    """(world): `Ending`."""
    mode: wp.array[int]
    """(world): `Mode`."""
    next_episode: wp.array[int]
    """(one): position in the bake's list of episodes of the next one to start."""
    progress: wp.array[wp.vec4i]
    """(world): ticks since the drop, ticks at rest, number of re-drops, 1 while the guide walls stand."""
    bin: wp.array[int]
    """(world): bin of the episode."""
    bin_pose: wp.array[wp.transform]
    """(world): bin to world [m]."""
    catalog_index: wp.array2d[int]
    """(world, instance): object of each instance; -1: none."""
    body_slot: wp.array2d[int]
    """(world, instance): body slot of each instance: its body is the slot-th after the gripper's."""
    stuck: wp.array2d[int]
    """(world, instance): time in deep penetration [ticks]."""
    previous_pose: wp.array2d[wp.transform]
    """(world, instance): object to world, one tick ago [m]."""
    displacement: wp.array2d[float]
    """(world, instance): upper bound of the motion of any point of the instance in the last tick [m]."""
    penetration: wp.array[float]
    """(body): deepest penetration of each body [m]."""
    variant: wp.array[int]
    """(body): body variant to select; -1: no change."""
    restarted: wp.array[wp.bool]
    """(world_and_global): worlds that were reset in this tick; the last element is Newton's global world."""
    frame: wp.array[int]
    """(world): frame index since phase ACT began; -1: not yet."""
    corner_order: wp.array2d[int]
    """(world, waypoint): corner, 0 to 3, of each waypoint, plus 4 times the compartment."""
    waypoint: wp.array[int]
    """(world): waypoints that the setpoint has reached."""
    setpoint: wp.array[wp.vec3]
    """(world): setpoint of the wrist, the origin of shaft and cup [m]."""
    light: wp.array[int]
    """(world): environment map of the episode."""
    light_yaw: wp.array[float]
    """(world): rotation of the map about +z, counter-clockwise [rad]."""
    light_exposure: wp.array[float]
    """(world): exposure relative to the automatic one [EV]."""


@wp.struct
class Attempts:
    """Attempt to pick of each world: task, outcome, failures, instances that the cup holds, and what has left the scene."""

    task: wp.array[int]
    """(world): `Task`."""
    steps: wp.array[int]
    """(world): time since the task began [steps]."""
    attempt: wp.array[int]
    """(world): index of the attempt in its episode, of the running one or the one that ended in this tick; -1: none yet."""
    outcome: wp.array[int]
    """(world): `Outcome` of the attempt that ended in this tick."""
    failures: wp.array[int]
    """(world): failed attempts that count towards the limit."""
    target_failures: wp.array2d[int]
    """(world, instance): failed attempts at it in the episode, plus 1024 times those since the last success; 0 with `pick.retry` "same"."""
    hits: wp.array[wp.vec2i]
    """(world): suction rays that hit an object when suction was switched on, and the cups with a good seal: bit k, cup k."""
    engaged_words: wp.array2d[wp.uint32]
    """(world, word): bit set of the instances that were engaged, that is, hit by a ray."""
    attached_words: wp.array2d[wp.uint32]
    """(world, word): bit set of the instances that were attached to the cup at the end of the tick, before picked objects were removed."""
    removed: wp.array2d[int]
    """(world, instance): `Removal`: why the instance has left the scene."""


@wp.struct
class Seals:
    """Seals of each world's cups: attached instances, with their poses and forces."""

    attached: wp.array2d[int]
    """(world, instance): cups that hold the instance: bit k, cup k; 0: none."""
    object_in_tcp: wp.array2d[wp.transform]
    """(world, instance): object pose in the TCP frame when the seals engaged [m]."""
    seal_force: wp.array2d[float]
    """(world, instance): largest force of tension and shear of its seals in the last step, including seals that broke [N]; 0: no seal."""
    cup_force: wp.array2d[float]
    """(world, cup): force of tension and shear of each cup, summed over the instances that it holds [N]."""
    break_force: wp.array2d[float]
    """(world, cup): break force of a cup's seals [N]."""
    peak: wp.array[wp.vec2]
    """(world): largest seal force since the tick began, including seals that broke [N], and largest relative to the seal's break force."""


@wp.struct
class Observations:
    """Perception result of each instance, when its world was last observed; `dataset.annotations.InstanceObservation` has it as JSON."""

    visible: wp.array2d[int]
    """(world, instance): visible pixels [px]: size of the largest component; 0: not visible."""
    visible_fraction: wp.array2d[float]
    """(world, instance): visible area, measured from depth, divided by the product of the two larger sides of the bounding box."""
    pole: wp.array2d[wp.vec2]
    """(world, instance): pole of inaccessibility [px]: the pixel farthest from the contour."""
    centroid: wp.array2d[wp.vec2]
    """(world, instance): centroid of the polygon that the outer contour encloses [px]."""
    midpoint: wp.array2d[wp.vec2]
    """(world, instance): midpoint of pole and centroid [px]."""
    distances: wp.array2d[wp.vec3]
    """(world, instance): distance to the contour at pole, centroid and midpoint [px]; 0 outside the component."""
    grasp_pixel: wp.array2d[wp.vec2i]
    """(world, instance): suction grasp point in the image [px]: the candidate chosen among pole, centroid and midpoint."""
    depth: wp.array2d[float]
    """(world, instance): planar depth of the grasp point [m]."""
    votes: wp.array3d[float]
    """(world, instance, instance): occlusion votes [i, j]: evidence along i's contour that j lies on top of i; not thresholded."""
    above: wp.array3d[wp.uint32]
    """(world, instance, word): edges of the clutter graph, as bit sets (`kernels.bitsets`). Member j: edge from j, on top, to it."""
    ancestors: wp.array3d[wp.uint32]
    """(world, instance, word): transitive closure of `above`. Member j: a path leads from j to this instance."""
    overflow: wp.array[int]
    """(world): 1: a contour exceeded its capacity."""


@wp.struct
class Plans:
    """Plan of each world, from when it was last observed."""

    target: wp.array[int]
    """(world): chosen instance; -1: none."""
    point: wp.array[wp.vec3]
    """(world): grasp point [m]."""
    normal: wp.array[wp.vec3]
    """(world): unit surface normal at the grasp point, pointing out of the object."""
    yaw: wp.array[float]
    """(world): rotation of the gripper shaft about the vertical [rad]."""
    tilt: wp.array[float]
    """(world): rotation of the cup about the wrist axis, the shaft's y axis [rad]."""


@wp.struct
class Snapshots:
    """Snapshot of each world at the end of a tick, with the poses of the previous frame (`last_`)."""

    live: wp.array[int]
    """(world): 1: this tick is a frame of the world's episode."""
    episode: wp.array[int]
    """(world): episode index."""
    frame: wp.array[int]
    """(world): frame index within the episode."""
    bin: wp.array[int]
    """(world): bin of the episode; its pose is that of the first fixture."""
    catalog_index: wp.array2d[int]
    """(world, instance): catalog index of each instance; -1: none."""
    pose: wp.array2d[wp.transform]
    """(world, instance): object to world [m]."""
    fixture_pose: wp.array2d[wp.transform]
    """(world, fixture): bin, gripper shaft and cup to world [m]."""
    fixture_visible: wp.array2d[int]
    """(world, fixture): 0: the fixture is not rendered."""
    light: wp.array[int]
    """(world): index of the episode's environment map."""
    light_yaw: wp.array[float]
    """(world): environment yaw [rad]: rotation of the map counter-clockwise about +z."""
    light_exposure: wp.array[float]
    """(world): exposure value relative to the automatic exposure [EV]."""
    follows: wp.array[int]
    """(world): 1: the `last_` arrays hold the previous frame of the same episode; 0: there is none."""
    last_catalog_index: wp.array2d[int]
    """(world, instance)"""
    last_pose: wp.array2d[wp.transform]
    """(world, instance)"""
    last_fixture_pose: wp.array2d[wp.transform]
    """(world, fixture)"""
    last_fixture_visible: wp.array2d[int]
    """(world, fixture)"""


@wp.struct
class Frames:
    """Episode, frame and light of each world: what shading reads of `Snapshots`, in few bytes of a kernel's parameters."""

    episode: wp.array[int]
    """(world)"""
    frame: wp.array[int]
    """(world)"""
    light: wp.array[int]
    """(world)"""
    light_yaw: wp.array[float]
    """(world): [rad]"""
    light_exposure: wp.array[float]
    """(world): [EV]"""


@wp.struct
class FramePoses:
    """State of each world in one snapshot; the next snapshot repeats it as its previous frame."""

    live: wp.array[int]
    """(world): 1 if the tick is a frame."""
    episode: wp.array[int]
    """(world): episode index."""
    frame: wp.array[int]
    """(world): frame index in the episode."""
    catalog_index: wp.array2d[int]
    """(world, instance): object of each instance; -1: none."""
    pose: wp.array2d[wp.transform]
    """(world, instance): object to world [m]."""
    fixture_pose: wp.array2d[wp.transform]
    """(world, fixture): fixture to world [m]."""
    fixture_visible: wp.array2d[int]
    """(world, fixture): 0 if it is not rendered."""


@wp.struct
class Motion:
    """Motion of all bodies, as Newton's state has it; the coordinates of a world's gripper come first, see `LayoutData`."""

    body_q: wp.array[wp.transform]
    """(body): body to world [m]."""
    body_qd: wp.array[wp.spatial_vector]
    """(body): linear velocity of the centre of mass and angular velocity [m/s, rad/s]."""
    joint_q: wp.array[float]
    """(coord): joint coordinates [m, rad]."""
    joint_qd: wp.array[float]
    """(dof): joint velocities [m/s, rad/s]."""


@wp.struct
class Control:
    """Input of the solver, as Newton's control has it."""

    joint_f: wp.array[float]
    """(dof): joint forces [N, N·m]."""
    joint_target_q: wp.array[float]
    """(coord): drive targets, of which that of the cup's tilt is used [rad]."""


@wp.struct
class Contacts:
    """Contacts of all worlds, as Newton's collision pipeline lists them, and the bodies of their shapes."""

    count: wp.array[int]
    """(one): number of contacts."""
    shape0: wp.array[int]
    """(contact): first shape."""
    shape1: wp.array[int]
    """(contact): second shape."""
    point0: wp.array[wp.vec3]
    """(contact): contact point in the frame of the first shape's body [m]."""
    point1: wp.array[wp.vec3]
    """(contact): contact point in the frame of the second shape's body [m]."""
    normal: wp.array[wp.vec3]
    """(contact): unit normal, from the first to the second shape."""
    margin0: wp.array[float]
    """(contact): thickness of the first shape [m]."""
    margin1: wp.array[float]
    """(contact): thickness of the second shape [m]."""
    shape_body: wp.array[int]
    """(shape): body of a shape; -1: the shape is static."""
