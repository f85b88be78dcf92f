"""Background beyond the edge of the table: a textured floor in place of the environment map."""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.environment import lamp_center, lamp_irradiance, sh_irradiance
from synpick_warp.kernels.render.lighting.materials import map_table, sample_base_color
from synpick_warp.kernels.render.lighting.paths.tracing import AnyScene
from synpick_warp.kernels.render.lighting.surfaces import Surface
from synpick_warp.kernels.render.visibility.camera import camera_ray, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot, ShadedImage
from synpick_warp.kernels.render.visibility.variants import kernel_of_views

wp.set_module_options({"enable_backward": False})

HORIZON = wp.constant(0.02)
"""Sine of the angle below the horizon at which the floor ends: 1.1 degrees, beyond which its texture is one colour."""


@wp.func
def floor_radiance(scene: AnyScene, drop: float, shot: AnyShot, view: int, light: int, direction: wp.vec3) -> wp.vec3:
    """Radiance of the floor, `drop` [m] below the table, along a unit direction in the world, which points down: diffuse, in unoccluded
    light."""
    cameras = shot.views.cameras
    center = wp.vec3(cameras.center[view])
    distance = wp.max(center[2] - scene.table.height + drop, 0.0) / -direction[2]
    surface = Surface()
    surface.row = scene.surfaces.row[view, shot.bodies.mesh.shape[1] + 1]
    width = distance / cameras.intrinsics[view][0]
    surface = map_table(scene.surfaces, surface, center + distance * direction, -direction, width)
    irradiance = sh_irradiance(scene.lights, light, wp.vec3(0.0, 0.0, 1.0))
    for lamp in range(scene.lights.lamps[light]):
        irradiance += wp.max(lamp_center(scene.lights, light, lamp)[2], 0.0) * lamp_irradiance(scene.lights, light, lamp)
    return wp.cw_mul(sample_base_color(scene.surfaces, surface), irradiance) / wp.PI


@kernel_of_views(drawn=True)
def shade_floor_kernel(scene: AnyScene, drop: float, shot: AnyShot, first: int, image_inout: ShadedImage):
    """Shade the floor, a ground plane, where a camera ray points down and hits nothing else. It has no depth and lights nothing.

    The last material of each view is that of the floor, which is `drop` [m] below the table. Launched over view, pixel (tile order, from
    flat index `first` on)."""
    view, row, column = tile_pixel(shot.grid, wp.tid() + first)
    cameras, world = shot.views.cameras, shot.views.world[view]
    if not in_image(shot.grid, row, column) or world < 0:
        return
    if int(shot.gbuffer.segment[view, row, column]) == Segment.NOTHING:
        direction = wp.normalize(cameras.to_world[view] * camera_ray(cameras, view, row, column, wp.vec2(0.0, 0.0)))
        if direction[2] < -HORIZON:
            radiance = floor_radiance(scene, drop, shot, view, shot.snapshot.light[world], direction)
            image_inout.radiance[view, row, column] = radiance
