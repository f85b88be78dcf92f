"""Surfaces of all meshes on the device: materials, textures, maps and shading normals, and the shading data of a surface at a hit."""

from typing import Any

import warp as wp

from synpick_warp.kernels.render.lighting.brdf import AlbedoTables
from synpick_warp.kernels.render.lighting.labels import Label
from synpick_warp.kernels.render.visibility.variants import VARIANTS, variant_of

wp.set_module_options({"enable_backward": False})

TEXEL_BITS = wp.constant(10)
"""Bits of a texel's channel in gamma 2.0: the square root of the linear value, decoded by one multiplication. Its steps are at most a third
of those of 8-bit sRGB."""
TEXEL_MASK = wp.constant((1 << 10) - 1)
"""Largest value of a texel's channel."""
TEXEL_SCALE = wp.constant(1.0 / ((1 << 10) - 1) ** 2)
"""Scale of a squared channel to a linear value from 0 to 1."""
TEXEL_WIDTH = wp.constant(0.57735)
"""Texel width of the selected mip level, relative to the pixel's footprint: 1 / sqrt(3). The kernel of a bilinear look-up in box-filtered
texels has a variance of 1/6 + 1/12 = 1/4 texel²; at this width that is the variance of a one-pixel box filter, 1/12 px². With texels one
pixel wide, textures would be blurred."""
OPACITY_SHIFT, OPACITY_MASK = wp.constant(30), wp.constant(3)
"""Place of a texel's opacity above its colour, read of `RandomizedSurfaces` alone, and its largest value."""
NORMAL_MAP, ROUGHNESS_MAP, METALLIC_MAP, GLOW_MAP = wp.constant(1), wp.constant(2), wp.constant(4), wp.constant(8)
"""Bits of `Surfaces.maps`."""
NORMAL_ZERO = wp.constant(512)
"""Packed value of 0 of a map's normal."""
NORMAL_STEPS = wp.constant(511.0)
"""Steps of a map's normal from 0 to 1."""
ROUGHNESS_SHIFT, ROUGHNESS_MASK = wp.constant(20), wp.constant(127)
"""Place of a map's roughness among the bits of a texel, and its largest packed value."""
METALLIC_SHIFT, METALLIC_MASK = wp.constant(27), wp.constant(31)
"""The same of a map's metallic."""
MIN_TILT = wp.constant(0.1)
"""Lower bound of the cosine between surface normal and view direction, which limits a pixel's footprint at grazing angles."""
TRIANGLE_RECORDS = wp.constant(5)
"""Number of 16-byte records per triangle in `Surfaces.triangle`."""


@wp.struct
class Surfaces:
    """Materials, textures and shading normals of all meshes. Constant.

    Rows called material are those of `Meshes`, and one for the table.
    """

    triangle: wp.array[wp.vec4]
    """(TRIANGLE_RECORDS x triangle): shading data, triangles in the order of `Meshes.corner`. Records 0 to 2: vertex normal and texture
    coordinate u of corners a, b, c. Record 3: texture coordinates v of a, b, c; texture density [texture widths per metre]. Record 4: face
    normal, as in `Meshes.face_normal`; Frobenius norm of the gradient of the interpolated normal [rad/m]."""
    color: wp.array[wp.vec3]
    """(material): base colour, linear."""
    metallic: wp.array[float]
    """(material)."""
    roughness: wp.array[float]
    """(material): perceptual; the GGX width is its square."""
    texture_size: wp.array[wp.vec2i]
    """(material): width and height of the finest mip level; 0, 0: no texture."""
    first_texel: wp.array2d[int]
    """(material, level): index of the first texel of a mip level."""
    texture_levels: wp.array[int]
    """(material): number of mip levels."""
    texel: wp.array[wp.uint32]
    """(texel): square roots of linear red, green and blue in TEXEL_BITS bits each, red in the lowest, so that one load reads all."""
    maps: wp.array[int]
    """(material): NORMAL_MAP, ROUGHNESS_MAP and METALLIC_MAP: which maps `detail` has in place of the values above; GLOW_MAP: there is an
    emission texture."""
    detail: wp.array[wp.uint32]
    """(texel): x and y of the normal in the triangle's tangent frame, roughness and metallic, packed as `stages.render.scene.pack_details`
    does; read by `RandomizedSurfaces` alone."""
    albedo: AlbedoTables
    """Directional albedo of the specular lobe, the same for all surfaces."""


