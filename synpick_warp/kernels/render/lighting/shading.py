"""Deferred shading: radiance of each pixel from the G-buffer, denoised visibility ratios, indirect light and lamp shadows.

`shade_kernel` shades the center of each pixel. `shade_samples_kernel` supersamples the shading of bodies: textures and normals of one
triangle a pixel. The light is gathered once, and silhouettes are left to anti-aliasing.
"""

from typing import Any

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.brdf import AlbedoTables, AnyBrdf, evaluate_disc, view_factors, widen_roughness
from synpick_warp.kernels.render.lighting.coarse_grid import CoarseGrid
from synpick_warp.kernels.render.lighting.environment import (
    Lights,
    environment_radiance,
    lamp_center,
    lamp_direction,
    lamp_irradiance,
    rotate_z,
    unit_heading,
)
from synpick_warp.kernels.render.lighting.materials import brdf_of, interpolate_surface, make_table_surface, map_table, material_at, wear_at
from synpick_warp.kernels.render.lighting.paths.tracing import AnyScene
from synpick_warp.kernels.render.lighting.plane_distance import tangent_plane
from synpick_warp.kernels.render.lighting.shadow_filter import LampShadows
from synpick_warp.kernels.render.lighting.shadow_upsampling import upsample_shadows
from synpick_warp.kernels.render.lighting.shadows import byte_of
from synpick_warp.kernels.render.lighting.surfaces import Surface, add_emission
from synpick_warp.kernels.render.lighting.tile_flags import needs
from synpick_warp.kernels.render.lighting.unoccluded import unoccluded_light
from synpick_warp.kernels.render.lighting.upsampling import RatioImages, Ratios, upsample_ratios
from synpick_warp.kernels.render.lighting.wear import Wear
from synpick_warp.kernels.render.visibility.camera import hit_position, in_image, loop_ray, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import SHADE_PASS, AnyShot, ShadedImage, body_of
from synpick_warp.kernels.render.visibility.triangles import camera_triangle, edge_areas
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.tuning import SAMPLE_SHADE_REGISTERS, SHADE_REGISTERS

wp.set_module_options({"enable_backward": False, "fast_math": True})

SAMPLES_PER_AXIS = wp.constant(2)
"""Shading samples of a pixel along each axis, in images that are supersampled. Three gain another 0.08 dB in PSNR."""
MAX_WEIGHT_CHANGE = wp.constant(1.0)
"""Maximum change of a barycentric weight between a pixel's center and a shading sample. Normals and texture coordinates extrapolated far
from a triangle that is narrower than a pixel would be meaningless. From 0.5 to 100 the PSNR is the same within 0.02 dB."""


@wp.struct
class Sky:
    """Environment map of a world, and the rotation of the map."""

    light: int
    """Index of the environment map."""
    yaw: float
    """Rotation of the map about +z, counter-clockwise [rad]."""


@wp.struct
class DenoisedLight:
    """Light of a batch of views for shading: that of coarse pixels, and the lamps' shadows."""

    coarse: CoarseGrid
    ratios: RatioImages
    history_row: wp.array[int]
    """(view): row of a view's ratios."""
    shadow_grid: CoarseGrid
    shadows: LampShadows


@wp.struct
class PixelLight:
    """Upsampled lighting of a pixel: visibility ratios and indirect light of the environment, visible fractions of the lamps."""

    ratios: Ratios
    """Visibility ratios of the environment's diffuse and specular light, and indirect light, which is absolute."""
    lamps: wp.uint64
    """Visible fraction of each lamp, byte k that of lamp k in 1/255, also of lamps behind the surface."""


@wp.func
def lamp_light(
    tables: AlbedoTables, lights: Lights, light: int, yaw: float, brdf: AnyBrdf, face_normal: wp.vec3, visible: wp.uint64
) -> wp.vec3:
    """Radiance of the lamps' light that a surface reflects towards the camera; `visible` as in `PixelLight.lamps`. Lamps behind the
    triangle, whose geometric normal is `face_normal`, give no light, whatever the interpolated normal says."""
    result = wp.vec3()
    if visible == wp.uint64(0):
        return result
    heading = unit_heading(yaw)
    view = view_factors(brdf)
    for lamp in range(lights.lamps[light]):
        fraction = byte_of(visible, lamp)
        if fraction > 0:
            direction = lamp_direction(lights, light, lamp, heading)
            if wp.dot(face_normal, direction) > 0.0:
                reflected = evaluate_disc(tables, brdf, view, direction, lamp_center(lights, light, lamp)[3])
                result += (float(fraction) / 255.0) * wp.cw_mul(reflected, lamp_irradiance(lights, light, lamp))
    return result


