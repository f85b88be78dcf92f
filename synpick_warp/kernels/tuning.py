"""Launch tuning: register limits, block sizes and thread counts of kernels. They change speed, never results.

Measured on one H200 (driver 580, Warp 1.19, 21 YCB-Video objects, three cameras at 1920x1080) by `python -m tools.bench --parts render`,
unless said otherwise. On the CPU a launch runs its threads one after the other, so that counts of sharing threads are 1 there.
"""

import warp as wp

RAY_REGISTERS = 64
"""Register limit of kernels that trace rays. With more, too few threads are resident to hide the latency of BVH nodes; from 56 to 64 is
best, fewer and more are slower."""
COARSE_PATH_REGISTERS = 56
"""Register limit of kernels that trace paths from the camera to their last bounce. It is below RAY_REGISTERS, as they run fastest so."""
SINGLE_PATH_REGISTERS = 72
"""Register limit of kernels that trace one bounce of a path per launch. 56, 64 and 96 registers are 1 to 2 %
slower in all stages of a full-HD view (H100)."""
SHADE_REGISTERS = 80
"""Register limit of the shading kernel, which waits for memory less than ray tracing does, and keeps more values live."""
SAMPLE_SHADE_REGISTERS = 128
"""Register limit of the shading kernel where it supersamples: lower limits spill more (from ptxas for sm_90, not timed)."""
FILTER_REGISTERS = 80
"""Register limit of the denoiser's block filter: the smallest without spills, for occupancy (ptxas for sm_90; others were not timed)."""
CHOICE_REGISTERS = 72
"""Register limit of the denoiser's choice of filter widths, found in the same way."""
PIXEL_BLOCK = 128
"""Block size of kernels with a thread a pixel: four tiles of 8 x 4 pixels."""
LANE_STRIDE = wp.constant(4)
"""Interleaved order of the coarse path pass: the threads of a warp take coarse pixels this far apart, by row and by column."""
LANE_COLUMNS = wp.constant(8)
"""Interleaved order: threads of a warp in one row of coarse pixels."""
VIEW_BLOCK = 32
"""Block size of kernels with a thread a view: small blocks spread few views over many multiprocessors."""
CONTOUR_BLOCK = 4
"""Block size of border following, whose threads wait for the longest border of their warp and for memory that they do not share."""
JPEG_THREADS = 128
"""Threads per CUDA block in all kernels of the JPEG encoder: one size, because each size compiles a module again. The DCT uses 96
registers a thread: a multiprocessor holds five CUDA blocks of 128 threads, or two of 256 (from ptxas for sm_90, not timed)."""
TRIANGLE_THREADS = 4096
"""Threads that share the triangles of a body in the rasterizer: enough to spread a dense mesh, while those without a triangle cost little.
Rasterizing triangles takes 0.10 of the 0.18 ms of a view's G-buffer."""
BLOCK_THREADS = 16384
"""Threads that share a view's blocks of large triangles in the rasterizer (0.015 ms of a view)."""
RUN_BANDS = 8
"""Number of bands into which the rows of an image are divided to find run boundaries, with one thread per column and band. One thread per
column would be 48,000 threads for a batch of 25 full-HD views; an H200 runs 270,000 at a time."""
RUN_LANES = 128
"""Number of threads among which the columns of an amodal mask are divided to list its runs."""
RESTORE_THREADS, KEEP_THREADS = 256, 4096
"""Threads that copy the words of a mask from the previous frame, or clear them, some 3,000; and that keep those of all masks of a view,
some 30,000 in a full-HD view of a tote."""
COUNT_THREADS = 1024
"""Threads that share the pixels of one instance in counts and boxes: enough to hide latency, few enough that atomics do not contend."""
BORDER_GROUPS, BORDER_THREADS = 2112, 128
"""Groups and threads of one that share the pixels of boxes beyond the image: as many as an H200's 132 multiprocessors hold at once."""
BORDER_CHUNK = 8192
"""Pixels that a group takes at a time: 64 rays a thread, few enough that groups end together, many enough that their atomics are rare."""
FOOTPRINT_THREADS, CPU_FOOTPRINT_THREADS = 128, 4
"""Number of threads that share a chunk's list of anti-aliasing footprints, on a GPU and on the CPU: a chunk has some hundred samples."""
EDGE_THREADS, CPU_EDGE_THREADS = 1024, 64
"""Threads that share a chunk's list of pixels near edges of shadows, on a GPU and on the CPU: a chunk has up to 16,384, and a launch ends
with its longest list."""
CPU_PIECES = 8
"""Pieces per CPU core of a launch over pixels, so that cores finish together although some tiles cost more."""
CPU_PIECE_PIXELS = 8192
"""Smallest piece: launching one costs as much as shading about a hundred pixels."""
