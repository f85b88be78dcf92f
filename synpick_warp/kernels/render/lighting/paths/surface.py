"""Surfaces of coarse pixels from the G-buffer, and the guide image that the denoiser reads."""

import warp as wp

from synpick_warp.kernels.render.lighting.coarse_grid import CoarseGrid, Guide, middle_pixel, pack_surface
from synpick_warp.kernels.render.visibility.camera import AnyCameras, camera_ray, hit_position
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer, Hit, read_hit
from synpick_warp.kernels.render.visibility.records import write_record

wp.set_module_options({"enable_backward": False, "fast_math": True})


@wp.struct
class CoarseSurface:
    """Hit, position, direction to the camera and footprint at the middle pixel of a coarse pixel."""

    hit: Hit
    position: wp.vec3
    """[m]"""
    outgoing: wp.vec3
    """Unit vector to the camera."""
    width: float
    """Width of the coarse pixel across the ray [m]."""


@wp.func
def coarse_surface(cameras: AnyCameras, coarse: CoarseGrid, gbuffer: GBuffer, view: int, row: int, column: int) -> CoarseSurface:
    """Surface that a coarse pixel shows: hit, position, direction to the camera and footprint, read from the G-buffer at its
    middle pixel.
    """
    pixel = middle_pixel(coarse, row, column)
    ray = camera_ray(cameras, view, pixel[0], pixel[1], wp.vec2(0.0, 0.0))
    surface = CoarseSurface()
    surface.hit = read_hit(gbuffer, view, pixel[0], pixel[1])
    surface.position = hit_position(cameras, view, ray, surface.hit.depth)
    surface.outgoing = -wp.normalize(cameras.to_world[view] * ray)
    surface.width = float(coarse.size) * surface.hit.depth / cameras.intrinsics[view][0]
    return surface


@wp.func
def write_guide(guide: Guide, to_world: wp.mat33, index: int, hit: Hit, normal: wp.vec3):
    """Write the guide image of a coarse pixel that shows a surface, by its `flat_index`; `normal` is in the world."""
    write_record(guide.surface, index, pack_surface(hit.segment, hit.depth, wp.transpose(to_world) * normal))
