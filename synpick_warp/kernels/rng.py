"""Counter-based random number generator: (seed, episode, arrangement, stream, index) determines one sample, on every device.

SplitMix64 (Steele, Lea and Flood, OOPSLA 2014) evaluated at any index: sample i of a stream with key k is mix(k + (i + 1)·γ). A key is
a hash of seed, episode index, arrangement index and `Stream`, so that streams are independent. Samples depend neither on the world in
which an episode runs nor on the order of threads.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# γ and the two multipliers of SplitMix64, from the paper.
GAMMA = wp.constant(wp.uint64(0x9E3779B97F4A7C15))
MIX_A = wp.constant(wp.uint64(0xBF58476D1CE4E5B9))
MIX_B = wp.constant(wp.uint64(0x94D049BB133111EB))
# 2⁻²⁴: a float32 in [0, 1) has 24 bits.
UNIT = wp.constant(5.9604644775390625e-08)
TAU = wp.constant(6.283185307179586)


@wp.func
def mix(x: wp.uint64) -> wp.uint64:
    """Output function of SplitMix64: a bijective 64-bit hash."""
    y = (x ^ (x >> wp.uint64(30))) * MIX_A
    y = (y ^ (y >> wp.uint64(27))) * MIX_B
    return y ^ (y >> wp.uint64(31))


@wp.func
def stream_key(seed: wp.uint64, episode: int, arrangement: int, stream: int) -> wp.uint64:
    """Key of a stream of random numbers: of this purpose (`Stream`), in an arrangement of an episode."""
    key = mix(seed + GAMMA)
    key = mix((key ^ wp.uint64(episode)) + GAMMA)
    key = mix((key ^ wp.uint64(arrangement)) + GAMMA)
    return mix((key ^ wp.uint64(stream)) + GAMMA)


@wp.func
def view_key(seed: wp.uint64, episode: int, frame: int, camera: int, stream: int) -> wp.uint64:
    """Key of the `Stream` of a view: frame and camera of an episode. The arrangement index is not part of it."""
    key = stream_key(seed, episode, 0, stream)
    key = mix((key ^ wp.uint64(frame)) + GAMMA)
    return mix((key ^ wp.uint64(camera)) + GAMMA)


@wp.func
def pixel_key(key: wp.uint64, pixel: int) -> wp.uint64:
    """Key of a pixel's stream, from the key of its view's; `pixel` is the pixel index."""
    return mix((key ^ wp.uint64(pixel)) + GAMMA)


@wp.func
def uniform(key: wp.uint64, index: int) -> float:
    """Sample `index` of a stream, uniform in [0, 1): the upper 24 bits as float32."""
    bits = mix(key + (wp.uint64(index) + wp.uint64(1)) * GAMMA)
    return float(bits >> wp.uint64(40)) * UNIT


@wp.func
def uniform_index(key: wp.uint64, index: int, count: int) -> int:
    """Sample `index` of a stream as an integer, uniform in [0, count)."""
    return wp.min(int(uniform(key, index) * float(count)), count - 1)


@wp.func
def normal_pair(key: wp.uint64, index: int) -> wp.vec2:
    """Two independent standard normal samples, from samples `index` and `index` + 1 (Box-Muller transform, 1958)."""
    radius = wp.sqrt(-2.0 * wp.log(1.0 - uniform(key, index)))
    angle = TAU * uniform(key, index + 1)
    return wp.vec2(radius * wp.cos(angle), radius * wp.sin(angle))


@wp.func
def uniform_rotation(key: wp.uint64, index: int) -> wp.quat:
    """Uniform random rotation over SO(3), from samples index to index + 2 (Shoemake, Graphics Gems III, 1992)."""
    u = uniform(key, index)
    a = TAU * uniform(key, index + 1)
    b = TAU * uniform(key, index + 2)
    low = wp.sqrt(1.0 - u)
    high = wp.sqrt(u)
    return wp.quat(low * wp.sin(a), low * wp.cos(a), high * wp.sin(b), high * wp.cos(b))
