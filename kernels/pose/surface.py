"""Surface residuals: distances from observed points to the mesh of a hypothesis (point-to-plane ICP with exact closest points)."""

import warp as wp

from synpick_warp.kernels.pose.observation import Observation, Targets
from synpick_warp.kernels.pose.residuals import LANES, LossParameters, Models, Sums, jacobian, tukey_weight

wp.set_module_options({"enable_backward": False})

MIN_AGREEMENT = wp.constant(-0.5)
"""Smallest cosine between the normals of a point and of its closest triangle: noise tilts a fitted normal by some tens of degrees."""
MIN_DIRECTION = wp.constant(1.0e-6)
"""Distance below which the triangle's normal replaces the direction to the closest point [m]."""


@wp.struct
class Match:
    """Closest point of the mesh to an observed point, in the model's frame: whether found, point and distance [m], unit direction from the
    mesh to the observed point.
    """

    found: bool
    point: wp.vec3
    """On the mesh [m]."""
    distance: float
    """[m]"""
    direction: wp.vec3
    """Unit direction in which the distance is measured, from the mesh to the observed point."""


@wp.func
def match_point(mesh: wp.uint64, local: wp.vec3, seen: wp.vec3, eye: wp.vec3, reach: float) -> Match:
    """Closest point of the mesh, if its triangle can be what the camera at `eye` sees; else the first hit of the camera's ray.

    No match: no point of the mesh lies within `reach` [m], or the ray's first hit is nearer to the camera by more than that.

    The closest triangle is rejected if it faces away, or opposes the point's normal `seen`: the point then lies beyond the middle of a thin
    part, and would be pulled to its back. Rejecting such points alone would leave those before the surface, and pull thin objects
    towards the camera.
    """
    result = Match()
    query = wp.mesh_query_point_no_sign(mesh, local, reach)
    if not query.result:
        return result
    normal = wp.mesh_eval_face_normal(mesh, query.face)
    if wp.dot(normal, local - eye) <= 0.0 and wp.dot(seen, normal) >= MIN_AGREEMENT:
        result.found = True
        result.point = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        result.distance = wp.length(local - result.point)
        result.direction = normal
        if result.distance > MIN_DIRECTION:
            result.direction = (local - result.point) / result.distance
        return result
    distance = wp.length(local - eye)
    ray = (local - eye) / distance
    hit = wp.mesh_query_ray(mesh, eye, ray, distance + reach)
    if hit.result and hit.t > distance - reach:
        result.found = True
        result.point = eye + hit.t * ray
        offset = wp.dot(local - result.point, hit.normal)
        result.distance = wp.abs(offset)
        result.direction = hit.normal
        if offset < 0.0:
            result.direction = -hit.normal
    return result


@wp.kernel
def accumulate_points_kernel(
    # Scene:
    models: Models,
    loss: LossParameters,
    # In:
    targets: Targets,
    observation: Observation,
    pose: wp.array[wp.transform],  # (pose) [m]
    hypotheses: int,
    # Out:
    sums_out: Sums,
):
    """Point-to-plane ICP: normal equations of distances r of observed points p from the mesh: r = |n · (p - q)|, q and n of `match_point`.

    A point without a match has the full cost. Writes `sums_out` (all but `samples`). Launched over hypothesis, lane.
    """
    index, lane = wp.tid()
    instance = index // hypotheses
    model = targets.model[instance]
    origin = wp.transform_get_translation(pose[index])
    inverse = wp.transform_inverse(pose[index])
    eye = wp.transform_get_translation(inverse)
    mesh = models.mesh[model]
    area = observation.area[instance] * float(loss.step)
    reach = wp.max(loss.cutoff, loss.truncation)
    hessian = wp.spatial_matrix()
    gradient = wp.spatial_vector()
    total = wp.vec2(0.0, 0.0)
    for k in range(lane * loss.step, observation.points[instance], LANES * loss.step):
        local = wp.transform_point(inverse, observation.point[instance, k])
        seen = wp.transform_vector(inverse, observation.normal[instance, k])
        price = float(1.0)
        match = match_point(mesh, local, seen, eye, reach)
        if match.found:
            price = wp.min(match.distance / loss.truncation, 1.0)
            weight = area * tukey_weight(match.distance, loss.cutoff)
            point = wp.transform_point(pose[index], match.point)
            row = jacobian(point, origin, wp.transform_vector(pose[index], match.direction), models.radius[model])
            hessian += weight * wp.outer(row, row)
            gradient += weight * match.distance * row
        total += area * wp.vec2(price, 1.0)
    sums_out.hessian[index, lane] = hessian
    sums_out.gradient[index, lane] = gradient
    sums_out.points[index, lane] = total
