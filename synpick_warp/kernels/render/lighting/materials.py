"""Surface shading data at a hit: geometric and interpolated normals, mip-mapped base colour, roughness with specular anti-aliasing."""

import warp as wp

from synpick_warp.kernels.render.lighting.brdf import MIN_ALPHA, Brdf, make_brdf
from synpick_warp.kernels.render.lighting.finish import FinishedBrdf, finish_brdf
from synpick_warp.kernels.render.lighting.labels import LABEL_ROUGHNESS, label_coordinates, label_reflectance
from synpick_warp.kernels.render.lighting.surfaces import (
    GLOW_MAP,
    METALLIC_MAP,
    METALLIC_MASK,
    METALLIC_SHIFT,
    MIN_TILT,
    NORMAL_MAP,
    NORMAL_STEPS,
    NORMAL_ZERO,
    OPACITY_MASK,
    OPACITY_SHIFT,
    ROUGHNESS_MAP,
    ROUGHNESS_MASK,
    ROUGHNESS_SHIFT,
    TEXEL_BITS,
    TEXEL_MASK,
    TEXEL_SCALE,
    TEXEL_WIDTH,
    TRIANGLE_RECORDS,
    AnySurfaces,
    FinishedSurfaces,
    Surface,
    SurfaceMaterial,
    Surfaces,
)
from synpick_warp.kernels.render.lighting.wear import WEAR_LENGTH, Wear, apply_wear, find_wear, has_wear, mean_wear
from synpick_warp.kernels.render.visibility.gbuffer import FIXTURES, Meshes, ViewBodies
from synpick_warp.kernels.render.visibility.records import read_flat_record

wp.set_module_options({"enable_backward": False})


@wp.func
def face_forward(normal: wp.vec3, reference: wp.vec3) -> wp.vec3:
    """`normal`, flipped if it points away from `reference`."""
    if wp.dot(normal, reference) < 0.0:
        return -normal
    return normal


@wp.func
def material_of(surfaces: Surfaces, view: int, body: int, mesh: int) -> int:
    """Row of the material of a body of a view, whose mesh is in row `mesh`; bodies after the last are the table and the floor."""
    return mesh


@wp.func
def material_of(surfaces: AnySurfaces, view: int, body: int, mesh: int) -> int:  # noqa: F811
    """Row of the material of a body of a view, which its episode has drawn."""
    return surfaces.row[view, body]


@wp.func
def make_table_surface(meshes: Meshes, surfaces: AnySurfaces, bodies: ViewBodies, view: int, view_direction: wp.vec3) -> Surface:
    """Shading data of the table, without texture coordinates; `view_direction` points to the viewer."""
    result = Surface()
    result.row = material_of(surfaces, view, bodies.mesh.shape[1], meshes.entries + FIXTURES)
    result.face_normal = face_forward(wp.vec3(0.0, 0.0, 1.0), view_direction)
    result.normal = result.face_normal
    return result


@wp.func
def map_table(surfaces: Surfaces, surface: Surface, position: wp.vec3, view_direction: wp.vec3, pixel_width: float) -> Surface:
    """The table's shading data with texture coordinates, the horizontal axes of the world, if its material may have a texture. Arguments as
    of `interpolate_surface`; `position` in the world [m]."""
    return surface


@wp.func
def map_table(  # noqa: F811
    surfaces: AnySurfaces, surface: Surface, position: wp.vec3, view_direction: wp.vec3, pixel_width: float
) -> Surface:
    """The table's shading data with texture coordinates."""
    result = surface
    scale = surfaces.repeats[surface.row]
    tilt = wp.sqrt(wp.max(wp.abs(view_direction[2]), MIN_TILT))
    result.uv = scale * wp.vec2(position[0], position[1])
    result.uv_footprint = scale * pixel_width / tilt
    return result


@wp.func
def repeat_texture(surfaces: Surfaces, surface: Surface) -> Surface:
    """Shading data with its texture coordinates, and their footprint, scaled as the material says."""
    return surface


