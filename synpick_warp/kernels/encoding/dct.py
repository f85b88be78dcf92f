"""Forward transform of baseline JPEG (ITU-T T.81): YCbCr with 4:2:0 chroma, integer DCT, quantization; all in integers, as libjpeg does it.

A kernel writes the samples of Y, Cb and Cr, row by row: Y on top, below it Cb and Cr side by side. Another one transforms a block a thread;
its loops are unrolled, so that all 64 values stay in registers.

The arithmetic is that of libjpeg's slow integer DCT (Loeffler, Ligtenberg, Moschytz, 1989), so that files equal those of libjpeg byte for
byte, and do not depend on the device.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 64})

BLOCK = wp.constant(8)
"""Rows and columns of a block."""
BLOCK_SIZE = wp.constant(64)
"""Coefficients of a block."""
MCU = wp.constant(16)
"""Rows and columns of pixels in a minimum coded unit (MCU)."""
MCU_BLOCKS_ACROSS = wp.constant(2)
"""Blocks of Y across an MCU."""
LUMA_BLOCKS = wp.constant(4)
"""Blocks of Y in an MCU; those of Cb and Cr follow."""
BLOCKS_PER_MCU = wp.constant(6)
"""Four blocks of Y, one each of Cb and Cr."""
ZIGZAG = tuple(sorted(range(64), key=lambda k: (k // 8 + k % 8, k // 8 if (k // 8 + k % 8) % 2 else k % 8)))
"""Row-major index of each coefficient in zigzag order, for unrolled loops."""

vec8i = wp.types.vector(length=8, dtype=wp.int32)
block_vec = wp.types.vector(length=64, dtype=wp.int32)

COLOR_BITS = wp.constant(16)
"""Fractional bits of the colour transform; its factors are those of JFIF times 2^16, and 32768 is the half that rounds."""
DCT_BITS = wp.constant(13)
"""Fractional bits of the DCT's factors."""
PASS_BITS = wp.constant(2)
"""Fractional bits that are kept between the passes over rows and columns."""
CENTER = wp.constant(128)
"""Level shift of the samples."""
RECIPROCAL_BITS = wp.constant(wp.uint64(32))
"""Fractional bits of the divisors' reciprocals."""
HALF = wp.constant(wp.uint64(1 << 31))
"""Half of 2^32, which rounds."""
ONE = wp.constant(wp.uint64(1))
VALUE_BITS = wp.constant(wp.uint64(16))
"""Bits of a stored coefficient."""


@wp.struct
class JpegData:
    """Samples, DCT coefficients, bit strings and positions of a batch of images. Scratch."""

    sample: wp.array3d[wp.uint64]
    """(view, sample_row, sample_block): rows of eight samples: Y, below it Cb and Cr side by side, of whole MCUs."""
    coefficient: wp.array3d[wp.uint64]
    """(view, quad, block): quantized DCT coefficients in zigzag order, four of 16 bits in each element, the first one lowest."""
    nonzero: wp.array2d[wp.uint64]
    """(view, block): bit field of the coefficients that are not 0."""
    block_bits: wp.array2d[int]
    """(view, block): length of each block's bit string [bit]."""
    block_begin: wp.array2d[int]
    """(view, block): first bit of each block in its interval."""
    slot: wp.array3d[wp.uint32]
    """(view, interval, slot_word): bit string of each restart interval, most significant bit first."""
    coded: wp.array2d[int]
    """(view, interval): size of each bit string [B], also beyond its slot."""
    stuffing: wp.array3d[int]
    """(view, interval, lane): bytes that each lane stuffs into its chunk of an interval."""
    interval_size: wp.array2d[int]
    """(view, interval): size of each interval in the file [B], with stuffing and marker."""
    interval_begin: wp.array2d[int]
    """(view, interval): first byte of each interval in the file."""


@wp.func
def luma(color: wp.vec3ub) -> int:
    """Y of an sRGB colour (JFIF, BT.601), rounded to nearest."""
    return (19595 * int(color[0]) + 38470 * int(color[1]) + 7471 * int(color[2]) + 32768) >> COLOR_BITS


@wp.func
def chroma(color: wp.vec3ub, difference: int) -> int:
    """Cb (`difference` 0) or Cr (1) of an sRGB colour, centred at 128, as libjpeg rounds it."""
    red, green, blue = int(color[0]), int(color[1]), int(color[2])
    offset = (CENTER << COLOR_BITS) + 32767
    if difference == 0:
        return (-11059 * red - 21709 * green + 32768 * blue + offset) >> COLOR_BITS
    return (32768 * red - 27439 * green - 5329 * blue + offset) >> COLOR_BITS