@wp.func
def shade_surface(
    tables: AlbedoTables, lights: Lights, light: int, yaw: float, brdf: AnyBrdf, face_normal: wp.vec3, ratios: Ratios, lamps: wp.uint64
) -> wp.vec3:
    """Radiance towards the camera: unoccluded light times its visibility `ratios`, indirect light, and that of the visible `lamps`."""
    unoccluded = unoccluded_light(lights, light, yaw, brdf)
    result = wp.cw_mul(brdf.diffuse, wp.cw_mul(unoccluded.diffuse, ratios.diffuse) + ratios.indirect) + wp.cw_mul(
        unoccluded.specular, ratios.specular
    )
    return result + lamp_light(tables, lights, light, yaw, brdf, face_normal, lamps)


@wp.func
def gather_light(
    scene: AnyScene, shot: AnyShot, denoised: DenoisedLight, sky: Sky, image: ShadedImage, view: int, row: int, column: int, normal: wp.vec3
) -> PixelLight:
    """Upsample the denoised light and the lamps' shadows to a pixel whose surface has the geometric `normal` in camera space."""
    cameras = shot.views.cameras
    segment, depth = shot.gbuffer.segment[view, row, column], shot.gbuffer.depth[view, row, column]
    plane = tangent_plane(cameras, cameras.intrinsics[view], view, row, column, segment, depth, normal)
    result = PixelLight()
    if scene.lights.lamps[sky.light] > 0:
        result.lamps = upsample_shadows(denoised.shadows, image.radiance, denoised.shadow_grid, view, row, column, plane)
    result.ratios = upsample_ratios(denoised.ratios, denoised.coarse, denoised.history_row[view], row, column, plane)
    result.ratios.indirect = result.ratios.indirect / scene.lights.exposure[sky.light]
    return result


@wp.func
def shade_point(scene: AnyScene, sky: Sky, surface: Surface, wear: Wear, outgoing: wp.vec3, light: PixelLight) -> wp.vec3:
    """Radiance of a point of a surface towards the camera, the direction `outgoing`."""
    material = material_at(scene.surfaces, surface, wear)
    roughness = widen_roughness(material.roughness, surface.normal_spread)
    brdf = brdf_of(scene.surfaces, surface, material, roughness, outgoing, 0.0)
    lit = shade_surface(scene.surfaces.albedo, scene.lights, sky.light, sky.yaw, brdf, surface.face_normal, light.ratios, light.lamps)
    return add_emission(scene.surfaces, lit, material.emission, scene.lights.exposure[sky.light])


