"""Deferred shading: radiance of each pixel from the G-buffer, denoised visibility ratios, indirect light and sun visibility."""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.brdf import AlbedoTables, Brdf, evaluate_disc, make_brdf
from synpick_warp.kernels.render.lighting.coarse_grid import CoarseGrid
from synpick_warp.kernels.render.lighting.environment import Lights, environment_radiance, rotate_z
from synpick_warp.kernels.render.lighting.materials import interpolate_surface, make_table_surface, sample_base_color, widen_roughness
from synpick_warp.kernels.render.lighting.path_tracing import PathScene
from synpick_warp.kernels.render.lighting.plane_distance import tangent_plane
from synpick_warp.kernels.render.lighting.shadows import upsample_shadow
from synpick_warp.kernels.render.lighting.unoccluded import unoccluded_light
from synpick_warp.kernels.render.lighting.upsampling import RatioImages, Ratios, upsample_ratios
from synpick_warp.kernels.render.visibility.camera import Cameras, Views, camera_ray, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer, ViewBodies, body_of
from synpick_warp.kernels.tuning import SHADE_REGISTERS

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.func
def shade_surface(tables: AlbedoTables, lights: Lights, light: int, yaw: float, brdf: Brdf, ratios: Ratios, sun: float) -> wp.vec3:
    """Radiance towards the camera: unoccluded light times its visibility `ratios`, indirect light, and sunlight times visibility `sun`."""
    unoccluded = unoccluded_light(lights, light, yaw, brdf)
    result = wp.cw_mul(brdf.diffuse, wp.cw_mul(unoccluded.diffuse, ratios.diffuse) + ratios.indirect) + wp.cw_mul(
        unoccluded.specular, ratios.specular
    )
    if sun > 0.0:
        to_sun = rotate_z(lights.sun_direction[light], yaw)
        reflected = evaluate_disc(tables, brdf, to_sun, lights.sun_radius[light])
        result += sun * wp.cw_mul(reflected, lights.sun_irradiance[light])
    return result


@wp.kernel(cuda_max_registers=SHADE_REGISTERS)
def shade_kernel(
    # Scene:
    scene: PathScene,
    cameras: Cameras,
    coarse: CoarseGrid,
    shadow_grid: CoarseGrid,
    # State: worlds
    light: wp.array[int],  # (world)
    light_yaw: wp.array[float],  # (world) [rad]
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    ratios: RatioImages,
    sun_visibility: wp.array3d[wp.uint64],  # (view, shadow_row, shadow_column)
    views: Views,
    first: int,
    # Out:
    radiance_out: wp.array3d[wp.vec3],  # (view, row, column)
):
    """Shade each pixel with its own surface and the denoised light around it; background pixels show the environment map."""
    view, row, column = tile_pixel(coarse.image, wp.tid() + first)
    if not in_image(coarse.image, row, column):
        return
    camera = views.camera[view]
    which = light[views.world[view]]
    yaw = light_yaw[views.world[view]]
    intrinsics = cameras.intrinsics[camera]
    ray = camera_ray(intrinsics, row, column, wp.vec2(0.0, 0.0))
    outgoing = -wp.normalize(cameras.to_world[camera] * ray)
    segment = int(gbuffer.segment[view, row, column])
    if segment == Segment.NOTHING:
        radiance_out[view, row, column] = environment_radiance(scene.lights, which, rotate_z(-outgoing, -yaw))
        return
    depth = gbuffer.depth[view, row, column]
    surface = make_table_surface(scene.meshes, outgoing)
    if segment != Segment.TABLE:
        triangle = gbuffer.triangle[view, row, column]
        barycentric = gbuffer.barycentric[view, row, column]
        body = body_of(segment, views.instances)
        width = depth / intrinsics[0]
        surface = interpolate_surface(scene.meshes, scene.surfaces, bodies, view, body, triangle, barycentric, outgoing, width)
    normal = wp.transpose(cameras.to_world[camera]) * surface.face_normal
    plane = tangent_plane(intrinsics, row, column, gbuffer.segment[view, row, column], depth, normal)
    sun = float(0.0)
    if wp.max(scene.lights.sun_irradiance[which]) > 0.0:
        if wp.dot(surface.face_normal, rotate_z(scene.lights.sun_direction[which], yaw)) > 0.0:
            sun = upsample_shadow(sun_visibility, shadow_grid, view, row, column, plane)
    pixel_ratios = upsample_ratios(ratios, coarse, view, row, column, plane)
    pixel_ratios.indirect = pixel_ratios.indirect / scene.lights.exposure[which]
    color = sample_base_color(scene.surfaces, surface)
    metallic = scene.surfaces.metallic[surface.row]
    roughness = widen_roughness(scene.surfaces.roughness[surface.row], surface.normal_spread)
    brdf = make_brdf(scene.surfaces.albedo, color, metallic, roughness, surface.normal, outgoing)
    radiance_out[view, row, column] = shade_surface(scene.surfaces.albedo, scene.lights, which, yaw, brdf, pixel_ratios, sun)
