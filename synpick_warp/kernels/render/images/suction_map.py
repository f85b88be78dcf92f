"""Analytic suction maps: seal and wrench score of a cup at every visible pixel of an object (SuctionNet-1Billion, Cao et al., 2021).

A cup is set on the pixel's surface point with its axis along the shading normal. SuctionNet samples models as point clouds; here, rays
find the surface below the cup's rim and what stands in the cup's way. All else follows its definition: `RIM_POINTS` points on the rim, a
cup of 100 mm height, a load of 1 kg.
"""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.images.layers import LayerScene, hit_surface, kernel_of_layer
from synpick_warp.kernels.render.lighting.paths.tracing import AnyScene
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot, Meshes
from synpick_warp.kernels.render.visibility.ray_bodies import first_ray_record, read_ray_body
from synpick_warp.kernels.render.visibility.records import read_record
from synpick_warp.kernels.render.visibility.wide_bvh import query_any_hit, query_closest_hit
from synpick_warp.kernels.rng import TAU

wp.set_module_options({"enable_backward": False})

RIM_POINTS = wp.constant(72)
"""Vertices of the polygon that stands for the cup's lip (SuctionNet)."""
FLATNESS = wp.constant(1.0e5)
"""Decay of the seal with the variance of the lip's heights [1/m²] (SuctionNet)."""
OWN_CLEARANCE = wp.constant(0.005)
"""The object itself may rise this far above the point within the cup's radius [m] (SuctionNet)."""
CLEARANCE = wp.constant(0.01)
"""Others may rise this far [m] (SuctionNet)."""
CUP_HEIGHT = wp.constant(0.1)
"""Height of the cylinder above the point that nothing else may reach into [m] (SuctionNet)."""
OBSTACLE_STRIDE = wp.constant(3)
"""Every third point of the rim, and the axis, send a ray against other bodies."""
PARALLEL = wp.constant(1.0e-6)
"""A unit normal whose x and y are smaller in sum is the camera's z axis: the remainder is rounding error without a direction."""
STIFFNESS = wp.constant(15.6)
"""Load of a cup's lip k: a bending torque of k π r breaks its seal [N] (SuctionNet)."""
GRAVITY = wp.constant(9.8)
"""Weight of the load of 1 kg [N] (SuctionNet)."""


@wp.struct
class PlacedCup:
    """Suction cup set on a surface point: the object, the point, and the cup's axis and two tangents, in the object's frame."""

    body: int
    """Row of `ViewBodies`; -1: the pixel shows no object."""
    point: wp.vec3
    """[m]"""
    axis: wp.vec3
    """Unit normal of the surface, away from it."""
    across: wp.vec3
    """Unit tangent within the camera's image plane."""
    along: wp.vec3
    """axis x across"""


@wp.func
def place_cup(scene: AnyScene, shot: AnyShot, obj_id: wp.array[int], view: int, row: int, column: int) -> PlacedCup:
    """Cup on the surface point that a pixel shows, if that belongs to an instance with a label; `obj_id` as in `LayerScene`."""
    cup = PlacedCup()
    cup.body = -1
    segment = int(shot.gbuffer.segment[view, row, column])
    if segment == Segment.NOTHING or segment > shot.views.instances:
        return cup
    body = segment - 1
    mesh = shot.bodies.mesh[view, body]
    if obj_id[mesh] < 0:
        return cup
    barycentric = shot.gbuffer.barycentric[view, row, column]
    normal = wp.transpose(shot.views.cameras.to_world[view]) * hit_surface(scene, shot, view, row, column).normal
    across = wp.vec3(0.0, 1.0, 0.0)
    if wp.abs(normal[0]) + wp.abs(normal[1]) > PARALLEL:
        across = wp.normalize(wp.vec3(-normal[1], normal[0], 0.0))
    rotation = shot.bodies.rotation[view, body]
    triangle = shot.gbuffer.triangle[view, row, column]
    cup.body = body
    cup.point = wp.mesh_eval_position(scene.meshes.id[mesh], triangle, barycentric[0], barycentric[1])
    cup.axis = rotation * normal
    cup.across = rotation * across
    cup.along = wp.cross(cup.axis, cup.across)
    return cup


@wp.func
def rim_point(cup: PlacedCup, radius: float, index: int) -> wp.vec3:
    """Vertex of the lip's polygon, in the plane through the point, in the object's frame [m]."""
    angle = TAU * (float(index) + 0.5) / float(RIM_POINTS)
    return cup.point + radius * (wp.cos(angle) * cup.across + wp.sin(angle) * cup.along)


@wp.func
def seal_score(meshes: Meshes, mesh: int, cup: PlacedCup, radius: float) -> float:
    """Seal score: min over edges (length in the plane / length on the surface) x exp(-FLATNESS x variance of the lip's heights). 0 if the
    lip meets no surface somewhere, or the object stands in the cup's way."""
    above = 2.0 * meshes.radius[mesh]
    chord = 2.0 * radius * wp.sin(0.5 * TAU / float(RIM_POINTS))
    total = float(0.0)
    squares = float(0.0)
    steepest = float(0.0)
    first = float(0.0)
    last = float(0.0)
    for index in range(RIM_POINTS):
        start = rim_point(cup, radius, index) + above * cup.axis
        hit = query_closest_hit(meshes.bvh, meshes.bvh.root[mesh], start, -cup.axis, 2.0 * above)
        height = above - hit[0]
        if hit[0] < 0.0 or height > OWN_CLEARANCE:
            return 0.0
        if index == 0:
            first = height
        else:
            steepest = wp.max(steepest, wp.abs(height - last))
        last = height
        total += height
        squares += height * height
    steepest = wp.max(steepest, wp.abs(first - last))
    mean = total / float(RIM_POINTS)
    variance = wp.max(squares / float(RIM_POINTS) - mean * mean, 0.0)
    return chord / wp.sqrt(chord * chord + steepest * steepest) * wp.exp(-FLATNESS * variance)


