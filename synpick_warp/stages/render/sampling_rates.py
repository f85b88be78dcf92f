"""Sampling rates of the denoised renderer by settings and resolution: width of coarse pixels, paths, shading samples, coverage rays."""

from synpick_warp.configs.schema import UNOCCLUDED, Render
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.kernels.tuning import LANE_COLUMNS, LANE_STRIDE

MIN_COARSE_COLUMNS = 384
"""Minimum number of coarse pixels in an image row. It determines the default width of coarse pixels: 5 px at full HD, 1.9 mm at the bottom
of the tote. In images less than twice as wide, each coarse pixel is one pixel."""
MIN_HISTORY_COLUMNS = 480
"""Minimum number of coarse pixels in a row of an image with light histories. Most coarse pixels then trace no path in a frame, so they
may be narrower: 4 px at full HD, with one path each. That gives 0.8 dB more in PSNR than 5 px with two paths."""
MAX_COLUMNS_TWO_PATHS = 480
"""Maximum number of coarse pixels in an image row for two paths per coarse pixel; beyond it the default is one path. At 640x360, where each
coarse pixel is one pixel, ten piles have a PSNR of 32.5 dB with one path and 33.6 dB with two, in 1.5 times the time."""
FIRST_FRAME_PATHS = 32
"""Default number of paths per coarse pixel in the first frame of an episode. They initialize all light histories at their default maximum
length, so that the following frames trace fewer paths. Frame 8 gains 2 dB in PSNR at 480x270, 1.6 dB at full HD."""
COVERAGE_RAYS, NARROW_COVERAGE_RAYS = 4, 16
"""Number of coverage rays per anti-aliased pixel, in images with wide coarse pixels and in images with supersampled shading. At 480x270
16 rays have 0.2 dB more in PSNR than 4; at full HD 8 rays would cost a tenth of the rate."""

MAX_SHADOW_SIZE = 32
"""Maximum width of a shadow-grid pixel [px], so that a tile has no more pixels than a list of shadow edges can index."""


def coarse_size(render: Render, width: int, histories: int = 0) -> int:
    """Width of a coarse pixel [px] in images of `width` px; `histories` as in `DenoisedRenderer`."""
    columns = MIN_HISTORY_COLUMNS if accumulates(render, histories) else MIN_COARSE_COLUMNS
    return render.coarse_pixel or max(1, width // columns)


def shadow_size(size: int) -> int:
    """Width of a shadow-grid pixel [px] where coarse pixels are `size` px wide: the same, at most MAX_SHADOW_SIZE."""
    return min(size, MAX_SHADOW_SIZE)


def edge_rays(size: int) -> int:
    """Shadow rays to a lamp from each pixel at a steep edge of its shadow, where coarse pixels are `size` px wide. Four are filtered over 3
    x 3 instead of 5 x 5 pixels, which in narrow images would blur shadows."""
    return 4 if size <= 2 else 1


def traces_paths(render: Render) -> bool:
    """Whether coarse paths are traced; otherwise all environment light is unoccluded."""
    return render.mode != UNOCCLUDED


def keeps_frames(render: Render, histories: int) -> bool:
    """Whether results of the frame before are kept: light, shadow rays, pictures; `histories` as in `DenoisedRenderer`."""
    return bool(histories and render.history)


def kept_views(render: Render, cameras: int, histories: int) -> int:
    """Number of views, worlds times `cameras`, of which tiles are kept: those of the first `render.reuse_worlds` worlds, or all."""
    if not (render.reuse and keeps_frames(render, histories)):
        return 0
    return min(histories, render.reuse_worlds * cameras or histories)


def accumulates(render: Render, histories: int) -> bool:
    """Whether light is accumulated over frames (temporal accumulation); `histories` as in `DenoisedRenderer`."""
    return keeps_frames(render, histories) and traces_paths(render)


def paths_per_coarse_pixel(render: Render, width: int, histories: int = 0) -> int:
    """Number of paths per coarse pixel in images of `width` px: 1 if coarse pixels are narrower because of histories."""
    size = coarse_size(render, width, histories)
    few = size < coarse_size(render, width) or width > MAX_COLUMNS_TWO_PATHS * size
    return render.coarse_paths or (1 if few else 2)


def first_frame_paths(render: Render, width: int, histories: int = 0) -> int:
    """Number of paths per coarse pixel in the first frame of an episode, which initializes all light histories."""
    paths = paths_per_coarse_pixel(render, width, histories)
    if render.coarse_paths or not accumulates(render, histories):
        return paths
    return max(paths, min(FIRST_FRAME_PATHS, render.history))


def supersamples(render: Render, width: int, histories: int = 0) -> bool:
    """Whether shading is supersampled: only where coarse pixels are pixels. A pixel then covers much detail of textures and normals. Four
    samples gain 0.2 to 0.5 dB in PSNR."""
    return traces_paths(render) and coarse_size(render, width, histories) == 1


def coverage_rays(render: Render, width: int, histories: int = 0) -> int:
    """Number of coverage rays per anti-aliased pixel in images of `width` px; `histories` as in `DenoisedRenderer`."""
    return NARROW_COVERAGE_RAYS if supersamples(render, width, histories) else COVERAGE_RAYS


def interleaved_threads(columns: int, rows: int) -> int:
    """Threads per view of a kernel in interleaved order, over `columns` x `rows` coarse pixels; see `interleaved_pixel`."""
    across, down = int(LANE_STRIDE) * int(LANE_COLUMNS), int(LANE_STRIDE) * int(TILE_PIXELS) // int(LANE_COLUMNS)
    return -(-columns // across) * -(-rows // down) * across * down