@wp.func
def repeat_texture(surfaces: AnySurfaces, surface: Surface) -> Surface:  # noqa: F811
    """Shading data with its texture coordinates, and their footprint, scaled as the material says."""
    result = surface
    result.uv = surfaces.repeats[surface.row] * surface.uv
    result.uv_footprint = surfaces.repeats[surface.row] * surface.uv_footprint
    return result


@wp.func
def has_tangent(surfaces: AnySurfaces, row: int) -> bool:
    """Whether a material needs tangents: it has a normal map."""
    return (surfaces.maps[row] & NORMAL_MAP) != 0


@wp.func
def has_tangent(surfaces: FinishedSurfaces, row: int) -> bool:  # noqa: F811
    """Whether a material needs tangents: it has a normal map, or is anisotropic."""
    return (surfaces.maps[row] & NORMAL_MAP) != 0 or surfaces.finish[row][2] > 0.0


@wp.func
def place_details(
    meshes: Meshes,
    surfaces: Surfaces,
    surface: Surface,
    mesh: int,
    triangle: int,
    barycentric: wp.vec2,
    footprint: float,
    to_world: wp.mat33,
) -> Surface:
    """Shading data with tangent, place and label, of a material with maps, wear or label; `footprint` [m]: the pixel's on the surface."""
    return surface


@wp.func
def place_details(  # noqa: F811
    meshes: Meshes,
    surfaces: AnySurfaces,
    surface: Surface,
    mesh: int,
    triangle: int,
    barycentric: wp.vec2,
    footprint: float,
    to_world: wp.mat33,
) -> Surface:
    """Shading data with tangent, place and label. The tangent is that of the triangle: the edge along which only u grows."""
    result = surface
    is_worn = has_wear(surfaces.wear[surface.row])
    is_bumpy = has_tangent(surfaces, surface.row)
    label = surfaces.label[surface.row]
    is_labelled = wp.length_sq(label.normal) > 0.0
    if not is_worn and not is_bumpy and not is_labelled:
        return result
    first = meshes.first_triangle[mesh] + triangle
    a = meshes.corner[3 * first]
    edge = meshes.corner[3 * first + 1] - a
    other = meshes.corner[3 * first + 2] - a
    point = a + barycentric[1] * edge + (1.0 - barycentric[0] - barycentric[1]) * other
    if is_labelled:
        at = label_coordinates(label, point, wp.transpose(to_world) * surface.face_normal)
        if wp.max(wp.abs(at[0]), wp.abs(at[1])) < 1.0:
            result.label = wp.vec3(at[0], at[1], footprint * wp.length(label.along))
    if is_worn:
        unit = wp.min(meshes.radius[mesh], WEAR_LENGTH)
        result.place = (point - meshes.center[mesh]) / unit
        result.place_footprint = footprint / unit
    if is_bumpy:
        u = read_flat_record(surfaces.triangle, TRIANGLE_RECORDS * first)[3]
        v = read_flat_record(surfaces.triangle, TRIANGLE_RECORDS * first + 3)
        toward_b = wp.vec2(read_flat_record(surfaces.triangle, TRIANGLE_RECORDS * first + 1)[3] - u, v[1] - v[0])
        toward_c = wp.vec2(read_flat_record(surfaces.triangle, TRIANGLE_RECORDS * first + 2)[3] - u, v[2] - v[0])
        turn = wp.sign(toward_b[0] * toward_c[1] - toward_b[1] * toward_c[0])
        # A surface that is seen from behind has the map's normal turned round as a whole.
        side = wp.sign(wp.dot(to_world * wp.cross(edge, other), surface.face_normal))
        gradient = side * turn * (to_world * (toward_c[1] * edge - toward_b[1] * other))
        result.tangent = wp.vec4(gradient[0], gradient[1], gradient[2], side * turn)
    return result


