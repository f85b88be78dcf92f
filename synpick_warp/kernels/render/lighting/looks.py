"""Domain randomization of materials (Tobin et al., IROS 2017): each episode draws the appearance of objects, bin and table.

The draw is a pure function of seed, episode and body. So it needs no state: materials are made anew for each batch of views, and
the host computes the same values for its records.
"""

import warp as wp

from synpick_warp.codes import Look, LookKind, LookPart
from synpick_warp.kernels.distributions import LookTable, draw_look, look_key
from synpick_warp.kernels.render.lighting.labels import Label, place_label
from synpick_warp.kernels.render.lighting.surfaces import METALLIC_MAP, ROUGHNESS_MAP, RandomizedSurfaces
from synpick_warp.kernels.render.visibility.camera import AnyViews
from synpick_warp.kernels.render.visibility.gbuffer import FIXTURES, Meshes, ViewBodies
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.rng import TAU
from synpick_warp.kernels.state import Frames

wp.set_module_options({"enable_backward": False})

GREY = wp.constant(0.57735)
"""Component of the unit vector along the grey axis: 1 / sqrt(3)."""


@wp.func
def srgb_decode(value: float) -> float:
    """Linear light of an sRGB component in 0..1 (IEC 61966-2-1)."""
    if value <= 0.04045:
        return value / 12.92
    return wp.pow((value + 0.055) / 1.055, 2.4)


@wp.func
def hue_rotation(degrees: float) -> wp.mat33:
    """Rotation of linear colours about the grey axis, which keeps grey and the sum of the components."""
    axis = wp.vec3(GREY, GREY, GREY)
    return wp.quat_to_matrix(wp.quat_from_axis_angle(axis, degrees * TAU / 360.0))


@wp.kernel
def draw_looks_kernel(
    # Scene:
    seed: wp.uint64,
    table: LookTable,
    # In:
    episode: wp.array[int],  # (row)
    part: wp.array[int],  # (row)
    body: wp.array[int],  # (row)
    # Out:
    value_out: wp.array2d[wp.vec3],  # (row, look)
):
    """Appearance parameters of bodies, for records; zero where a parameter is not drawn. Launched over row, look."""
    row, look = wp.tid()
    value_out[row, look] = wp.vec3(0.0, 0.0, 0.0)
    if table.distribution[part[row], look].kind != LookKind.OFF:
        value_out[row, look] = draw_look(table, look_key(seed, episode[row], part[row], body[row]), part[row], look)


@wp.struct
class DrawnMaterial:
    """Material of a body in an episode."""

    color: wp.vec3
    """Base colour, linear."""
    metallic: float
    roughness: float
    recolor: wp.mat33
    """As in `RandomizedSurfaces`."""
    texture: int
    """Row of `RandomizedSurfaces` whose texture it has."""
    repeats: float
    """As in `RandomizedSurfaces`."""
    maps: int
    """As in `Surfaces`: values that are drawn replace maps."""
    wear: wp.vec4
    """As in `RandomizedSurfaces`."""
    glass: wp.vec3
    """As in `RandomizedSurfaces`; metals are opaque, unless a map says where they are."""
    label: float
    """Width of the label [m]; 0: none."""


