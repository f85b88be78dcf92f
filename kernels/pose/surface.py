"""Surface residuals: distances from observed points to the mesh of a hypothesis (point-to-plane ICP with exact closest points)."""

import warp as wp

from synpick_warp.kernels.pose.observation import Observation, Targets
from synpick_warp.kernels.pose.residuals import LANES, Cost, Models, Sums, jacobian, tukey_weight

wp.set_module_options({"enable_backward": False})

MIN_DIRECTION = wp.constant(1.0e-6)
"""Distance below which the triangle's normal replaces the direction to the closest point [m]."""


@wp.kernel
def accumulate_points_kernel(
    # Scene:
    models: Models,
    cost: Cost,
    # In:
    targets: Targets,
    observation: Observation,
    pose: wp.array[wp.transform],  # (pose) [m]
    hypotheses: int,
    # Out:
    sums_out: Sums,
):
    """Distances from observed points to the mesh: r = |p - q| along n = (p - q) / r, q the closest point of the mesh.

    A point whose normal opposes that of the closest triangle lies on the other side of a thin wall: an outlier at full cost.
    """
    index, lane = wp.tid()
    instance = index // hypotheses
    model = targets.model[instance]
    origin = wp.transform_get_translation(pose[index])
    inverse = wp.transform_inverse(pose[index])
    mesh = models.mesh[model]
    area = observation.area[instance] * float(cost.step)
    reach = wp.max(cost.cutoff, cost.truncation)
    hessian = wp.spatial_matrix()
    gradient = wp.spatial_vector()
    total = wp.vec2(0.0, 0.0)
    for k in range(lane * cost.step, observation.points[instance], LANES * cost.step):
        point = observation.point[instance, k]
        local = wp.transform_point(inverse, point)
        price = float(1.0)
        query = wp.mesh_query_point_no_sign(mesh, local, reach)
        if query.result:
            offset = local - wp.mesh_eval_position(mesh, query.face, query.u, query.v)
            normal = wp.mesh_eval_face_normal(mesh, query.face)
            distance = wp.length(offset)
            seen = wp.transform_vector(inverse, observation.normal[instance, k])
            if wp.dot(seen, normal) >= 0.0:
                price = wp.min(distance / cost.truncation, 1.0)
                direction = normal
                if distance > MIN_DIRECTION:
                    direction = offset / distance
                weight = area * tukey_weight(distance, cost.cutoff)
                closest = wp.transform_point(pose[index], local - offset)
                row = jacobian(closest, origin, wp.transform_vector(pose[index], direction), models.radius[model])
                hessian += weight * wp.outer(row, row)
                gradient += weight * distance * row
        total += area * wp.vec2(price, 1.0)
    sums_out.hessian[index, lane] = hessian
    sums_out.gradient[index, lane] = gradient
    sums_out.points[index, lane] = total