@wp.func
def interpolate_surface(
    meshes: Meshes,
    surfaces: AnySurfaces,
    bodies: ViewBodies,
    view: int,
    body: int,
    triangle: int,
    barycentric: wp.vec2,
    view_direction: wp.vec3,
    pixel_width: float,
) -> Surface:
    """Interpolate the shading data of a mesh at a hit. `view_direction` points to the viewer; `pixel_width` [m] is the pixel's footprint
    across the ray."""
    mesh = bodies.mesh[view, body]
    to_world = wp.transpose(bodies.world_rotation[view, body])
    result = Surface()
    result.row = material_of(surfaces, view, body, mesh)
    first = TRIANGLE_RECORDS * (meshes.first_triangle[mesh] + triangle)
    a = read_flat_record(surfaces.triangle, first)
    b = read_flat_record(surfaces.triangle, first + 1)
    c = read_flat_record(surfaces.triangle, first + 2)
    more = read_flat_record(surfaces.triangle, first + 3)
    face = read_flat_record(surfaces.triangle, first + 4)
    result.face_normal = face_forward(to_world * wp.vec3(face[0], face[1], face[2]), view_direction)
    u = barycentric[0]
    v = barycentric[1]
    w = 1.0 - u - v
    smooth = to_world * (u * wp.vec3(a[0], a[1], a[2]) + v * wp.vec3(b[0], b[1], b[2]) + w * wp.vec3(c[0], c[1], c[2]))
    result.normal = result.face_normal
    if wp.length_sq(smooth) > 0.0:
        result.normal = wp.normalize(face_forward(smooth, result.face_normal))
    result.uv = u * wp.vec2(a[3], more[0]) + v * wp.vec2(b[3], more[1]) + w * wp.vec2(c[3], more[2])
    # A footprint on a tilted surface is longer along one axis only; the root is its mean stretch.
    tilt = wp.sqrt(wp.max(wp.dot(result.face_normal, view_direction), MIN_TILT))
    result.uv_footprint = pixel_width / tilt * more[3]
    result.normal_spread = pixel_width / tilt * face[3]
    result = place_details(meshes, surfaces, result, mesh, triangle, barycentric, pixel_width / tilt, to_world)
    return repeat_texture(surfaces, result)


@wp.func
def decode_texel(surfaces: AnySurfaces, index: int) -> wp.vec3:
    """Decode a texel: its linear colour divided by TEXEL_SCALE."""
    return unpack_texel(int(surfaces.texel[index]))


@wp.func
def unpack_texel(texel: int) -> wp.vec3:
    """Linear colour of a packed texel, divided by TEXEL_SCALE."""
    red = float(texel & TEXEL_MASK)
    green = float((texel >> TEXEL_BITS) & TEXEL_MASK)
    blue = float((texel >> (2 * TEXEL_BITS)) & TEXEL_MASK)
    return wp.vec3(red * red, green * green, blue * blue)


@wp.struct
class Taps:
    """Texels of a bilinear look-up: upper left, upper right, lower left and lower right one, and the weights of right and lower ones."""

    index: wp.vec4i
    weight: wp.vec2


@wp.func
def find_taps(surfaces: AnySurfaces, row: int, level: int, uv: wp.vec2) -> Taps:
    """Texels about a place in a mip level of a repeating texture. v grows upward, row 0 is the image's top; `row` is that of `Surfaces`."""
    size = surfaces.texture_size[row]
    width = wp.max(size[0] >> level, 1)
    height = wp.max(size[1] >> level, 1)
    x = (uv[0] - wp.floor(uv[0])) * float(width) - 0.5
    y = (1.0 - uv[1] - wp.floor(1.0 - uv[1])) * float(height) - 0.5
    left = int(wp.floor(x))
    top = int(wp.floor(y))
    taps = Taps()
    taps.weight = wp.vec2(x - float(left), y - float(top))
    # Both are at least -1 and less than the level's size; a modulo would cost more than the texels.
    right = wp.where(left + 1 == width, 0, left + 1)
    bottom = wp.where(top + 1 == height, 0, top + 1)
    left = wp.where(left < 0, width - 1, left)
    top = wp.where(top < 0, height - 1, top)
    first = surfaces.first_texel[row, level]
    taps.index = wp.vec4i(
        first + top * width + left, first + top * width + right, first + bottom * width + left, first + bottom * width + right
    )
    return taps


