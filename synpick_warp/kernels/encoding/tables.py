"""Dimensions of baseline JPEG with 4:2:0 chroma, shared by its kernels."""

import warp as wp

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