@wp.func
def is_padding(block: int, mcu_row: int, mcu_column: int, rows: int, columns: int) -> bool:
    """Whether a block of an MCU at the border is padding (libjpeg's dummy block): it contains no pixel of the image."""
    if block >= LUMA_BLOCKS:
        return False
    row, column = mcu_row * MCU + (block // MCU_BLOCKS_ACROSS) * BLOCK, mcu_column * MCU + (block % MCU_BLOCKS_ACROSS) * BLOCK
    return row >= rows or column >= columns


@wp.kernel
def convert_colors_kernel(
    # In:
    image: wp.array3d[wp.vec3ub],  # (view, row, column)
    # Out:
    sample_out: wp.array3d[wp.uint8],  # (view, sample_row, sample_column)
):
    """RGB to YCbCr with 4:2:0 chroma subsampling, padded to whole MCUs. Launched over view, pair of rows, pair of columns.

    Each thread writes Y of 2 x 2 pixels, and the means of their Cb and Cr. The last column is repeated to the right; below the image the
    last row of Y and the last row of the means are repeated, as in libjpeg. Means are rounded up and down in alternate columns.
    """
    view, row, column = wp.tid()
    last = (image.shape[1] - 1) // 2
    upper = 2 * wp.min(row, last)
    lower = wp.min(upper + 1, image.shape[1] - 1)
    left, right = wp.min(2 * column, image.shape[2] - 1), wp.min(2 * column + 1, image.shape[2] - 1)
    a, b = image[view, upper, left], image[view, upper, right]
    c, d = image[view, lower, left], image[view, lower, right]
    rounding = 1 + column % 2
    cb = (chroma(a, 0) + chroma(b, 0) + chroma(c, 0) + chroma(d, 0) + rounding) >> 2
    cr = (chroma(a, 1) + chroma(b, 1) + chroma(c, 1) + chroma(d, 1) + rounding) >> 2
    below_left, below_right = luma(c), luma(d)
    above_left, above_right = wp.where(row > last, below_left, luma(a)), wp.where(row > last, below_right, luma(b))
    sample_out[view, 2 * row, 2 * column] = wp.uint8(above_left)
    sample_out[view, 2 * row, 2 * column + 1] = wp.uint8(above_right)
    sample_out[view, 2 * row + 1, 2 * column] = wp.uint8(below_left)
    sample_out[view, 2 * row + 1, 2 * column + 1] = wp.uint8(below_right)
    bottom = sample_out.shape[1] // 3 * 2 + row
    sample_out[view, bottom, column] = wp.uint8(cb)
    sample_out[view, bottom, sample_out.shape[2] // 2 + column] = wp.uint8(cr)


@wp.func
def descale(value: int, bits: int) -> int:
    """Divide by 2^bits, rounded to nearest."""
    return (value + (1 << (bits - 1))) >> bits


@wp.func
def transform_line(a: vec8i, shift: int) -> vec8i:
    """One-dimensional DCT of 8 samples, scaled by sqrt(8) · 2^(DCT_BITS - shift).

    Args:
        a: The samples.
        shift: Fractional bits that are dropped: DCT_BITS - PASS_BITS for rows, DCT_BITS + PASS_BITS for columns.
    """
    out = vec8i()
    sum0, sum1, sum2, sum3 = a[0] + a[7], a[1] + a[6], a[2] + a[5], a[3] + a[4]
    dif0, dif1, dif2, dif3 = a[0] - a[7], a[1] - a[6], a[2] - a[5], a[3] - a[4]
    # Even coefficients. Factors are cosines, times 2^DCT_BITS.
    outer, inner = sum0 + sum3, sum1 + sum2
    out[0] = descale((outer + inner) << DCT_BITS, shift)
    out[4] = descale((outer - inner) << DCT_BITS, shift)
    rotated = (sum0 - sum3 + sum1 - sum2) * 4433
    out[2] = descale(rotated + (sum0 - sum3) * 6270, shift)
    out[6] = descale(rotated - (sum1 - sum2) * 15137, shift)
    # Odd coefficients.
    z5 = (dif3 + dif1 + dif2 + dif0) * 9633
    z1, z2 = -(dif3 + dif0) * 7373, -(dif2 + dif1) * 20995
    z3, z4 = z5 - (dif3 + dif1) * 16069, z5 - (dif2 + dif0) * 3196
    out[7] = descale(dif3 * 2446 + z1 + z3, shift)
    out[5] = descale(dif2 * 16819 + z2 + z4, shift)
    out[3] = descale(dif1 * 25172 + z2 + z3, shift)
    out[1] = descale(dif0 * 12299 + z1 + z4, shift)
    return out


@wp.func
def transform_block(samples: block_vec) -> block_vec:
    """Two-dimensional DCT of 8 x 8 samples in row-major order, scaled by 8: rows, then columns."""
    line = vec8i()
    for row in range(BLOCK):
        for k in range(BLOCK):
            line[k] = samples[BLOCK * row + k]
        line = transform_line(line, DCT_BITS - PASS_BITS)
        for k in range(BLOCK):
            samples[BLOCK * row + k] = line[k]
    for column in range(BLOCK):
        for k in range(BLOCK):
            line[k] = samples[BLOCK * k + column]
        line = transform_line(line, DCT_BITS + PASS_BITS)
        for k in range(BLOCK):
            samples[BLOCK * k + column] = line[k]
    return samples


@wp.func
def quantize(coefficient: int, reciprocal: wp.uint32) -> int:
    """Coefficient / divisor, rounded to nearest, halves away from zero; exact for magnitudes m and even divisors d below 2^16.

    m · reciprocal / 2^32 exceeds m / d by less than m / 2^32 < 1 / d, and m / d + 1 / 2 is a multiple of 1 / d, so that both sums have the
    same integer part. Coefficients of 8 x 8 samples of at most 128 are below 2^14: an orthonormal transform keeps their norm, 8 · 128,
    and ours is 8 times as large.

    Args:
        coefficient: Of the transform.
        reciprocal: 2^32 / divisor, rounded up.
    """
    magnitude = int((wp.uint64(wp.abs(coefficient)) * wp.uint64(reciprocal) + HALF) >> RECIPROCAL_BITS)
    return wp.where(coefficient < 0, -magnitude, magnitude)


@wp.func
def read_block(
    sample: wp.array3d[wp.uint64],  # (view, sample_row, sample_block)
    view: int,
    row: int,
    column: int,
) -> block_vec:
    """Load a block of 8 x 8 samples, level-shifted by -128; `row` is its first sample row, `column` its index across, in blocks."""
    block = block_vec()
    for i in range(BLOCK):
        line = sample[view, row + i, column]
        for k in range(BLOCK):
            block[BLOCK * i + k] = int((line >> wp.uint64(8 * k)) & wp.uint64(0xFF)) - CENTER
    return block


@wp.kernel
def transform_blocks_kernel(
    # In:
    rows: int,
    columns: int,
    quality: wp.array[int],  # (view)
    reciprocal: wp.array3d[wp.uint32],  # (quality, component, coefficient)
    # Out:
    data_inout: JpegData,
):
    """Quantized DCT coefficients of all blocks, in zigzag order. Launched over view, block.

    Padding blocks of images of `rows` x `columns` pixels repeat the DC coefficient of the block before them, and have no other (only
    `nonzero` tells so), which costs the fewest bits.
    """
    sample = data_inout.sample
    view, index = wp.tid()
    mcu, block = index // BLOCKS_PER_MCU, index % BLOCKS_PER_MCU
    across = sample.shape[2] // MCU_BLOCKS_ACROSS
    mcu_row, mcu_column = mcu // across, mcu % across
    source = int(block)
    while is_padding(source, mcu_row, mcu_column, rows, columns):
        source -= 1
    row = mcu_row * MCU + (source // MCU_BLOCKS_ACROSS) * BLOCK
    column = mcu_column * MCU_BLOCKS_ACROSS + source % MCU_BLOCKS_ACROSS
    table = int(0)
    if block >= LUMA_BLOCKS:
        row = sample.shape[1] // 3 * 2 + mcu_row * BLOCK
        column = (block - LUMA_BLOCKS) * across + mcu_column
        table = int(1)
    samples = transform_block(read_block(sample, view, row, column))
    mask, packed, bit = wp.uint64(0), wp.uint64(0), wp.uint64(1)
    for k in range(BLOCK_SIZE):
        value = quantize(samples[wp.static(ZIGZAG[k])], reciprocal[quality[view], table, k])
        mask = mask | wp.where(value != 0, bit, wp.uint64(0))
        bit = bit << ONE
        packed = (packed >> VALUE_BITS) | (wp.uint64(value & 0xFFFF) << (wp.uint64(3) * VALUE_BITS))
        if k & 3 == 3:
            data_inout.coefficient[view, k >> 2, index] = packed
    if source != block:
        mask = mask & ONE
    data_inout.nonzero[view, index] = mask
