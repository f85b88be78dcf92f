"""The fast picture: few paths for each cell of pixels, a filter, and shading of each pixel by what was found around it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from synpick_warp.arrays import allocate, allocate_struct, device_array, struct_arrays
from synpick_warp.configs.schema import Config
from synpick_warp.kernels.render.images.antialias import CHUNK_TILES, SAMPLES, find_edges_kernel, mix_edges_kernel
from synpick_warp.kernels.render.lighting.coarse_grid import LANES_ACROSS, SPREAD, CellGrid, Guide
from synpick_warp.kernels.render.lighting.coarse_paths import Gathered, gather_kernel
from synpick_warp.kernels.render.lighting.denoise import Shares, choose_windows_kernel, soften_shares_kernel, sum_blocks_kernel
from synpick_warp.kernels.render.lighting.shading import shade_kernel
from synpick_warp.kernels.render.lighting.shadows import cast_shadow_rays_kernel, filter_shadows_kernel
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.launch import BLOCK, launch_pixels
from synpick_warp.stages.render.reference import path_rules
from synpick_warp.stages.render.scene import RenderScene, build_grid

CELLS_ACROSS = 384
"""Cells in a picture's width, at least, and fewer than twice as many, if the setting leaves their size open: at full HD they are 1.9 mm
wide at the bottom of the tote. Narrower pictures have cells of a pixel."""
TWO_PATHS_ACROSS = 480
"""With at most so many cells in a picture's width a cell has two paths if the setting leaves that open, with more, one: at 640x360, where
cells are pixels, ten piles have 32.5 dB then, which two bring to 33.6 dB in 1.5 times the time."""
LONE_DOUBT = 2.0
"""The variance found among cells with one path is taken for so many times too low: such cells seldom meet what is bright and small, and
those that do would pass for a change of the light (on ten piles, 1 is 0.2 dB worse; 1.5 and 3 are nearly as good)."""
SHADOW_WINDOW = 4
"""Width of the window that shares shadow rays among cells: 16 rays find how much of a lamp is hidden."""
LEAST_ROUGHNESS = 0.3
"""Of surfaces that a path meets after the first (Kaplanyan and Dachsbacher, 2013): caustics are smeared, not sprinkled."""
MOST_SHARE = 8.0
"""A path counts with at most this many times the map's unhindered light, or single ones would show as patches; light from surfaces that
the main light shines on comes on top. Twice as many: 0.5 % brighter, 0.1 dB farther from the reference."""
ROULETTE = 1
"""Scatterings before dim paths may end early: few paths are long, since many neighbours share them."""
EDGE_THREADS = 128
"""Threads that share the edges of a segment on a GPU: it has some hundred samples."""


GUIDE = struct_arrays(Guide, "view", "cell_row", "cell_column", units={"depth": "m"})
GATHERED = struct_arrays(Gathered, "view", "cell_row", "cell_column")
SHARES = struct_arrays(Shares, "view", "cell_row", "cell_column")


@dataclass(frozen=True, eq=False)
class ShadowArrays:
    """How much of the main light reaches the middle of each cell."""

    cast: wp.array = device_array("view", "shadow_row", "shadow_column", dtype=wp.float32)
    """As the rays found it."""
    smooth: wp.array = device_array("view", "shadow_row", "shadow_column", dtype=wp.float32)
    """After the filter."""


@dataclass(frozen=True, eq=False)
class Edges:
    """Squares between the centres of four pixels that anti-aliasing works on."""

    place: wp.array = device_array("view", "chunk", "chunk_square", dtype=wp.int32)
    """Row times columns plus column of each; a chunk is a run of tiles of squares."""
    number: wp.array = device_array("view", "chunk", dtype=wp.int32)
    """How many there are."""


FAST_SCRATCH = ((GUIDE, 1), (GATHERED, 2), (SHARES, 2), (ShadowArrays, 1), (Edges, 1))
"""What `DenoisedRenderer` allocates, and how often."""


def cell_size(config: Config, width: int) -> int:
    """Width of a cell of a fast picture of this width [px]."""
    return config.render.cell or max(1, width // CELLS_ACROSS)


def cell_paths(config: Config, width: int) -> int:
    """Paths of a cell of a fast picture of this width [px]."""
    return config.render.cell_paths or (2 if width <= TWO_PATHS_ACROSS * cell_size(config, width) else 1)


def cell_sizes(config: Config, width: int, height: int) -> dict[str, int]:
    """Extents of the dimensions that the arrays here name beside the view, for images of `width` x `height` px."""
    size = cell_size(config, width)
    shadow = max(1, size // 2)
    chunks = -(-square_grid(width, height).tiles // int(CHUNK_TILES)) if config.render.antialias else 0
    return {
        "cell_row": -(-height // size),
        "cell_column": -(-width // size),
        "shadow_row": -(-height // shadow),
        "shadow_column": -(-width // shadow),
        "chunk": chunks,
        "chunk_square": int(CHUNK_TILES) * int(TILE_PIXELS),
    }


def cell_grid(image: Any, size: int, window: int) -> Any:
    """The struct `CellGrid` of cells of `size` x `size` px, filtered over `window` x `window` cells."""
    grid = CellGrid()
    grid.size = size
    grid.window = window
    grid.image = image
    grid.cells = build_grid(-(-image.width // size), -(-image.height // size))
    return grid


def square_grid(width: int, height: int) -> Any:
    """The struct `ImageGrid` of the squares between pixels' centres, and of the halves of such at an image's rim."""
    return build_grid(width + 1, height + 1)


def spread_threads(cells: Any) -> int:
    """Threads a view of kernels that find their cell by `spread_cell`."""
    across, down = int(SPREAD) * int(LANES_ACROSS), int(SPREAD) * int(TILE_PIXELS) // int(LANES_ACROSS)
    return -(-cells.cells.width // across) * -(-cells.cells.height // down) * across * down


class DenoisedRenderer:
    """Renders linear radiance by few paths and a filter. Owns its scratch; `shade` only launches."""

    def __init__(self, config: Config, scene: RenderScene, views: int) -> None:
        """Allocate scratch.

        Args:
            config: All settings; `render.cell`, `cell_paths`, `bounces` and `antialias` count.
            scene: Constant data.
            views: Most views of a batch.
        """
        size = cell_size(config, scene.width)
        sizes = {"view": views} | cell_sizes(config, scene.width, scene.height)
        self.scene = scene
        self.cells = cell_grid(scene.grid, size, 1)
        self.shadow_cells = cell_grid(scene.grid, max(1, size // 2), SHADOW_WINDOW)
        self.rules = path_rules(config, cell_paths(config, scene.width), ROULETTE)
        self.rules.least_roughness = LEAST_ROUGHNESS
        self.most_share = MOST_SHARE
        self.guide = allocate_struct(GUIDE, sizes, scene.device)
        self.gathered, self.blocks = (allocate_struct(GATHERED, sizes, scene.device) for _ in range(2))
        self.chosen, self.shares = (allocate_struct(SHARES, sizes, scene.device) for _ in range(2))
        self.shadows = allocate(ShadowArrays, sizes, scene.device)
        self.antialias = config.render.antialias
        self.squares = square_grid(scene.width, scene.height)
        self.edges = allocate(Edges, sizes, scene.device)

    def shade(self, snapshot: Snapshot, bodies: Any, gbuffer: Any, views: Any, image: Any) -> None:
        """Pictures of the views.

        Args:
            snapshot: The worlds.
            bodies: The struct `ViewBodies`, prepared for these views.
            gbuffer: The struct `GBuffer` of these views.
            views: The struct `Views`.
            image: The struct `ShadedImage`; written.
        """
        self.gather(snapshot, bodies, gbuffer, views)
        self.filter(views)
        self.cast_shadows(snapshot, bodies, gbuffer, views)
        self.light(snapshot, bodies, gbuffer, views, image.radiance)
        if self.antialias:
            self.smooth(bodies, gbuffer, views, image)

    def gather(self, snapshot: Snapshot, bodies: Any, gbuffer: Any, views: Any) -> None:
        """Trace the cells' paths."""
        scene = self.scene
        inputs = [scene.paths, scene.cameras, self.cells, snapshot.episode, snapshot.light, snapshot.light_yaw, bodies, gbuffer]
        inputs += [views, self.rules, self.most_share]
        launch_pixels(gather_kernel, views.count * spread_threads(self.cells), inputs, [self.guide, self.gathered], scene.device)

    def filter(self, views: Any) -> None:
        """Share light among cells, over windows that are as wide as the light is even."""
        shared = [self.scene.cameras, self.cells, self.guide]
        self._launch(sum_blocks_kernel, self.cells.cells, views.count, [*shared, self.gathered, views], [self.blocks])
        doubt = LONE_DOUBT if self.rules.samples == 1 else 1.0
        self._launch(choose_windows_kernel, self.cells.cells, views.count, [*shared, self.blocks, views, doubt], [self.chosen])
        self._launch(soften_shares_kernel, self.cells.cells, views.count, [*shared, self.chosen, views], [self.shares])

    def cast_shadows(self, snapshot: Snapshot, bodies: Any, gbuffer: Any, views: Any) -> None:
        """Visible shares of the main light."""
        scene, cells, shadows = self.scene, self.shadow_cells, self.shadows
        inputs = [scene.meshes, scene.table, scene.cameras, cells, scene.lights, snapshot.light, snapshot.light_yaw, bodies, gbuffer]
        inputs += [views]
        self._launch(cast_shadow_rays_kernel, cells.cells, views.count, inputs, [shadows.cast])
        inputs = [scene.meshes, scene.cameras, cells, scene.lights, snapshot.light, bodies, gbuffer, shadows.cast]
        inputs += [views]
        self._launch(filter_shadows_kernel, cells.cells, views.count, inputs, [shadows.smooth])

    def light(
        self,
        snapshot: Snapshot,
        bodies: Any,
        gbuffer: Any,
        views: Any,
        radiance: wp.array,
    ) -> None:
        """Radiance of each pixel from the light around it."""
        scene = self.scene
        inputs = [scene.paths, scene.cameras, self.cells, self.shadow_cells, snapshot.light, snapshot.light_yaw, bodies, gbuffer]
        inputs += [self.guide, self.shares, self.shadows.smooth, views]
        self._launch(shade_kernel, scene.grid, views.count, inputs, [radiance])

    def smooth(self, bodies: Any, gbuffer: Any, views: Any, image: Any) -> None:
        """Which pixels' radiance those on edges show: `mix` of the struct `ShadedImage`."""
        scene, edges = self.scene, self.edges
        edges.number.zero_()
        # Atomics of a launch on the CPU hold in one thread alone, so these are not cut into pieces.
        inputs = [scene.cameras, scene.grid, self.squares, gbuffer, image.radiance, views]
        outputs = [image.mix, edges.place, edges.number]
        squares = views.count * self.squares.tiles * int(TILE_PIXELS)
        wp.launch(find_edges_kernel, dim=squares, inputs=inputs, outputs=outputs, device=scene.device, block_dim=BLOCK)
        threads = EDGE_THREADS if scene.device.is_cuda else int(SAMPLES)
        inputs = [scene.meshes, scene.table, scene.cameras, scene.grid, self.squares, bodies, gbuffer, edges.place, edges.number]
        inputs += [views, threads]
        samples = views.count * edges.number.shape[1] * threads
        wp.launch(mix_edges_kernel, dim=samples, inputs=inputs, outputs=[image.mix], device=scene.device, block_dim=BLOCK)

    def _launch(self, kernel: wp.Kernel, grid: Any, count: int, inputs: list[Any], outputs: list[Any]) -> None:
        launch_pixels(kernel, count * grid.tiles * int(TILE_PIXELS), inputs, outputs, self.scene.device)