@wp.func
def draw_material(table: LookTable, surfaces: RandomizedSurfaces, base: int, key: wp.uint64, part: int) -> DrawnMaterial:
    """Change material `base` by what is drawn for a part; of part -1 nothing is."""
    result = DrawnMaterial()
    result.color = surfaces.color[base]
    result.metallic = surfaces.metallic[base]
    result.roughness = surfaces.roughness[base]
    result.recolor = wp.identity(n=3, dtype=float)
    result.texture = base
    result.repeats = 1.0
    result.maps = surfaces.maps[base]
    if part < 0:
        return result
    if table.distribution[part, Look.TEXTURE].kind != LookKind.OFF:
        result.texture = int(draw_look(table, key, part, Look.TEXTURE)[0])
        result.repeats = 1.0 / draw_look(table, key, part, Look.TEXTURE_WIDTH)[0]
        result.color = wp.vec3(1.0, 1.0, 1.0)
        result.maps = 0
    if table.distribution[part, Look.COLOR].kind != LookKind.OFF:
        encoded = draw_look(table, key, part, Look.COLOR)
        result.color = wp.vec3(srgb_decode(encoded[0]), srgb_decode(encoded[1]), srgb_decode(encoded[2]))
    if table.distribution[part, Look.ROUGHNESS].kind != LookKind.OFF:
        result.roughness = draw_look(table, key, part, Look.ROUGHNESS)[0]
        result.maps = result.maps & ~ROUGHNESS_MAP
    if table.distribution[part, Look.METALLIC].kind != LookKind.OFF:
        result.metallic = draw_look(table, key, part, Look.METALLIC)[0]
        result.maps = result.maps & ~METALLIC_MAP
    if table.distribution[part, Look.HUE].kind != LookKind.OFF:
        result.recolor = hue_rotation(draw_look(table, key, part, Look.HUE)[0])
    if table.distribution[part, Look.BRIGHTNESS].kind != LookKind.OFF:
        result.recolor = draw_look(table, key, part, Look.BRIGHTNESS)[0] * result.recolor
    wear = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for kind in range(4):
        if table.distribution[part, Look.SCRATCHES + kind].kind != LookKind.OFF:
            wear[kind] = draw_look(table, key, part, Look.SCRATCHES + kind)[0]
    result.wear = wear
    glass = surfaces.glass[base]
    if table.distribution[part, Look.TRANSMISSION].kind != LookKind.OFF:
        glass[0] = draw_look(table, key, part, Look.TRANSMISSION)[0]
    if (result.maps & METALLIC_MAP) == 0:
        glass[0] = glass[0] * (1.0 - result.metallic)
    result.glass = glass
    if table.distribution[part, Look.LABEL].kind != LookKind.OFF:
        result.label = draw_look(table, key, part, Look.LABEL)[0]
    return result


@kernel_of_views
def dress_bodies_kernel(
    seed: wp.uint64,
    meshes: Meshes,
    table: LookTable,
    snapshot: Frames,
    views: AnyViews,
    bodies: ViewBodies,
    first_row: int,
    surfaces_inout: RandomizedSurfaces,
):
    """Materials of the bodies of each view, of its table and of its background: those of their meshes, changed by what the episode draws.

    `first_row`: row of `RandomizedSurfaces` of the first view's first body; the rows before are those of meshes, table and textures.
    Launched over view, material.
    """
    view, body = wp.tid()
    instances = bodies.mesh.shape[1] - FIXTURES
    at_table = body >= bodies.mesh.shape[1]
    world = views.world[view]
    if world < 0:
        return
    base = meshes.entries + FIXTURES
    if not at_table:
        base = bodies.mesh[view, body]
    if base < 0:
        return
    row = first_row + view * surfaces_inout.row.shape[1] + body
    surfaces_inout.row[view, body] = row
    part = int(-1)
    slot = int(0)
    if body > bodies.mesh.shape[1]:
        part = LookPart.BACKGROUND
    elif at_table:
        part = LookPart.TABLE
    elif body < instances:
        part = LookPart.OBJECT
        slot = body
    elif body == instances:
        part = LookPart.BIN
    key = look_key(seed, snapshot.episode[world], wp.max(part, 0), slot)
    material = draw_material(table, surfaces_inout, base, key, part)
    surfaces_inout.color[row] = material.color
    surfaces_inout.metallic[row] = material.metallic
    surfaces_inout.roughness[row] = material.roughness
    surfaces_inout.recolor[row] = material.recolor
    surfaces_inout.repeats[row] = material.repeats
    surfaces_inout.wear[row] = material.wear
    surfaces_inout.glass[row] = material.glass
    surfaces_inout.pattern[row] = int(key >> wp.uint64(40))
    surfaces_inout.label[row] = Label()
    if material.label > 0.0:
        surfaces_inout.label[row] = place_label(meshes, base, surfaces_inout.pattern[row], material.label, part == LookPart.BIN)
    surfaces_inout.maps[row] = material.maps
    surfaces_inout.emission[row] = wp.where(material.texture == base, surfaces_inout.emission[base], wp.vec3(0.0, 0.0, 0.0))
    surfaces_inout.finish[row] = surfaces_inout.finish[base]
    surfaces_inout.texture_size[row] = surfaces_inout.texture_size[material.texture]
    surfaces_inout.texture_levels[row] = surfaces_inout.texture_levels[material.texture]
    for level in range(surfaces_inout.first_texel.shape[1]):
        surfaces_inout.first_texel[row, level] = surfaces_inout.first_texel[material.texture, level]