@wp.func
def sample_mip_level(surfaces: AnySurfaces, row: int, level: int, uv: wp.vec2) -> wp.vec3:
    """Bilinear look-up in one mip level of a repeating texture: linear colour divided by TEXEL_SCALE."""
    taps = find_taps(surfaces, row, level, uv)
    return wp.lerp(
        wp.lerp(decode_texel(surfaces, taps.index[0]), decode_texel(surfaces, taps.index[1]), taps.weight[0]),
        wp.lerp(decode_texel(surfaces, taps.index[2]), decode_texel(surfaces, taps.index[3]), taps.weight[0]),
        taps.weight[1],
    )


@wp.func
def sample_base_color(surfaces: Surfaces, surface: Surface) -> wp.vec3:
    """Linear base colour: material colour times texture, changed by the material's matrix if there is one."""
    return sample_texture(surfaces, surface)


@wp.func
def sample_base_color(surfaces: AnySurfaces, surface: Surface) -> wp.vec3:  # noqa: F811
    """Linear base colour: material colour times texture, changed by the material's matrix."""
    turned = surfaces.recolor[surface.row] * sample_texture(surfaces, surface)
    return wp.vec3(wp.clamp(turned[0], 0.0, 1.0), wp.clamp(turned[1], 0.0, 1.0), wp.clamp(turned[2], 0.0, 1.0))


@wp.func
def mip_level(surfaces: AnySurfaces, surface: Surface) -> float:
    """Mip level of a look-up, between levels, by TEXEL_WIDTH; the material must have a texture."""
    size = surfaces.texture_size[surface.row]
    texels = TEXEL_WIDTH * surface.uv_footprint * wp.sqrt(float(size[0]) * float(size[1]))
    return wp.clamp(wp.log2(wp.max(texels, 1.0e-6)), 0.0, float(surfaces.texture_levels[surface.row] - 1))


@wp.func
def sample_texture(surfaces: AnySurfaces, surface: Surface) -> wp.vec3:
    """Material colour times texture, linear, filtered trilinearly at the mip level given by TEXEL_WIDTH."""
    color = surfaces.color[surface.row]
    if surfaces.texture_size[surface.row][0] == 0:
        return color
    level = mip_level(surfaces, surface)
    lower = int(level)
    upper = wp.min(lower + 1, surfaces.texture_levels[surface.row] - 1)
    fine = sample_mip_level(surfaces, surface.row, lower, surface.uv)
    coarse = sample_mip_level(surfaces, surface.row, upper, surface.uv)
    return TEXEL_SCALE * wp.cw_mul(color, wp.lerp(fine, coarse, level - float(lower)))


@wp.func
def decode_detail(surfaces: AnySurfaces, index: int) -> wp.vec4:
    """Unpack a texel of the maps: x and y of the normal, roughness, metallic."""
    texel = int(surfaces.detail[index])
    x = float((texel & TEXEL_MASK) - NORMAL_ZERO)
    y = float(((texel >> TEXEL_BITS) & TEXEL_MASK) - NORMAL_ZERO)
    roughness = float((texel >> ROUGHNESS_SHIFT) & ROUGHNESS_MASK)
    return wp.vec4(
        x / NORMAL_STEPS,
        y / NORMAL_STEPS,
        roughness / float(ROUGHNESS_MASK),
        float((texel >> METALLIC_SHIFT) & METALLIC_MASK) / float(METALLIC_MASK),
    )


