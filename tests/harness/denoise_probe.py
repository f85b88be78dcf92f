"""Kernels that ask cells, points and the filter of the fast picture for what tests want to know."""

import numpy as np
import warp as wp

from synpick_warp.arrays import allocate_struct
from synpick_warp.kernels.render.lighting.coarse_grid import CellGrid, cell_number, spread_cell
from synpick_warp.kernels.render.lighting.denoise import choose_windows_kernel, narrowed, soften_shares_kernel, sum_blocks_kernel
from synpick_warp.kernels.render.lighting.sampling import scrambled_point, sobol_point
from synpick_warp.kernels.render.visibility.camera import in_image
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.render.denoised import GATHERED, GUIDE, SHARES, cell_grid
from synpick_warp.stages.render.scene import build_cameras, build_grid
from synpick_warp.stages.render.view_setup import make_views

wp.set_module_options({"enable_backward": False})


@wp.kernel
def visit_kernel(
    # Scene:
    cells: CellGrid,
    # Out:
    visits_inout: wp.array3d[int],
):
    """How often each cell of each view is visited."""
    view, row, column = spread_cell(cells, wp.tid())
    if in_image(cells.cells, row, column):
        wp.atomic_add(visits_inout, view, row, column, 1)


@wp.kernel
def number_kernel(
    # In:
    period: int,
    # Out:
    number_out: wp.array2d[int],
):
    """Numbers of cells by row and column."""
    row, column = wp.tid()
    number_out[row, column] = cell_number(period, row, column)


@wp.kernel
def sobol_kernel(
    # In:
    first: int,
    # Out:
    point_out: wp.array[wp.vec2],
):
    """A run of points."""
    i = wp.tid()
    point_out[i] = sobol_point(first + i)


@wp.kernel
def scrambled_kernel(
    # In:
    key: wp.uint64,
    dimension: int,
    first: int,
    # Out:
    point_out: wp.array[wp.vec2],
):
    """A run of scrambled points."""
    i = wp.tid()
    point_out[i] = scrambled_point(key, first + i, dimension)


@wp.kernel
def narrowed_kernel(
    # In:
    wide: wp.array[wp.vec3],
    narrow: wp.array[wp.vec3],
    variance: wp.array[float],
    # Out:
    value_out: wp.array[wp.vec3],
):
    """What is believed of a wide and a narrow window."""
    i = wp.tid()
    value_out[i] = narrowed(wide[i], narrow[i], variance[i])


class FlatFilter:
    """The filter over cells of 1 px that all show one plane, which faces the camera at a depth of 1 m."""

    def __init__(self, width: int, height: int, device: wp.Device) -> None:
        sizes = {"view": 1, "cell_row": height, "cell_column": width}
        matrix = np.array([[100.0, 0.0, width / 2.0], [0.0, 100.0, height / 2.0], [0.0, 0.0, 1.0]])
        self.device, self.count = device, build_grid(width, height).tiles * 32
        self.cameras = build_cameras((Camera(width, height, matrix, np.eye(3), np.zeros(3)),), device)
        self.cells = cell_grid(build_grid(width, height), 1, 1)
        zero = wp.zeros(1, dtype=wp.int32, device=device)
        self.views = make_views(zero, zero, 1, 1)
        self.guide = allocate_struct(GUIDE, sizes, device)
        self.guide.segment.fill_(1)
        self.guide.depth.fill_(1.0)
        self.guide.normal.fill_(wp.vec3(0.0, 0.0, -1.0))
        self.gathered, self.blocks = (allocate_struct(GATHERED, sizes, device) for _ in range(2))
        self.chosen, self.shares = (allocate_struct(SHARES, sizes, device) for _ in range(2))

    def assign(self, name: str, values: np.ndarray) -> None:
        """Set an array of what was gathered: (row, column) grey, or (row, column, 3)."""
        rgb = values if values.ndim == 3 else np.repeat(values[..., None], 3, axis=2)
        getattr(self.gathered, name).assign(rgb[None].astype(np.float32))

    def run(self, doubt: float = 1.0) -> dict[str, np.ndarray]:
        """Shares (row, column, 3) by name: of the chosen windows, and after softening."""
        shared = [self.cameras, self.cells, self.guide]
        for kernel, source, rules, out in (
            (sum_blocks_kernel, self.gathered, (), self.blocks),
            (choose_windows_kernel, self.blocks, (doubt,), self.chosen),
            (soften_shares_kernel, self.chosen, (), self.shares),
        ):
            wp.launch(kernel, self.count, [*shared, source, self.views, *rules, 0], [out], device=self.device)
        made = {name: getattr(self.shares, name).numpy()[0] for name in ("diffuse", "gloss", "between")}
        return made | {f"chosen_{name}": getattr(self.chosen, name).numpy()[0] for name in ("diffuse", "gloss", "between")}
