"""The surface at a hit: position, normals, base colour from mip-mapped textures."""

import warp as wp

from synpick_warp.kernels.render.lighting.brdf import Gloss
from synpick_warp.kernels.render.visibility.gbuffer import FIXTURES, Meshes, ViewBodies, triangle_normal

wp.set_module_options({"enable_backward": False})

PIXEL_VARIANCE = wp.constant(1.0 / 12.0)
"""Of a place in a pixel along an axis [px²]."""
MOST_WIDENING = wp.constant(0.18)
"""Largest increase of the squared GGX width by what a pixel's normals differ (Tokuyoshi and Kaplanyan, 2019)."""
MIN_TILT = wp.constant(0.1)
"""Bounds how far a pixel stretches on a surface seen edge-on."""


@wp.struct
class Surfaces:
    """Constant, one row a mesh and a last one for the table; triangles, in the order of `Meshes`, and texels lie one after the other."""

    normal: wp.array[wp.vec3]
    """Of each corner of each triangle, as `Meshes.corner` has them."""
    uv: wp.array[wp.vec2]
    uv_density: wp.array[float]
    """Texture lengths per metre, one a triangle."""
    bend: wp.array[float]
    """How fast the interpolated normal turns along the triangle, both ways together [rad/m], one a triangle."""
    color: wp.array[wp.vec3]
    """Base colour, linear."""
    metallic: wp.array[float]
    roughness: wp.array[float]
    texture_size: wp.array[wp.vec2i]
    """Width and height of the finest level; 0, 0: no texture."""
    first_texel: wp.array2d[int]
    """Where each mip level starts (mesh, level)."""
    texture_levels: wp.array[int]
    texel: wp.array[wp.uint32]
    """sRGB, red in the lowest byte: one load brings all three."""
    linear: wp.array[float]
    """The linear value of each of the 256 sRGB values."""
    gloss: Gloss
    """What glossy lobes reflect, of any surface."""


@wp.struct
class Surface:
    """What shading knows of one hit."""

    row: int
    """Row of `Surfaces`."""
    face_normal: wp.vec3
    """The triangle's, towards the camera."""
    normal: wp.vec3
    """Interpolated, towards the camera."""
    uv: wp.vec2
    uv_footprint: float
    """Width of the pixel on the surface, in texture lengths."""
    spread: float
    """How far apart the normals in the pixel point [rad]."""


@wp.func
def towards(normal: wp.vec3, reference: wp.vec3) -> wp.vec3:
    """`normal`, or its opposite if that points more to `reference`."""
    if wp.dot(normal, reference) < 0.0:
        return -normal
    return normal


@wp.func
def table_surface(meshes: Meshes, view_direction: wp.vec3) -> Surface:
    """The table's surface; `view_direction` points to the camera."""
    result = Surface()
    result.row = meshes.entries + FIXTURES
    result.face_normal = towards(wp.vec3(0.0, 0.0, 1.0), view_direction)
    result.normal = result.face_normal
    return result


@wp.func
def mesh_surface(
    meshes: Meshes,
    surfaces: Surfaces,
    bodies: ViewBodies,
    view: int,
    body: int,
    triangle: int,
    barycentric: wp.vec2,
    view_direction: wp.vec3,
    pixel_width: float,
) -> Surface:
    """Surface at a hit. `view_direction` points to the camera; `pixel_width` [m] is the pixel's, across the ray."""
    mesh = bodies.mesh[view, body]
    to_world = wp.transpose(bodies.world_rotation[view, body])
    result = Surface()
    result.row = mesh
    result.face_normal = towards(to_world * triangle_normal(meshes, mesh, triangle), view_direction)
    number = meshes.first_triangle[mesh] + triangle
    a = 3 * number
    b = a + 1
    c = a + 2
    u = barycentric[0]
    v = barycentric[1]
    w = 1.0 - u - v
    smooth = to_world * (u * surfaces.normal[a] + v * surfaces.normal[b] + w * surfaces.normal[c])
    result.normal = result.face_normal
    if wp.length_sq(smooth) > 0.0:
        result.normal = wp.normalize(towards(smooth, result.face_normal))
    result.uv = u * surfaces.uv[a] + v * surfaces.uv[b] + w * surfaces.uv[c]
    # A tilted pixel is longer one way only; the root is its mean stretch.
    tilt = wp.sqrt(wp.max(wp.dot(result.face_normal, view_direction), MIN_TILT))
    result.uv_footprint = pixel_width / tilt * surfaces.uv_density[number]
    result.spread = pixel_width / tilt * surfaces.bend[number]
    return result


@wp.func
def texel_color(surfaces: Surfaces, index: int) -> wp.vec3:
    texel = int(surfaces.texel[index])
    return wp.vec3(surfaces.linear[texel & 255], surfaces.linear[(texel >> 8) & 255], surfaces.linear[(texel >> 16) & 255])


@wp.func
def level_color(surfaces: Surfaces, row: int, level: int, uv: wp.vec2) -> wp.vec3:
    """Bilinear look-up in one mip level. v grows upward, row 0 is the image's top; the texture repeats."""
    size = surfaces.texture_size[row]
    width = wp.max(size[0] >> level, 1)
    height = wp.max(size[1] >> level, 1)
    x = (uv[0] - wp.floor(uv[0])) * float(width) - 0.5
    y = (1.0 - uv[1] - wp.floor(1.0 - uv[1])) * float(height) - 0.5
    left = int(wp.floor(x))
    top = int(wp.floor(y))
    right_share = x - float(left)
    lower_share = y - float(top)
    # Both are at least -1 and less than the level's size; a division for the remainder would cost more than the texels.
    right = wp.where(left + 1 == width, 0, left + 1)
    bottom = wp.where(top + 1 == height, 0, top + 1)
    left = wp.where(left < 0, width - 1, left)
    top = wp.where(top < 0, height - 1, top)
    first = surfaces.first_texel[row, level]
    return wp.lerp(
        wp.lerp(texel_color(surfaces, first + top * width + left), texel_color(surfaces, first + top * width + right), right_share),
        wp.lerp(texel_color(surfaces, first + bottom * width + left), texel_color(surfaces, first + bottom * width + right), right_share),
        lower_share,
    )


@wp.func
def base_color(surfaces: Surfaces, surface: Surface) -> wp.vec3:
    """Linear base colour: material times texture, trilinear between the two mip levels whose texels are as wide as the pixel."""
    color = surfaces.color[surface.row]
    size = surfaces.texture_size[surface.row]
    if size[0] == 0:
        return color
    texels = surface.uv_footprint * wp.sqrt(float(size[0]) * float(size[1]))
    last = surfaces.texture_levels[surface.row] - 1
    level = wp.clamp(wp.log2(wp.max(texels, 1.0e-6)), 0.0, float(last))
    lower = int(level)
    upper = wp.min(lower + 1, last)
    fine = level_color(surfaces, surface.row, lower, surface.uv)
    coarse = level_color(surfaces, surface.row, upper, surface.uv)
    return wp.cw_mul(color, wp.lerp(fine, coarse, level - float(lower)))


@wp.func
def widened_roughness(roughness: float, spread: float) -> float:
    """Roughness of what a pixel shows whose normals lie so far apart: a lobe as wide as all of theirs (Kaplanyan et al., 2016)."""
    alpha = roughness * roughness
    return wp.sqrt(wp.sqrt(wp.min(alpha * alpha + wp.min(PIXEL_VARIANCE * spread * spread, MOST_WIDENING), 1.0)))