@wp.func
def sample_details(surfaces: AnySurfaces, surface: Surface) -> wp.vec4:
    """Trilinear look-up of the maps: x and y of the normal in the tangent frame, roughness, metallic."""
    level = mip_level(surfaces, surface)
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for step in range(2):
        at = wp.min(int(level) + step, surfaces.texture_levels[surface.row] - 1)
        taps = find_taps(surfaces, surface.row, at, surface.uv)
        upper = wp.lerp(decode_detail(surfaces, taps.index[0]), decode_detail(surfaces, taps.index[1]), taps.weight[0])
        lower = wp.lerp(decode_detail(surfaces, taps.index[2]), decode_detail(surfaces, taps.index[3]), taps.weight[0])
        share = level - float(int(level))
        total += wp.where(step == 0, 1.0 - share, share) * wp.lerp(upper, lower, taps.weight[1])
    return total


@wp.func
def bump_normal(surface: Surface, x: float, y: float) -> wp.vec3:
    """Normal mapping in a tangent frame, as in glTF 2.0: the interpolated normal, tilted by x along u and y along v."""
    along = wp.vec3(surface.tangent[0], surface.tangent[1], surface.tangent[2])
    along -= wp.dot(along, surface.normal) * surface.normal
    if wp.length_sq(along) == 0.0:
        return surface.normal
    along = wp.normalize(along)
    across = surface.tangent[3] * wp.cross(surface.normal, along)
    height = wp.sqrt(wp.max(1.0 - x * x - y * y, 0.0))
    return wp.normalize(x * along + y * across + height * surface.normal)


@wp.func
def texel_opacity(surfaces: AnySurfaces, index: int) -> float:
    """Opacity of a texel, 0 to 1."""
    return float((surfaces.texel[index] >> wp.uint32(OPACITY_SHIFT)) & wp.uint32(OPACITY_MASK)) / float(OPACITY_MASK)


@wp.func
def transmission_at(surfaces: AnySurfaces, surface: Surface) -> float:
    """Transmission at a hit: that of its row, less what its texels lack, by a bilinear look-up in the nearest mip level."""
    transmission = surfaces.glass[surface.row][0]
    if transmission == 0.0 or surfaces.texture_size[surface.row][0] == 0:
        return transmission
    taps = find_taps(surfaces, surface.row, int(mip_level(surfaces, surface) + 0.5), surface.uv)
    upper = wp.lerp(texel_opacity(surfaces, taps.index[0]), texel_opacity(surfaces, taps.index[1]), taps.weight[0])
    lower = wp.lerp(texel_opacity(surfaces, taps.index[2]), texel_opacity(surfaces, taps.index[3]), taps.weight[0])
    return transmission * (1.0 - wp.lerp(upper, lower, taps.weight[1]))


@wp.func
def emission_at(surfaces: AnySurfaces, surface: Surface) -> wp.vec3:
    """Emission at a hit: that of its row, times its texture by a bilinear look-up in the nearest mip level."""
    emission = surfaces.emission[surface.row]
    if wp.max(emission) == 0.0 or (surfaces.maps[surface.row] & GLOW_MAP) == 0:
        return emission
    taps = find_taps(surfaces, surface.row, int(mip_level(surfaces, surface) + 0.5), surface.uv)
    total = wp.vec3(0.0, 0.0, 0.0)
    for tap in range(4):
        right = wp.where(tap % 2 == 0, 1.0 - taps.weight[0], taps.weight[0])
        down = wp.where(tap < 2, 1.0 - taps.weight[1], taps.weight[1])
        total += right * down * unpack_texel(int(surfaces.glow[taps.index[tap]]))
    return TEXEL_SCALE * wp.cw_mul(emission, total)


@wp.func
def wear_at(surfaces: Surfaces, surface: Surface, is_mean: bool) -> Wear:
    """Wear of a surface in a pixel: none."""
    return Wear()


@wp.func
def wear_at(surfaces: AnySurfaces, surface: Surface, is_mean: bool) -> Wear:  # noqa: F811
    """Wear of a surface in a pixel, by the amounts of its row, or its mean over the whole surface."""
    amount = surfaces.wear[surface.row]
    if is_mean:
        return mean_wear(amount)
    if has_wear(amount):
        return find_wear(surfaces.noise, amount, surfaces.pattern[surface.row], surface.place, surface.place_footprint)
    return Wear()


