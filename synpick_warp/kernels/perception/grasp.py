"""Grasp pose of the target in the world: grasp point, smoothed surface normal, and the gripper's inverse kinematics."""

import warp as wp

from synpick_warp.kernels.perception.components import Patches
from synpick_warp.kernels.render.lighting.materials import interpolate_surface
from synpick_warp.kernels.render.lighting.surfaces import Surfaces
from synpick_warp.kernels.render.visibility.camera import ImageGrid, Views, camera_ray
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer, Meshes, ViewBodies
from synpick_warp.kernels.state import Observations, Plans
from synpick_warp.kernels.structs import PickData

wp.set_module_options({"enable_backward": False})

UPRIGHT = wp.constant(1.0e-6)
"""A unit normal with a shorter horizontal part counts as vertical: the remainder is rounding error without a direction."""


@wp.func
def gripper_angles(normal: wp.vec3) -> wp.vec2:
    """Inverse kinematics: yaw ψ of the shaft in (-π/2, π/2] and tilt θ of the cup [rad] for a unit normal; (0, 0) if it is vertical.

    (sin θ cos ψ, sin θ sin ψ, cos θ) = normal. The wrist axis (-sin ψ, cos ψ, 0) is perpendicular to the normal. Half a turn of yaw is
    enough because the cup tilts both ways.
    """
    across = wp.length(wp.vec2(normal[0], normal[1]))
    if across < UPRIGHT:
        return wp.vec2(0.0, 0.0)
    yaw = wp.atan2(normal[1], normal[0])
    tilt = wp.atan2(across, normal[2])
    if yaw > 0.5 * wp.PI:
        return wp.vec2(yaw - wp.PI, -tilt)
    if yaw <= -0.5 * wp.PI:
        return wp.vec2(yaw + wp.PI, -tilt)
    return wp.vec2(yaw, tilt)


@wp.func
def limit_normal(normal: wp.vec3, limit: float) -> wp.vec3:
    """Unit vector along a normal of any length, clamped to an angle of at most `limit` [rad] from the vertical; vertical if it is zero."""
    length = wp.length(normal)
    if length == 0.0:
        return wp.vec3(0.0, 0.0, 1.0)
    unit = normal / length
    if unit[2] >= wp.cos(limit):
        return unit
    across = wp.length(wp.vec2(unit[0], unit[1]))
    if across < UPRIGHT:
        return wp.vec3(0.0, 0.0, 1.0)
    lean = wp.sin(limit) / across
    return wp.vec3(lean * unit[0], lean * unit[1], wp.cos(limit))


@wp.kernel
def smooth_normal_kernel(
    meshes: Meshes,
    surfaces: Surfaces,
    grid: ImageGrid,
    window: int,
    plan_inout: Plans,
    observation: Observations,
    bodies: ViewBodies,
    gbuffer: GBuffer,
    views: Views,
    patches: Patches,
):
    """Smoothed surface normal of each target: n = Σ n_p over pixels p of its largest component, within `window` of its grasp pixel.

    n_p is the interpolated unit shading normal, facing the camera; the window counts columns and rows. n is not normalized; the order of
    the sum is fixed. Launched over view.
    """
    view = wp.tid()
    world = views.world[view]
    if world < 0 or plan_inout.target[world] < 0:
        return
    instance = plan_inout.target[world]
    p = observation.grasp_pixel[world, instance]
    total = wp.vec3(0.0, 0.0, 0.0)
    for row in range(wp.max(p[1] - window, 0), wp.min(p[1] + window + 1, grid.height)):
        for column in range(wp.max(p[0] - window, 0), wp.min(p[0] + window + 1, grid.width)):
            if patches.component[view, row, column] == patches.largest[view, instance]:
                ray = views.cameras.to_world[view] * camera_ray(views.cameras, view, row, column, wp.vec2(0.0, 0.0))
                triangle = gbuffer.triangle[view, row, column]
                barycentric = gbuffer.barycentric[view, row, column]
                # Only the normal is used; the pixel width (0) affects texture filtering alone.
                surface = interpolate_surface(meshes, surfaces, bodies, view, instance, triangle, barycentric, -wp.normalize(ray), 0.0)
                total += surface.normal
    plan_inout.normal[world] = total


@wp.kernel
def frame_grasp_kernel(pick: PickData, plan_inout: Plans, observation: Observations, gbuffer: GBuffer, views: Views):
    """Grasp pose of each target: point c + Rᵀ (d · ray) with planar depth d at its pixel; unit normal within the tilt limit; yaw, tilt.

    Worlds without a target keep their values. Launched over view.
    """
    view = wp.tid()
    world = views.world[view]
    if world < 0 or plan_inout.target[world] < 0:
        return
    p = observation.grasp_pixel[world, plan_inout.target[world]]
    ray = camera_ray(views.cameras, view, p[1], p[0], wp.vec2(0.0, 0.0)) * gbuffer.depth[view, p[1], p[0]]
    position = wp.vec3d(wp.float64(ray[0]), wp.float64(ray[1]), wp.float64(ray[2]))
    plan_inout.point[world] = wp.vec3(views.cameras.center[view] + wp.transpose(views.cameras.rotation[view]) * position)
    normal = limit_normal(plan_inout.normal[world], pick.tilt_limit)
    angles = gripper_angles(normal)
    plan_inout.normal[world] = normal
    plan_inout.yaw[world] = angles[0]
    plan_inout.tilt[world] = angles[1]
