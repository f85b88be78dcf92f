"""Domain randomization of materials (Tobin et al., IROS 2017): each episode draws the appearance of objects, bin and table.

The draw is a pure function of seed, episode and body. So it needs no state: materials are made anew for each batch of views, and
the host computes the same values for its records.
"""

import warp as wp

from synpick_warp.codes import Look, LookKind, LookPart, Stream
from synpick_warp.kernels.render.lighting.materials import Surfaces
from synpick_warp.kernels.render.visibility.camera import AnyViews
from synpick_warp.kernels.render.visibility.gbuffer import FIXTURES, Meshes, ViewBodies
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.rng import TAU, normal_pair, pixel_key, stream_key, uniform

wp.set_module_options({"enable_backward": False})

SAMPLES = wp.constant(6)
"""Random numbers reserved for one draw: three components, by pairs."""
PART_BODIES = wp.constant(1024)
"""More than a world's instances: keys of parts do not meet."""
GREY = wp.constant(0.57735)
"""Component of the unit vector along the grey axis: 1 / sqrt(3)."""


@wp.struct
class LookDistribution:
    """Probability distribution of one appearance parameter; see `configs.randomize.Distribution`."""

    kind: int
    """`LookKind`."""
    a: wp.vec3
    """Value, low, logarithm of low, or mean."""
    b: wp.vec3
    """High, logarithm of high, or standard deviation."""
    low: float
    high: float
    """Range to which a normal sample is clamped."""
    first: int
    """Index of the first value of a choice in `LookTable.choice`."""
    count: int
    """Number of values of a choice."""


@wp.struct
class LookTable:
    """Distributions of all appearance parameters, and where the materials of views begin. Constant."""

    distribution: wp.array2d[LookDistribution]
    """(part, look)."""
    choice: wp.array[wp.vec4]
    """(choice): value, and cumulative probability up to and with it."""
    first_row: int
    """Row of `Surfaces` of the first view's first body; the rows before are those of meshes, table and textures."""


@wp.func
def draw_look(table: LookTable, key: wp.uint64, part: int, look: int) -> wp.vec3:
    """Draw an appearance parameter from the stream of a body; a scalar is the first component."""
    d = table.distribution[part, look]
    index = SAMPLES * look
    u = wp.vec3(uniform(key, index), uniform(key, index + 2), uniform(key, index + 4))
    if d.kind == LookKind.FIXED:
        return d.a
    if d.kind == LookKind.UNIFORM:
        return d.a + wp.cw_mul(d.b - d.a, u)
    if d.kind == LookKind.LOG_UNIFORM:
        x = d.a + wp.cw_mul(d.b - d.a, u)
        return wp.vec3(wp.exp(x[0]), wp.exp(x[1]), wp.exp(x[2]))
    if d.kind == LookKind.NORMAL:
        n = wp.vec3(normal_pair(key, index)[0], normal_pair(key, index + 2)[0], normal_pair(key, index + 4)[0])
        x = d.a + wp.cw_mul(d.b, n)
        return wp.vec3(wp.clamp(x[0], d.low, d.high), wp.clamp(x[1], d.low, d.high), wp.clamp(x[2], d.low, d.high))
    last = d.first + d.count - 1
    chosen = int(d.first)
    while chosen < last and u[0] >= table.choice[chosen][3]:
        chosen += 1
    return wp.vec3(table.choice[chosen][0], table.choice[chosen][1], table.choice[chosen][2])


@wp.func
def look_key(seed: wp.uint64, episode: int, part: int, body: int) -> wp.uint64:
    """Key of the random numbers of a body's appearance; `body` counts within its part."""
    return pixel_key(stream_key(seed, episode, 0, Stream.LOOKS), PART_BODIES * part + body)


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
    """As in `Surfaces`."""
    texture: int
    """Row of `Surfaces` whose texture it has."""
    repeats: float
    """As in `Surfaces`."""


@wp.func
def draw_material(table: LookTable, surfaces: Surfaces, base: int, key: wp.uint64, part: int) -> DrawnMaterial:
    """Change material `base` by what is drawn for a part; of part -1 nothing is."""
    result = DrawnMaterial()
    result.color = surfaces.color[base]
    result.metallic = surfaces.metallic[base]
    result.roughness = surfaces.roughness[base]
    result.recolor = wp.identity(n=3, dtype=float)
    result.texture = base
    result.repeats = 1.0
    if part < 0:
        return result
    if table.distribution[part, Look.TEXTURE].kind != LookKind.OFF:
        result.texture = int(draw_look(table, key, part, Look.TEXTURE)[0])
        result.repeats = 1.0 / draw_look(table, key, part, Look.TEXTURE_WIDTH)[0]
        result.color = wp.vec3(1.0, 1.0, 1.0)
    if table.distribution[part, Look.COLOR].kind != LookKind.OFF:
        encoded = draw_look(table, key, part, Look.COLOR)
        result.color = wp.vec3(srgb_decode(encoded[0]), srgb_decode(encoded[1]), srgb_decode(encoded[2]))
    if table.distribution[part, Look.ROUGHNESS].kind != LookKind.OFF:
        result.roughness = draw_look(table, key, part, Look.ROUGHNESS)[0]
    if table.distribution[part, Look.METALLIC].kind != LookKind.OFF:
        result.metallic = draw_look(table, key, part, Look.METALLIC)[0]
    if table.distribution[part, Look.HUE].kind != LookKind.OFF:
        result.recolor = hue_rotation(draw_look(table, key, part, Look.HUE)[0])
    if table.distribution[part, Look.BRIGHTNESS].kind != LookKind.OFF:
        result.recolor = draw_look(table, key, part, Look.BRIGHTNESS)[0] * result.recolor
    return result


@kernel_of_views
def dress_bodies_kernel(
    # Scene:
    seed: wp.uint64,
    meshes: Meshes,
    table: LookTable,
    # State:
    episode: wp.array[int],  # (world)
    # In:
    views: AnyViews,
    # Out:
    bodies_inout: ViewBodies,
    surfaces_inout: Surfaces,
):
    """Materials of the bodies of each view, and of its table as the last: those of their meshes, changed by what the episode draws.

    Launched over view, material.
    """
    view, body = wp.tid()
    instances = bodies_inout.mesh.shape[1] - FIXTURES
    at_table = body == bodies_inout.mesh.shape[1]
    world = views.world[view]
    if world < 0:
        return
    base = meshes.entries + FIXTURES
    if not at_table:
        base = bodies_inout.mesh[view, body]
    if base < 0:
        return
    row = table.first_row + view * bodies_inout.material.shape[1] + body
    bodies_inout.material[view, body] = row
    part = int(-1)
    slot = int(0)
    if at_table:
        part = LookPart.TABLE
    elif body < instances:
        part = LookPart.OBJECT
        slot = body
    elif body == instances:
        part = LookPart.BIN
    key = look_key(seed, episode[world], wp.max(part, 0), slot)
    material = draw_material(table, surfaces_inout, base, key, part)
    surfaces_inout.color[row] = material.color
    surfaces_inout.metallic[row] = material.metallic
    surfaces_inout.roughness[row] = material.roughness
    surfaces_inout.recolor[row] = material.recolor
    surfaces_inout.repeats[row] = material.repeats
    surfaces_inout.texture_size[row] = surfaces_inout.texture_size[material.texture]
    surfaces_inout.texture_levels[row] = surfaces_inout.texture_levels[material.texture]
    for level in range(surfaces_inout.first_texel.shape[1]):
        surfaces_inout.first_texel[row, level] = surfaces_inout.first_texel[material.texture, level]
