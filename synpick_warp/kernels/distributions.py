"""Probability distributions of domain randomization (Tobin et al., IROS 2017): tables, and draws that are pure functions of their keys."""

import warp as wp

from synpick_warp.codes import LookKind, Stream
from synpick_warp.kernels.rng import normal_pair, pixel_key, stream_key, uniform

wp.set_module_options({"enable_backward": False})

SAMPLES = wp.constant(6)
"""Random numbers reserved for one draw: three components, by pairs."""
PART_BODIES = wp.constant(1024)
"""More than a world's instances: keys of parts do not meet."""


@wp.struct
class LookDistribution:
    """Probability distribution of one parameter; see `configs.episodes.randomize.Distribution`."""

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
    """Distributions of all parameters. Constant."""

    distribution: wp.array2d[LookDistribution]
    """(part, look)."""
    choice: wp.array[wp.vec4]
    """(choice): value, and cumulative probability up to and with it."""


@wp.func
def draw_look(table: LookTable, key: wp.uint64, part: int, look: int) -> wp.vec3:
    """Draw a parameter from the stream of a body; a scalar is the first component."""
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
