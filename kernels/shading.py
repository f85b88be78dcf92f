"""From surfaces to linear radiance."""

import warp as wp

from synpick_warp.kernels.brdf import MIN_ALPHA, brdf_at, coat_share, evaluate, even_gloss
from synpick_warp.kernels.camera_rays import Cameras, ImageGrid, camera_ray, tile_pixel
from synpick_warp.kernels.environment import Lights, background_radiance, diffuse_irradiance, reflected_radiance, turned
from synpick_warp.kernels.hits import NOTHING, TABLE, Bodies, Hits, Meshes, body_of
from synpick_warp.kernels.occlusion import CELL, Sample, filtered_occlusion, is_wide
from synpick_warp.kernels.surfaces import Surface, Surfaces, base_color, mesh_surface, table_surface

wp.set_module_options({"enable_backward": False})

INTERREFLECTION = wp.constant(0.15)
"""What hides the sky shines itself, with about this share of the sky's light: an albedo of 0.3 that sees half of it."""


@wp.func
def ambient_share(visible: float, albedo: float) -> float:
    """Share of ambient light that arrives, with light reflected between near surfaces of the same albedo (Jimenez et al., 2016)."""
    a = 2.0404 * albedo - 0.3324
    b = -4.7951 * albedo + 0.6417
    c = 2.7552 * albedo + 0.6903
    return wp.max(visible, ((visible * a + b) * visible + c) * visible)


@wp.func
def lit_surface(
    surfaces: Surfaces,
    surface: Surface,
    lights: Lights,
    light: int,
    turn: float,
    to_camera: wp.vec3,
    lit: float,
    ambient: float,
) -> wp.vec3:
    """Radiance that a surface sends to the camera: main light and environment, by the law of `kernels.brdf`.

    What the law says of even light from everywhere is applied to the environment: diffuse to its irradiance, gloss to what the
    surface mirrors, blurred.
    """
    base = base_color(surfaces, surface)
    roughness = surfaces.roughness[surface.row]
    brdf = brdf_at(surfaces.gloss, base, surfaces.metallic[surface.row], roughness, surface.normal, to_camera)
    n_v = wp.dot(brdf.normal, to_camera)

    sky = diffuse_irradiance(lights, light, turned(brdf.normal, -turn))
    open_share = ambient + INTERREFLECTION * (1.0 - ambient)
    arriving = wp.vec3(
        sky[0] * ambient_share(open_share, base[0]),
        sky[1] * ambient_share(open_share, base[1]),
        sky[2] * ambient_share(open_share, base[2]),
    )
    mirrored = 2.0 * n_v * brdf.normal - to_camera
    # Glossy occlusion from diffuse occlusion (Lagarde and de Rousiers, 2014).
    glossy = wp.clamp(wp.pow(n_v + open_share, wp.pow(2.0, -16.0 * roughness - 1.0)) - 1.0 + open_share, 0.0, 1.0)
    result = ((1.0 - coat_share(brdf, brdf.albedo)) / wp.PI) * wp.cw_mul(brdf.diffuse, arriving)
    result += glossy * wp.cw_mul(even_gloss(brdf), reflected_radiance(lights, light, turned(mirrored, -turn), roughness))

    if lit > 0.0:
        # The light's disc widens the highlight.
        brdf.alpha = wp.clamp(roughness * roughness + 0.5 * lights.main_spread[light], MIN_ALPHA, 1.0)
        to_light = turned(lights.main_direction[light], turn)
        result += lit * wp.cw_mul(evaluate(surfaces.gloss, brdf, to_light), lights.main_irradiance[light])
    return result


@wp.kernel
def shade_kernel(
    # Scene:
    meshes: Meshes,
    surfaces: Surfaces,
    cameras: Cameras,
    grid: ImageGrid,
    lights: Lights,
    # State:
    light: wp.array[int],
    light_turn: wp.array[float],
    # In:
    bodies: Bodies,
    hits: Hits,
    occlusion: wp.array3d[wp.vec2],
    view_world: wp.array[int],
    view_camera: wp.array[int],
    instances: int,
    sample: Sample,
    first: int,
    # Out:
    radiance_inout: wp.array3d[wp.vec3],
):
    """Add a sample's share to the radiance of each pixel; sample 0 replaces what was there."""
    pixel = tile_pixel(grid, wp.tid() + first)
    view = pixel[0]
    row = pixel[1]
    column = pixel[2]
    if row >= grid.height or column >= grid.width:
        return
    camera = view_camera[view]
    world = view_world[view]
    ray = camera_ray(cameras.intrinsics[camera], row, column, sample.offset)
    to_camera = -wp.normalize(cameras.to_world[camera] * ray)
    code = int(hits.code[view, row, column])
    depth = hits.depth[view, row, column]
    radiance = wp.vec3(0.0, 0.0, 0.0)
    if code == NOTHING:
        radiance = background_radiance(lights, light[world], turned(-to_camera, -light_turn[world]))
    else:
        width = depth / cameras.intrinsics[camera][0]
        surface = table_surface(meshes, to_camera)
        if code != TABLE:
            triangle = hits.triangle[view, row, column]
            barycentric = hits.barycentric[view, row, column]
            footprint = sample.footprint * width
            body = body_of(code, instances)
            surface = mesh_surface(meshes, surfaces, bodies, view, body, triangle, barycentric, to_camera, footprint)
        normal = wp.transpose(cameras.to_world[camera]) * surface.face_normal
        share = filtered_occlusion(hits, occlusion, grid, cameras.intrinsics[camera], sample.offset, view, row, column, normal, CELL)
        lit = share[0]
        if not is_wide(lights.main_spread[light[world]], width):
            # Sharp shadows keep the edges that the first pass left.
            lit = occlusion[view, row, column][0]
        radiance = lit_surface(surfaces, surface, lights, light[world], light_turn[world], to_camera, lit, share[1])
    if sample.number == 0:
        radiance_inout[view, row, column] = sample.weight * radiance
    else:
        radiance_inout[view, row, column] = radiance_inout[view, row, column] + sample.weight * radiance
