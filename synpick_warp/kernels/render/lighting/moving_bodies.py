"""Moving bodies: which bodies of a view moved since the previous frame, how far, and the space they take and took.

The light of resting surfaces is reused (`history`, `shadows`) where none of these changes it.
"""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.visibility.bvh_rays import RAY_OFFSET
from synpick_warp.kernels.render.visibility.gbuffer import FAR, Meshes, body_of, fixture_mesh
from synpick_warp.kernels.state import Snapshots

wp.set_module_options({"enable_backward": False})

MAX_DRIFT = wp.constant(4.0e-3)
"""Maximum displacement of a body over the frames that its own histories average [m]: at most two coarse pixels in full HD."""
MAX_FRAMES = wp.constant(1 << 20)
"""Maximum history length where nothing changes [frames]: longer than any history."""


@wp.struct
class MovingBodies:
    """Bodies of each view that moved, appeared or disappeared since the previous frame: boxes, poses and displacements. Scratch."""

    holds: wp.array[int]
    """(view): 1: the history contains the previous frame of the same episode."""
    moved: wp.array2d[wp.uint8]
    """(view, body): 1: the body moved, appeared or disappeared; 0: its mesh and the bits of its pose are those of the previous frame."""
    touched: wp.array2d[wp.uint8]
    """(view, body): 1: rays through a tile can hit the body whose bodies changed; written where `holds` is 1."""
    drift_frames: wp.array2d[int]
    """(view, body): maximum history length on the body itself, MAX_DRIFT over its displacement in a frame."""
    count: wp.array[int]
    """(view): number of bodies that moved, appeared or disappeared."""
    mesh: wp.array2d[int]
    """(view, rank): row of `Meshes` of each moving body."""
    to_body: wp.array2d[wp.transformf]
    """(view, rank): world to body [m]; of a body that disappeared, at its last pose."""
    change: wp.array2d[float]
    """(view, rank): displacement as a fraction of the body's size, at most 1."""
    lower: wp.array2d[wp.vec3]
    upper: wp.array2d[wp.vec3]
    """(view, rank): axis-aligned box in the world around each moving body, where it is and where it was [m]."""
    all_lower: wp.array[wp.vec3]
    all_upper: wp.array[wp.vec3]
    """(view): union of these boxes [m]."""


@wp.func
def rests(moving: MovingBodies, view: int, segment: int, instances: int) -> bool:
    """Whether what a segmentation id stands for has not moved since the previous frame; nothing and the table never do."""
    if segment == Segment.NOTHING or segment == Segment.TABLE:
        return True
    return moving.moved[view, body_of(segment, instances)] == wp.uint8(0)


@wp.func
def mean_projected_area(size: wp.vec3) -> float:
    """Mean area of the projections of a box along all directions: a quarter of its surface (Cauchy) [m²]."""
    return 0.5 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0])


@wp.func
def max_displacement(now: wp.transformf, then: wp.transformf, center: wp.vec3, radius: float) -> float:
    """Upper bound of the displacement of the points of a body: that of its bounding sphere's centre and the turn about it [m]."""
    turn = wp.transform_get_rotation(now) * wp.quat_inverse(wp.transform_get_rotation(then))
    sine = wp.length(wp.vec3(turn[0], turn[1], turn[2]))
    return wp.length(wp.transform_point(now, center) - wp.transform_point(then, center)) + 2.0 * radius * wp.min(sine, 1.0)


@wp.func
def displacement_fraction(meshes: Meshes, mesh: int, displacement: float) -> float:
    """Displacement of a body's points [m] as a fraction of its size, at most 1."""
    return wp.min(displacement / wp.sqrt(mean_projected_area(meshes.upper[mesh] - meshes.lower[mesh])), 1.0)


@wp.func
def same_pose(now: wp.transformf, then: wp.transformf) -> bool:
    """Whether all numbers of two poses are equal."""
    for i in range(7):
        if now[i] != then[i]:
            return False
    return True


