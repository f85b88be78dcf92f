"""Forward transform of baseline JPEG (ITU-T T.81): YCbCr with 4:2:0 chroma, integer DCT, quantization; all in integers, as libjpeg does it.

The arithmetic is that of libjpeg's slow integer DCT (Loeffler, Ligtenberg, Moschytz, 1989), so that files equal those of libjpeg byte for
byte, and do not depend on the device.
"""

import warp as wp

from synpick_warp.kernels.encoding.tables import BLOCK, BLOCK_SIZE, BLOCKS_PER_MCU, MCU, MCU_BLOCKS_ACROSS

wp.set_module_options({"enable_backward": False})

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
def read_chroma(
    image: wp.array3d[wp.vec3ub],  # (view, row, column)
    view: int,
    row: int,
    column: int,
    difference: int,
) -> int:
    """Cb or Cr of a pixel; the last column is repeated to the right, the last row below the image."""
    i, j = wp.min(row, image.shape[1] - 1), wp.min(column, image.shape[2] - 1)
    return chroma(image[view, i, j], difference)


@wp.func
def read_sample(
    image: wp.array3d[wp.vec3ub],  # (view, row, column)
    view: int,
    block: int,
    mcu_row: int,
    mcu_column: int,
    row: int,
    column: int,
) -> int:
    """Sample of a block of a minimum coded unit (MCU), less 128. Blocks 0 to 3: Y in 2 x 2; 4: Cb, 5: Cr, means of 2 x 2 pixels.

    Means are rounded up and down in alternate columns. Below the image libjpeg repeats the last row of means, not of pixels.
    """
    if block < MCU_BLOCKS_ACROSS * MCU_BLOCKS_ACROSS:
        i = wp.min(mcu_row * MCU + (block // MCU_BLOCKS_ACROSS) * BLOCK + row, image.shape[1] - 1)
        j = wp.min(mcu_column * MCU + (block % MCU_BLOCKS_ACROSS) * BLOCK + column, image.shape[2] - 1)
        return luma(image[view, i, j]) - CENTER
    i = 2 * wp.min(mcu_row * BLOCK + row, (image.shape[1] - 1) // 2)
    j = 2 * (mcu_column * BLOCK + column)
    difference = block - MCU_BLOCKS_ACROSS * MCU_BLOCKS_ACROSS
    total = read_chroma(image, view, i, j, difference) + read_chroma(image, view, i, j + 1, difference)
    total += read_chroma(image, view, i + 1, j, difference) + read_chroma(image, view, i + 1, j + 1, difference)
    return ((total + 1 + column % 2) >> 2) - CENTER


@wp.func
def is_padding(image: wp.array3d[wp.vec3ub], block: int, mcu_row: int, mcu_column: int) -> bool:
    """Whether a block of an MCU at the border is padding (libjpeg's dummy block): it contains no pixel of the image."""
    if block >= MCU_BLOCKS_ACROSS * MCU_BLOCKS_ACROSS:
        return False
    row, column = mcu_row * MCU + (block // MCU_BLOCKS_ACROSS) * BLOCK, mcu_column * MCU + (block % MCU_BLOCKS_ACROSS) * BLOCK
    return row >= image.shape[1] or column >= image.shape[2]


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
def quantize(coefficient: int, divisor: int) -> int:
    """Coefficient / divisor, rounded to nearest, halves away from zero."""
    magnitude = (wp.abs(coefficient) + (divisor >> 1)) // divisor
    return wp.where(coefficient < 0, -magnitude, magnitude)


@wp.kernel
def transform_blocks_kernel(
    # In:
    image: wp.array3d[wp.vec3ub],  # (view, row, column)
    quality: wp.array[int],  # (view)
    divisor: wp.array3d[int],  # (quality, component, coefficient)
    zigzag: wp.array[int],  # (coefficient)
    # Out:
    coefficient_out: wp.array3d[wp.uint64],  # (view, quad, block)
    nonzero_out: wp.array2d[wp.uint64],  # (view, block)
):
    """Quantized DCT coefficients of all blocks, in zigzag order. Launched over view, block.

    `coefficient_out` receives four coefficients of 16 bits in each element, the first one lowest; `nonzero_out` a bit for each
    coefficient that is not 0. Padding blocks repeat the DC coefficient of the block before them, and have no other, which costs the
    fewest bits.
    """
    view, index = wp.tid()
    mcu, block = index // BLOCKS_PER_MCU, index % BLOCKS_PER_MCU
    across = (image.shape[2] + MCU - 1) // MCU
    source = int(block)
    while is_padding(image, source, mcu // across, mcu % across):
        source -= 1
    samples = block_vec()
    for k in range(BLOCK_SIZE):
        samples[k] = read_sample(image, view, source, mcu // across, mcu % across, k // BLOCK, k % BLOCK)
    samples = transform_block(samples)
    table = wp.where(block < BLOCKS_PER_MCU - 2, 0, 1)
    mask, packed = wp.uint64(0), wp.uint64(0)
    for k in range(BLOCK_SIZE):
        value = quantize(samples[zigzag[k]], divisor[quality[view], table, k])
        if k > 0 and source != block:
            value = 0
        if value != 0:
            mask = mask | (wp.uint64(1) << wp.uint64(k))
        packed = packed | (wp.uint64(value & 0xFFFF) << wp.uint64(16 * (k & 3)))
        if k & 3 == 3:
            coefficient_out[view, k >> 2, index] = packed
            packed = wp.uint64(0)
    nonzero_out[view, index] = mask