@wp.func
def sample_offset(sample: int, samples_per_axis: int) -> wp.vec2:
    """Offset of a shading sample from its pixel's center [px], on a regular grid."""
    scale = 1.0 / float(samples_per_axis)
    return wp.vec2((float(sample % samples_per_axis) + 0.5) * scale - 0.5, (float(sample // samples_per_axis) + 0.5) * scale - 0.5)


@wp.func
def sum_of(values: wp.vec3) -> float:
    """Sum of a vector's three components."""
    return values[0] + values[1] + values[2]


@wp.func
def move_weights(center: wp.vec3, orientation: float, areas: wp.vec3) -> tuple[wp.vec3, float]:
    """Move barycentric weights from a pixel's center towards a shading sample, by at most MAX_WEIGHT_CHANGE. `center`: weights at the
    pixel's center. `orientation`: sign of the sum of `edge_areas` there, 1 or -1. `areas`: `edge_areas` at the sample.

    Returns the weights, and how far they moved as a fraction of the way: 0 if the sample's ray does not meet the triangle's plane."""
    # The sum may be small: all quantities are multiplied by it, so that no quotient overflows.
    total = orientation * sum_of(areas)
    if total <= 0.0:
        return center, 0.0
    change = orientation * areas - total * center
    limit = MAX_WEIGHT_CHANGE * total
    reach = wp.max(wp.max(wp.abs(change)), limit)
    return center + (MAX_WEIGHT_CHANGE / reach) * change, limit / reach


@wp.func
def shade_pixel(
    scene: AnyScene, shot: AnyShot, denoised: DenoisedLight, image: ShadedImage, view: int, row: int, column: int, samples_per_axis: int
) -> wp.vec3:
    """Radiance of a pixel; background pixels show the environment map.

    A pixel of a body is the mean of `samples_per_axis`² shading samples of its triangle, all in the light at the pixel's center. Kernels
    pass a constant, so that the compiler removes the loop if there is one sample.
    """
    views, bodies, gbuffer = shot.views, shot.bodies, shot.gbuffer
    sky = Sky()
    sky.light = shot.snapshot.light[views.world[view]]
    sky.yaw = shot.snapshot.light_yaw[views.world[view]]
    intrinsics = views.cameras.intrinsics[view]
    to_world = views.cameras.to_world[view]
    middle_ray = loop_ray(views.cameras, intrinsics, view, row, column, wp.vec2(0.0, 0.0))
    outgoing = -wp.normalize(to_world * middle_ray)
    segment = int(gbuffer.segment[view, row, column])
    if segment == Segment.NOTHING:
        return environment_radiance(scene.lights, sky.light, rotate_z(-outgoing, -sky.yaw))
    triangle = gbuffer.triangle[view, row, column]
    barycentric = gbuffer.barycentric[view, row, column]
    body = body_of(segment, views.instances)
    width = gbuffer.depth[view, row, column] / intrinsics[0]
    surface = make_table_surface(scene.meshes, scene.surfaces, bodies, view, outgoing)
    if segment != Segment.TABLE:
        surface = interpolate_surface(scene.meshes, scene.surfaces, bodies, view, body, triangle, barycentric, outgoing, width)
    else:
        position = hit_position(views.cameras, view, middle_ray, gbuffer.depth[view, row, column])
        surface = map_table(scene.surfaces, surface, position, outgoing, width)
    normal = wp.transpose(to_world) * surface.face_normal
    light = gather_light(scene, shot, denoised, sky, image, view, row, column, normal)
    wear = wear_at(scene.surfaces, surface, False)
    if segment == Segment.TABLE or samples_per_axis == 1:
        return shade_point(scene, sky, surface, wear, outgoing, light)
    corners = camera_triangle(scene.meshes, bodies, view, body, triangle)
    orientation = wp.sign(sum_of(edge_areas(corners, middle_ray)))
    center = wp.vec3(barycentric[0], barycentric[1], 1.0 - barycentric[0] - barycentric[1])
    samples = samples_per_axis * samples_per_axis
    total = wp.vec3(0.0)
    for sample in range(samples):
        ray = loop_ray(views.cameras, intrinsics, view, row, column, sample_offset(sample, samples_per_axis))
        weights, moved = move_weights(center, orientation, edge_areas(corners, ray))
        outgoing = -wp.normalize(views.cameras.to_world[view] * ray)
        # A sample that stays at the center has the footprint of a whole pixel.
        footprint_scale = 1.0 - moved * (1.0 - 1.0 / float(samples_per_axis))
        point = wp.vec2(weights[0], weights[1])
        surface = interpolate_surface(scene.meshes, scene.surfaces, bodies, view, body, triangle, point, outgoing, footprint_scale * width)
        total += shade_point(scene, sky, surface, wear, outgoing, light)
    return total / float(samples)


def kernel_of_shading(name: str, samples_per_axis: int, registers: int) -> Any:
    """Kernel of `shade_pixel`. Before, `radiance` holds the visible fractions of lamps at shadow edges, see `filter_shadow_edges_kernel`.
    Clears `resolve` for anti-aliasing. Launched over view, pixel (tile order, from flat index `first` on)."""

    @kernel_of_views(name=name, cuda_max_registers=registers)
    def shade_pixels_kernel(scene: AnyScene, shot: AnyShot, denoised: DenoisedLight, first: int, image_inout: ShadedImage):
        """`shade_pixel` of each pixel."""
        view, row, column = tile_pixel(shot.grid, wp.tid() + first)
        if in_image(shot.grid, row, column) and needs(shot.grid, image_inout.passes, SHADE_PASS, view, row, column):
            image_inout.radiance[view, row, column] = shade_pixel(
                scene, shot, denoised, image_inout, view, row, column, wp.static(samples_per_axis)
            )
            image_inout.resolve[view, row, column] = wp.uint32(0)

    return shade_pixels_kernel


shade_kernel = kernel_of_shading("shade_kernel", 1, SHADE_REGISTERS)
"""Shade each pixel at its center, in the upsampled denoised light."""
shade_samples_kernel = kernel_of_shading("shade_samples_kernel", int(SAMPLES_PER_AXIS), SAMPLE_SHADE_REGISTERS)
"""The same, but bodies with several shading samples a pixel."""