RandomizedSurfaces = variant_of(
    Surfaces,
    "RandomizedSurfaces",
    row=wp.array2d[int],
    recolor=wp.array[wp.mat33],
    repeats=wp.array[float],
    wear=wp.array[wp.vec4],
    pattern=wp.array[int],
    noise=wp.array3d[wp.uint32],
    glass=wp.array[wp.vec3],
    label=wp.array[Label],
    emission=wp.array[wp.vec3],
    glow=wp.array[wp.uint32],
    finish=wp.array[wp.vec4],
)
"""Surfaces with maps, or whose materials each episode draws at random (`looks`): constant, but for the materials of views.

More rows called material follow: one for each texture that episodes draw from, and one for each body of each view. `row` is that of a
body's material (view, body, then the table and the floor), `recolor` the matrix on the linear base colour of a material, whose result is
clamped to 0..1, and `repeats` the factor on its texture coordinates; `wear` are the amounts of `lighting.wear`, whose noise is the
table `noise`, in a part that the seed `pattern` draws; `glass` is transmission, index of refraction, and thickness [m]; `label` the place
of the body's label, whose print has the same seed; `emission` is the light that it emits, in units of the white of a picture, and `glow`
(texel) a factor on it, packed as `texel`; `finish` are clearcoat, its roughness, anisotropy and its rotation [rad], read of
`FinishedSurfaces` alone."""
FinishedSurfaces = variant_of(RandomizedSurfaces, "FinishedSurfaces")
AnySurfaces = Any
"""`Surfaces`, `RandomizedSurfaces` or `FinishedSurfaces`: functions are compiled for each; see `variants`."""
VARIANTS["surfaces"] = Surfaces, RandomizedSurfaces, FinishedSurfaces


@wp.struct
class Surface:
    """Material row, geometric and interpolated normal, and texture coordinates with their footprint, at one hit."""

    row: int
    face_normal: wp.vec3
    """Geometric normal, towards the viewer."""
    normal: wp.vec3
    """Interpolated normal, towards the viewer."""
    uv: wp.vec2
    uv_footprint: float
    """Width of the pixel's footprint on the surface, in texture lengths."""
    normal_spread: float
    """Change of the normal across the pixel's footprint [rad]."""
    tangent: wp.vec4
    """Direction of growing u in the world, not normalized, and the side of growing v: 1 or -1 times the cross product of normal and
    direction; zero without maps, or where u does not grow."""
    place: wp.vec3
    """Position in the body's frame, in the unit of `lighting.wear`; zero without wear."""
    place_footprint: float
    """Width of the pixel's footprint on the surface, in the same unit."""
    label: wp.vec3
    """Coordinates on the body's label, and the pixel's width in half widths of it; a width of 0: the surface shows none."""


@wp.struct
class SurfaceMaterial:
    """Material of a surface at one hit: linear base colour of what it does not transmit, metallic, perceptual roughness, shading normal
    towards the viewer, transmission, and emission."""

    color: wp.vec3
    metallic: float
    roughness: float
    normal: wp.vec3
    transmission: float
    emission: wp.vec3


@wp.func
def add_emission(surfaces: Surfaces, radiance: wp.vec3, emission: wp.vec3, exposure: float) -> wp.vec3:
    """Radiance of a surface with what it emits, if its material may emit light; `exposure` is that of the environment map."""
    return radiance


@wp.func
def add_emission(surfaces: AnySurfaces, radiance: wp.vec3, emission: wp.vec3, exposure: float) -> wp.vec3:  # noqa: F811
    """Radiance of a surface with what it emits: an emission of 1 is the white of a picture."""
    return radiance + emission / exposure