@wp.func
def is_obstructed(scene: AnyScene, shot: AnyShot, view: int, cup: PlacedCup, radius: float) -> bool:
    """Whether another object, bin or table reaches into the cup's cylinder, from CLEARANCE to CUP_HEIGHT; the gripper does not count."""
    meshes, table, bodies, instances = scene.meshes, scene.table, shot.bodies, shot.views.instances
    to_world = wp.transpose(bodies.world_rotation[view, cup.body])
    point = bodies.position[view, cup.body] + to_world * cup.point
    axis = to_world * cup.axis
    lowest = point[2] + CUP_HEIGHT * axis[2] - radius * wp.sqrt(wp.max(1.0 - axis[2] * axis[2], 0.0))
    if table.visible != 0 and axis[2] < 0.0 and lowest < table.height:
        return True
    for rank in range(bodies.present[view]):
        record = first_ray_record(bodies, view, rank)
        body = read_ray_body(bodies, record)
        sphere = read_record(bodies.ray_record, record)
        offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - point
        apart = offset - wp.clamp(wp.dot(offset, axis), CLEARANCE, CUP_HEIGHT) * axis
        gripper = body.row == instances + 1 or body.row == instances + 2
        if body.row != cup.body and not gripper and wp.length(apart) < wp.sqrt(sphere[3]) + radius:
            direction = body.rotation * -axis
            for index in range(0, RIM_POINTS + 1, OBSTACLE_STRIDE):
                foot = point
                if index < RIM_POINTS:
                    foot += to_world * (rim_point(cup, radius, index) - cup.point)
                start = body.rotation * (foot + CUP_HEIGHT * axis - body.position)
                if query_any_hit(meshes.bvh, body.root, start, direction, CUP_HEIGHT - CLEARANCE):
                    return True
    return False


@wp.func
def wrench_score(cup: PlacedCup, center: wp.vec3, weight: wp.vec3, radius: float) -> float:
    """Wrench score: 1 - τ / (k π r), at least 0, with the larger torque τ of `weight` [N] at `center` [m] about the cup's two tangents."""
    torque = wp.cross(center - cup.point, weight)
    bending = wp.max(wp.abs(wp.dot(torque, cup.across)), wp.abs(wp.dot(torque, cup.along)))
    return 1.0 - wp.min(bending / (STIFFNESS * wp.PI * radius), 1.0)


@wp.func
def obstructed_seal(scene: AnyScene, shot: AnyShot, view: int, cup: PlacedCup, radius: float) -> float:
    """`seal_score` of a cup on a pixel's surface; 0 if something else is in its way."""
    score = seal_score(scene.meshes, shot.bodies.mesh[view, cup.body], cup, radius)
    if score > 0.0 and is_obstructed(scene, shot, view, cup, radius):
        score = 0.0
    return score


@wp.func
def loaded_wrench(layer: LayerScene, shot: AnyShot, view: int, cup: PlacedCup) -> float:
    """`wrench_score` of a cup on a pixel's surface under a load of 1 kg at the object's centre of mass."""
    center = layer.suction.center_of_mass[shot.bodies.mesh[view, cup.body]]
    weight = shot.bodies.world_rotation[view, cup.body] * wp.vec3(0.0, 0.0, -GRAVITY)
    return wrench_score(cup, center, weight, layer.suction.radius)


@wp.func
def seal_at(scene: AnyScene, layer: LayerScene, shot: AnyShot, view: int, row: int, column: int) -> float:
    """Seal map: `obstructed_seal` of a cup at each pixel; 0 without instance or label."""
    score = float(0.0)
    cup = place_cup(scene, shot, layer.obj_id, view, row, column)
    if cup.body >= 0:
        score = obstructed_seal(scene, shot, view, cup, layer.suction.radius)
    return score


@wp.func
def wrench_at(scene: AnyScene, layer: LayerScene, shot: AnyShot, view: int, row: int, column: int) -> float:
    """Wrench map: `loaded_wrench` of a cup at each pixel; 0 without instance or label."""
    score = float(0.0)
    cup = place_cup(scene, shot, layer.obj_id, view, row, column)
    if cup.body >= 0:
        score = loaded_wrench(layer, shot, view, cup)
    return score


render_suction_seal_kernel = kernel_of_layer(seal_at, "suction_seal", float)
render_suction_wrench_kernel = kernel_of_layer(wrench_at, "suction_wrench", float)


@wp.kernel(enable_backward=False, module="unique")
def score_points_kernel(
    # Scene:
    meshes: Meshes,
    # In:
    radius: float,
    samples: int,
    point: wp.array[wp.vec3],  # (point) [m]
    normal: wp.array[wp.vec3],  # (point)
    # Out:
    seal_out: wp.array[float],  # (point)
):
    """Seal scores of a cup of `radius` [m] on points of the meshes, in each mesh's frame: `samples` points of the first, and so on.
    Launched over point."""
    index = wp.tid()
    cup = PlacedCup()
    cup.point = point[index]
    cup.axis = normal[index]
    other = wp.vec3(1.0, 0.0, 0.0)
    if wp.abs(cup.axis[0]) > 0.5:
        other = wp.vec3(0.0, 1.0, 0.0)
    cup.across = wp.normalize(wp.cross(cup.axis, other))
    cup.along = wp.cross(cup.axis, cup.across)
    seal_out[index] = seal_score(meshes, index // samples, cup, radius)