@wp.func
def world_box(meshes: Meshes, mesh: int, pose: wp.transformf) -> tuple[wp.vec3, wp.vec3]:
    """World-space axis-aligned bounding box (AABB) of a posed mesh: lower and upper corner; empty for mesh -1. It is padded by RAY_OFFSET,
    because rays are traced from an offset above the surface, but tested against the box from the surface itself."""
    if mesh < 0:
        return wp.vec3(FAR, FAR, FAR), wp.vec3(-FAR, -FAR, -FAR)
    half = 0.5 * (meshes.upper[mesh] - meshes.lower[mesh])
    center = wp.transform_point(pose, meshes.lower[mesh] + half)
    rotation = wp.quat_to_matrix(wp.transform_get_rotation(pose))
    reach = wp.vec3(RAY_OFFSET, RAY_OFFSET, RAY_OFFSET)
    for i in range(3):
        for j in range(3):
            reach[i] += wp.abs(rotation[i, j]) * half[j]
    return center - reach, center + reach


@wp.func
def list_moving_body(
    meshes: Meshes,
    moving: MovingBodies,
    view: int,
    rank: int,
    mesh: int,
    last_mesh: int,
    now: wp.transformf,
    then: wp.transformf,
    change: float,
):
    """Append a moving body to the list: mesh index and pose in this frame (`mesh`, `now`) and in the previous one (`last_mesh`, `then`). A
    mesh index of -1 means that the body is absent."""
    moving.mesh[view, rank] = wp.where(mesh >= 0, mesh, last_mesh)
    moving.to_body[view, rank] = wp.transform_inverse(wp.where(mesh >= 0, now, then))
    moving.change[view, rank] = change
    lower, upper = world_box(meshes, mesh, now)
    last_lower, last_upper = world_box(meshes, last_mesh, then)
    lower = wp.min(lower, last_lower)
    upper = wp.max(upper, last_upper)
    moving.lower[view, rank] = lower
    moving.upper[view, rank] = upper
    moving.all_lower[view] = wp.min(moving.all_lower[view], lower)
    moving.all_upper[view] = wp.max(moving.all_upper[view], upper)


@wp.kernel
def find_moving_bodies_kernel(
    # Scene:
    meshes: Meshes,
    # State:
    snapshot: Snapshots,
    # In:
    view_world: wp.array[int],  # (view)
    instances: int,
    bodies: int,
    # Out:
    moving_inout: MovingBodies,
):
    """List the bodies of each view that moved, appeared or disappeared since the previous frame, if the history has that (`holds`).

    Writes all members of `MovingBodies` but `holds`; `touched` starts at 0. Launched over view. The struct `Views` is not an argument, as
    its cameras change which products the compiler fuses with sums.
    """
    view = wp.tid()
    if moving_inout.holds[view] == 0:
        return
    world = view_world[view]
    count = int(0)
    moving_inout.all_lower[view] = wp.vec3(FAR, FAR, FAR)
    moving_inout.all_upper[view] = wp.vec3(-FAR, -FAR, -FAR)
    for body in range(bodies):
        mesh = int(-1)
        last_mesh = int(-1)
        now = wp.transform_identity(dtype=float)
        then = wp.transform_identity(dtype=float)
        if body < instances:
            mesh = snapshot.catalog_index[world, body]
            last_mesh = snapshot.last_catalog_index[world, body]
            now = snapshot.pose[world, body]
            then = snapshot.last_pose[world, body]
        else:
            fixture = body - instances
            mesh = wp.where(snapshot.fixture_visible[world, fixture] != 0, fixture_mesh(meshes, snapshot.bin[world], fixture), -1)
            last_mesh = wp.where(snapshot.last_fixture_visible[world, fixture] != 0, fixture_mesh(meshes, snapshot.bin[world], fixture), -1)
            now = snapshot.fixture_pose[world, fixture]
            then = snapshot.last_fixture_pose[world, fixture]
        change = float(mesh != last_mesh)
        moved = mesh != last_mesh
        drift_frames = wp.where(mesh != last_mesh, 0, MAX_FRAMES)
        if mesh == last_mesh and mesh >= 0 and not same_pose(now, then):
            moved = True
            displacement = max_displacement(now, then, meshes.center[mesh], meshes.radius[mesh])
            change = displacement_fraction(meshes, mesh, displacement)
            drift_frames = int(MAX_DRIFT / wp.max(displacement, MAX_DRIFT / float(MAX_FRAMES)))
        moving_inout.drift_frames[view, body] = drift_frames
        moving_inout.moved[view, body] = wp.uint8(moved)
        moving_inout.touched[view, body] = wp.uint8(0)
        if moved:
            list_moving_body(meshes, moving_inout, view, count, mesh, last_mesh, now, then, change)
            count += 1
    moving_inout.count[view] = count