@wp.func
def material_at(surfaces: Surfaces, surface: Surface, wear: Wear) -> SurfaceMaterial:
    """Material at a hit: that of its row, and the interpolated normal."""
    result = SurfaceMaterial()
    result.color = sample_base_color(surfaces, surface)
    result.metallic = surfaces.metallic[surface.row]
    result.roughness = surfaces.roughness[surface.row]
    result.normal = surface.normal
    return result


@wp.func
def material_at(surfaces: AnySurfaces, surface: Surface, wear: Wear) -> SurfaceMaterial:  # noqa: F811
    """Material at a hit, by its row or maps, changed by `wear`, which all samples of a pixel share. Labels are opaque, and so is metal."""
    result = SurfaceMaterial()
    result.transmission = transmission_at(surfaces, surface)
    result.metallic = surfaces.metallic[surface.row]
    result.roughness = surfaces.roughness[surface.row]
    result.normal = surface.normal
    maps = surfaces.maps[surface.row]
    if maps != 0:
        details = sample_details(surfaces, surface)
        if (maps & NORMAL_MAP) != 0:
            result.normal = bump_normal(surface, details[0], details[1])
        if (maps & ROUGHNESS_MAP) != 0:
            result.roughness = details[2]
        if (maps & METALLIC_MAP) != 0:
            result.metallic = details[3]
            result.transmission = result.transmission * (1.0 - result.metallic)
    result.color = (1.0 - result.transmission) * sample_base_color(surfaces, surface)
    result.emission = emission_at(surfaces, surface)
    if surface.label[2] > 0.0:
        result.transmission = 0.0
        result.emission = wp.vec3(0.0, 0.0, 0.0)
        shade = label_reflectance(surfaces.pattern[surface.row], wp.vec2(surface.label[0], surface.label[1]), surface.label[2])
        result.color = wp.vec3(shade, shade, shade)
        result.metallic = 0.0
        result.roughness = LABEL_ROUGHNESS
    if has_wear(wear.share):
        worn = apply_wear(wear, result.color, result.metallic, result.roughness)
        result.color = worn.color
        result.metallic = worn.metallic
        result.roughness = worn.roughness
    return result


@wp.func
def brdf_of(surfaces: AnySurfaces, surface: Surface, material: SurfaceMaterial, roughness: float, outgoing: wp.vec3, least: float) -> Brdf:
    """BRDF of a surface for the view direction `outgoing`. `roughness`: that of the material, increased; `least`: smallest of a coat."""
    return make_brdf(Brdf(), surfaces.albedo, material.color, material.metallic, roughness, material.normal, outgoing)


@wp.func
def brdf_of(  # noqa: F811
    surfaces: FinishedSurfaces, surface: Surface, material: SurfaceMaterial, roughness: float, outgoing: wp.vec3, least: float
) -> FinishedBrdf:
    """BRDF of a surface with the finish of its row. The coat has the interpolated normal and is widened as the base; labels have none."""
    finish = surfaces.finish[surface.row]
    if surface.label[2] > 0.0:
        finish = wp.vec4(0.0, 0.0, 0.0, 0.0)
    alpha = wp.clamp(roughness * roughness, MIN_ALPHA, 1.0)
    widths = wp.vec2(alpha, alpha)
    if wp.length_sq(wp.cross(wp.vec3(surface.tangent[0], surface.tangent[1], surface.tangent[2]), material.normal)) > 0.0:
        widths[0] = wp.lerp(alpha, 1.0, finish[2] * finish[2])
    mean = wp.sqrt(0.5 * (widths[0] + widths[1]))
    brdf = make_brdf(FinishedBrdf(), surfaces.albedo, material.color, material.metallic, mean, material.normal, outgoing)
    added = wp.max(wp.pow(roughness, 4.0) - wp.pow(material.roughness, 4.0), 0.0)
    finish[1] = wp.max(wp.sqrt(wp.sqrt(wp.min(wp.pow(finish[1], 4.0) + added, 1.0))), least)
    return finish_brdf(brdf, surfaces.albedo, widths, surface.normal, surface.tangent, finish)
