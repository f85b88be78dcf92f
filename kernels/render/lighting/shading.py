"""From surfaces to linear radiance."""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.brdf import Brdf, Gloss, brdf_at, evaluate_disc
from synpick_warp.kernels.render.lighting.coarse_grid import CellGrid, Guide
from synpick_warp.kernels.render.lighting.denoise import Shares, gathered_share
from synpick_warp.kernels.render.lighting.environment import Lights, background_radiance, turned
from synpick_warp.kernels.render.lighting.materials import base_color, mesh_surface, table_surface, widened_roughness
from synpick_warp.kernels.render.lighting.path_tracing import PathScene
from synpick_warp.kernels.render.lighting.plane_distance import pixel_plane
from synpick_warp.kernels.render.lighting.shadows import lit_share
from synpick_warp.kernels.render.lighting.unoccluded import Light, even_light
from synpick_warp.kernels.render.visibility.camera import Cameras, Views, camera_ray, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer, ViewBodies, body_of

wp.set_module_options({"enable_backward": False, "fast_math": True})

SHADE_REGISTERS = 80
"""Most registers of a thread that shades: it waits less than one that casts rays, and has more to keep."""


@wp.func
def lit_surface(gloss: Gloss, lights: Lights, light: int, turn: float, brdf: Brdf, share: Light, lit: float) -> wp.vec3:
    """Radiance that a surface sends to the camera: its even light times `share`, what comes from other surfaces, and the main light's
    visible share `lit`."""
    even = even_light(lights, light, turn, brdf)
    result = wp.cw_mul(brdf.diffuse, wp.cw_mul(even.diffuse, share.diffuse) + share.between) + wp.cw_mul(even.gloss, share.gloss)
    if lit > 0.0:
        to_light = turned(lights.main_direction[light], turn)
        reflected = evaluate_disc(gloss, brdf, to_light, lights.main_spread[light])
        result += lit * wp.cw_mul(reflected, lights.main_irradiance[light])
    return result


@wp.kernel(cuda_max_registers=SHADE_REGISTERS)
def shade_kernel(
    # Scene:
    scene: PathScene,
    cameras: Cameras,
    cells: CellGrid,
    shadow_cells: CellGrid,
    # State:
    light: wp.array[int],
    light_yaw: wp.array[float],
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    guide: Guide,
    shares: Shares,
    lit: wp.array3d[float],
    views: Views,
    first: int,
    # Out:
    radiance_out: wp.array3d[wp.vec3],
):
    """Radiance of each pixel, from its own surface and the light that was gathered around it."""
    view, row, column = tile_pixel(cells.image, wp.tid() + first)
    if not in_image(cells.image, row, column):
        return
    camera = views.camera[view]
    which = light[views.world[view]]
    turn = light_yaw[views.world[view]]
    intrinsics = cameras.intrinsics[camera]
    ray = camera_ray(intrinsics, row, column, wp.vec2(0.0, 0.0))
    outgoing = -wp.normalize(cameras.to_world[camera] * ray)
    segment = int(gbuffer.segment[view, row, column])
    if segment == Segment.NOTHING:
        radiance_out[view, row, column] = background_radiance(scene.lights, which, turned(-outgoing, -turn))
        return
    depth = gbuffer.depth[view, row, column]
    surface = table_surface(scene.meshes, outgoing)
    if segment != Segment.TABLE:
        triangle = gbuffer.triangle[view, row, column]
        barycentric = gbuffer.barycentric[view, row, column]
        body = body_of(segment, views.instances)
        width = depth / intrinsics[0]
        surface = mesh_surface(scene.meshes, scene.surfaces, bodies, view, body, triangle, barycentric, outgoing, width)
    color = base_color(scene.surfaces, surface)
    metallic = scene.surfaces.metallic[surface.row]
    roughness = widened_roughness(scene.surfaces.roughness[surface.row], surface.spread)
    brdf = brdf_at(scene.surfaces.gloss, color, metallic, roughness, surface.normal, outgoing)
    normal = wp.transpose(cameras.to_world[camera]) * surface.face_normal
    plane = pixel_plane(intrinsics, row, column, gbuffer.segment[view, row, column], depth, normal)
    share = gathered_share(guide, shares, cells, view, row, column, plane)
    sun = float(0.0)
    if wp.max(scene.lights.main_irradiance[which]) > 0.0:
        if wp.dot(surface.face_normal, turned(scene.lights.main_direction[which], turn)) > 0.0:
            sun = lit_share(gbuffer, lit, shadow_cells, view, row, column, plane)
    radiance_out[view, row, column] = lit_surface(scene.surfaces.gloss, scene.lights, which, turn, brdf, share, sun)
