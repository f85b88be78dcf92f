"""Denoised renderer: coarse path pass, variance-guided denoiser, lamp shadows, deferred shading and anti-aliasing; and the path-traced
reference renderer.

Mode unoccluded leaves out the first two: no ambient occlusion, no indirect light.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.configs.schema import Render
from synpick_warp.kernels.render.images.antialias import (
    CHUNK_TILES,
    FootprintLists,
    find_footprints_kernel,
    resolve_footprints_kernel,
)
from synpick_warp.kernels.render.images.kept_sources import WORD_SAMPLES, KeptSources, forget_sources_kernel
from synpick_warp.kernels.render.lighting import denoise as denoising
from synpick_warp.kernels.render.lighting import shadow_edges
from synpick_warp.kernels.render.lighting.coarse_grid import CoarseGrid, Guide
from synpick_warp.kernels.render.lighting.dirty_tiles import mark_damaged_tiles_kernel, mark_relit_tiles_kernel, plan_passes_kernel
from synpick_warp.kernels.render.lighting.history import NEVER, LightHistory, advance_history_kernel
from synpick_warp.kernels.render.lighting.moving_bodies import MovingBodies, find_moving_bodies_kernel
from synpick_warp.kernels.render.lighting.paths.bounces import extend_queued_paths_kernel
from synpick_warp.kernels.render.lighting.paths.coarse import start_paths_kernel, trace_coarse_paths_kernel
from synpick_warp.kernels.render.lighting.paths.light import CoarseLight
from synpick_warp.kernels.render.lighting.paths.lists import REGION_PIXELS, PathLists
from synpick_warp.kernels.render.lighting.paths.queues import PATH_RECORDS, QUEUE_CAPACITY, PathQueues
from synpick_warp.kernels.render.lighting.paths.reuse import reuse_histories_kernel, schedule_paths_kernel
from synpick_warp.kernels.render.lighting.paths.tracing import COMBINED, PathRules, trace_paths_kernel
from synpick_warp.kernels.render.lighting.shading import DenoisedLight, shade_kernel, shade_samples_kernel
from synpick_warp.kernels.render.lighting.shadow_edges import CHUNK_TILES as EDGE_CHUNK_TILES
from synpick_warp.kernels.render.lighting.shadow_filter import LampShadows, filter_shadows_kernel, measure_steepness_kernel
from synpick_warp.kernels.render.lighting.shadows import ShadowRays, trace_shadow_rays_kernel
from synpick_warp.kernels.render.lighting.tile_flags import ALL_STAGES, TileFlags
from synpick_warp.kernels.render.lighting.upsampling import RatioImages
from synpick_warp.kernels.render.visibility.camera import TILE_HEIGHT, TILE_PIXELS
from synpick_warp.kernels.render.visibility.damage import Damage
from synpick_warp.kernels.render.visibility.variants import kernel_for
from synpick_warp.kernels.tuning import CPU_EDGE_THREADS, CPU_FOOTPRINT_THREADS, EDGE_THREADS, FOOTPRINT_THREADS, PIXEL_BLOCK, VIEW_BLOCK
from synpick_warp.stages.arrays import allocate_struct, bundle, struct_arrays
from synpick_warp.stages.buffers import FIXTURES, Snapshot
from synpick_warp.stages.launch import launch_pixels, launch_views
from synpick_warp.stages.render import sampling_rates
from synpick_warp.stages.render.looks import shade_floor
from synpick_warp.stages.render.scene import RenderScene, build_grid
from synpick_warp.stages.render.view_setup import body_sizes
from synpick_warp.stages.timing import scope

REFERENCE_ROULETTE = 2
"""First bounce with Russian roulette: the first bounces carry most of the light."""


def make_path_rules(render: Render, seed: int, samples: int, roulette: int) -> Any:
    """Make the path tracer's parameters: multiple importance sampling (Veach and Guibas, 1995) and no path regularization."""
    rules = PathRules()
    rules.samples = rules.first_samples = samples
    rules.bounces = render.bounces
    rules.roulette = roulette
    rules.strategy = int(COMBINED)
    rules.seed = seed
    return rules


class ReferenceRenderer:
    """Path tracer for reference images in linear radiance. `shade` only launches kernels."""

    def __init__(self, render: Render, seed: int, scene: RenderScene) -> None:
        """`render`: render settings: `samples` and `bounces`. `seed`: seed of the data set. `scene`: constant data."""
        self.scene = scene
        self.rules = make_path_rules(render, seed, render.samples, REFERENCE_ROULETTE)

    def shade(self, snapshot: Snapshot, shot: Any, image: Any, add: Callable[[Any, Any], None] | None = None) -> None:
        """Render the radiance of a batch of views; arguments as of `DenoisedRenderer.shade`. It is anti-aliased. Each path traces its own
        camera ray: the G-buffer is read for the floor alone."""
        scene, pixels = self.scene, shot.views.count * self.scene.grid.tiles * int(TILE_PIXELS)
        launch_pixels(trace_paths_kernel, pixels, [scene.paths, shot, self.rules], [image], scene.device)
        shade_floor(scene, shot, image)
        if add is not None:
            add(shot, image)


SINGLE_PATH_VARIANCE_SCALE = 2.0
"""Variance multiplier at one path per coarse pixel, where the sample variance underestimates bright small sources: few paths hit them, and
those that do would look like a change of the light (on ten piles, 1 is 0.2 dB worse; 1.5 and 3 are nearly as good)."""
MIN_ROUGHNESS = 0.3
"""Path regularization: smallest roughness after the first surface (Kaplanyan and Dachsbacher, 2013). Caustics blur instead of sparkling."""
FIREFLY_CLAMP = 32.0
"""Firefly clamp: a path counts with at most this many times the unoccluded light, or single paths would show as patches; light from
surfaces that lamps light is added to the limit. The light cut off is a bias: in eight episodes under real maps -0.4 %; with 8 times -1.0,
with 64 times -0.3 % (tools/DECISIONS.md)."""
ROULETTE = 1
"""First bounce with Russian roulette: few paths are long, since many neighbours share them."""


MAX_QUEUE_REGIONS = 8192
"""Maximum number of regions with path queues at a time, those of 32 views in full HD; views of a larger batch take turns. With a quarter,
launches wait for their longest path on a nearly idle GPU, and queues gain nothing."""
MAX_QUEUE_FRACTION = 1 / 96
"""Maximum size of path queues as a fraction of the device's memory. At full HD, 42 views fit into that of an H100, and 6 into that of a GPU
of 12 GiB, which is better used for worlds."""

GUIDE = struct_arrays(Guide, "view", "cell_row", "cell_column")
COARSE_LIGHT = struct_arrays(CoarseLight, "view", "cell_row", "cell_column")
LAMP_SHADOWS = struct_arrays(LampShadows, "view", "shadow_row", "shadow_column", edge=("view", "row", "column"))
EDGE_LISTS = struct_arrays(
    shadow_edges.EdgeLists,
    "view",
    "edge_chunk",
    cell=("view", "edge_chunk", "chunk_cell"),
    pixel=("view", "edge_chunk", "chunk_pixel"),
    count=("view", "edge_chunk", "edge_counter"),
)
LIGHT_HISTORY = struct_arrays(
    LightHistory,
    "world_camera",
    "cell_row",
    "cell_column",
    shadows=("world_camera", "shadow_row", "shadow_column"),
    episode=("world_camera",),
    frame=("world_camera",),
)
TILE_FLAGS = struct_arrays(
    TileFlags,
    "view",
    **dict.fromkeys(("history_row", "kept_row", "holds"), ("view",)),
    stages=("view", "cell_tile"),
    due=("view", "cell_tile"),
    shadowed=("view", "shadow_tile"),
    dirty=("view", "tile"),
    bodies=("kept", "tile", "body_word"),
)
MOVING_BODIES = struct_arrays(
    MovingBodies,
    "view",
    "body",
    **dict.fromkeys(("holds", "count", "all_lower", "all_upper"), ("view",)),
    units=dict.fromkeys(("to_body", "lower", "upper", "all_lower", "all_upper"), "m"),
)
PATH_LISTS = struct_arrays(
    PathLists, "view", "region", "rank", count=("view", "region", "path_kind"), listed=("view", "cell_row", "cell_column")
)
PATH_QUEUES = struct_arrays(
    PathQueues,
    "queue_view",
    "queue_region",
    count=("queue_view", "queue_region", "queue_stage"),
    slot=("queue_view", "queue_region", "stage_parity", "queue_slot"),
    record=("queue_view", "queue_region", "path_record"),
)
RATIO_IMAGES = struct_arrays(RatioImages, "view", "cell_row", "cell_column")
KEPT_RATIOS = struct_arrays(RatioImages, "world_camera", "cell_row", "cell_column")
SHADOW_RAYS = struct_arrays(ShadowRays, "view", "shadow_row", "shadow_column")
KEPT_SOURCES = struct_arrays(KeptSources, "kept", "source_word")
FOOTPRINT_LISTS = struct_arrays(FootprintLists, "view", "chunk", footprint=("view", "chunk", "chunk_footprint"))


def scratch_sizes(render: Render, width: int, height: int, histories: int = 0) -> dict[str, int]:
    """Extents of the dimensions of the scratch other than the view, for images of `width` x `height` px."""
    size = sampling_rates.coarse_size(render, width, histories)
    shadow = sampling_rates.shadow_size(size)
    tile_pixels = int(TILE_PIXELS) * shadow**2
    edge_tiles = min(int(EDGE_CHUNK_TILES), shadow_edges.MAX_CHUNK_PIXELS // tile_pixels)
    chunks = -(-footprint_grid(width, height).tiles // int(CHUNK_TILES)) if render.antialias else 0
    samples = (width + 1) * (height + 1) * sampling_rates.coverage_rays(render, width, histories)
    columns, rows = (-(-width // size), -(-height // size)) if sampling_rates.traces_paths(render) else (0, 0)
    return {
        "cell_row": rows,
        "cell_column": columns,
        "region": sampling_rates.interleaved_threads(columns, rows) // int(REGION_PIXELS)
        if sampling_rates.accumulates(render, histories)
        else 0,
        "rank": int(REGION_PIXELS),
        "path_kind": 2,
        "row": height,
        "column": width,
        "shadow_row": -(-height // shadow),
        "shadow_column": -(-width // shadow),
        "edge_chunk": -(-build_grid(-(-width // shadow), -(-height // shadow)).tiles // edge_tiles),
        "chunk_cell": edge_tiles * int(TILE_PIXELS),
        "chunk_pixel": edge_tiles * tile_pixels,
        "edge_counter": 2,
        "chunk": chunks,
        "source_word": -(-samples // int(WORD_SAMPLES)) if render.antialias else 0,
        "chunk_footprint": int(CHUNK_TILES) * int(TILE_PIXELS),
    }


def queue_sizes(render: Render, width: int, height: int, views: int, histories: int, device: wp.Device) -> dict[str, int]:
    """Extents of the dimensions of `PATH_QUEUES`, for at most `views` views of a batch. There are no queues on a CPU, which has no warps,
    nor where no paths are traced, or several in every coarse pixel."""
    single = sampling_rates.accumulates(render, histories) or sampling_rates.paths_per_coarse_pixel(render, width, histories) == 1
    size = sampling_rates.coarse_size(render, width, histories)
    regions = sampling_rates.interleaved_threads(-(-width // size), -(-height // size)) // int(REGION_PIXELS)
    queues = device.is_cuda and sampling_rates.traces_paths(render) and single
    return {
        "queue_view": queue_views(views, regions, device.total_memory) if queues else views,
        "queue_region": regions if queues else 0,
        "queue_stage": max(1, render.bounces - 1),
        "stage_parity": 2,
        "queue_slot": int(QUEUE_CAPACITY),
        "path_record": int(PATH_RECORDS) * int(QUEUE_CAPACITY),
    }


def queue_views(views: int, regions: int, memory: int) -> int:
    """Number of views with path queues at a time, on a device with this much `memory` [bytes], so that turns are of equal length."""
    size = regions * int(QUEUE_CAPACITY) * int(PATH_RECORDS) * wp.types.type_size_in_bytes(wp.vec4)
    most = max(1, min(MAX_QUEUE_REGIONS // regions, int(MAX_QUEUE_FRACTION * memory) // size))
    return -(-views // -(-views // most))


def history_sizes(render: Render, width: int, height: int, histories: int) -> dict[str, int]:
    """Extents of the dimensions of `LIGHT_HISTORY`, for `histories` worlds times cameras with images of `width` x `height` px."""
    return scratch_sizes(render, width, height, histories) | {
        "world_camera": histories if sampling_rates.keeps_frames(render, histories) else 0
    }


def build_coarse_grid(image: Any, size: int, rays: int = 1) -> Any:
    """The struct `CoarseGrid` over an `ImageGrid`: coarse pixels of `size` x `size` px; see there for `rays`."""
    coarse = CoarseGrid()
    coarse.size = size
    coarse.rays = rays
    coarse.image = image
    coarse.grid = build_grid(-(-image.width // size), -(-image.height // size))
    return coarse


def footprint_grid(width: int, height: int) -> Any:
    """The struct `ImageGrid` of AA footprints, with the halves of footprints at the image border."""
    return build_grid(width + 1, height + 1)


class DenoisedRenderer:
    """Renders linear radiance from a few paths per coarse pixel and a denoiser; in mode unoccluded from unoccluded light and lamp shadows.
    Allocates its scratch once; `shade` only launches kernels."""

    def __init__(
        self,
        render: Render,
        seed: int,
        scene: RenderScene,
        instances: int,
        views: int,
        histories: int = 0,
    ) -> None:
        """Allocate scratch. `render`: render settings: `mode` fast or unoccluded, `coarse_pixel`, `coarse_paths`, `bounces`, `history` and
        `antialias`. `seed`: seed of the data set. `views`: capacity of a batch. `histories`: worlds times cameras whose light is averaged
        over frames; 0: each frame by itself."""
        size = sampling_rates.coarse_size(render, scene.width, histories)
        sizes = {"view": views} | scratch_sizes(render, scene.width, scene.height, histories)
        self.scene = scene
        self.traces_paths = sampling_rates.traces_paths(render)
        self.coarse = build_coarse_grid(scene.grid, size)
        if not self.traces_paths:
            self.coarse.size = 0
        self.shadow_grid = build_coarse_grid(scene.grid, sampling_rates.shadow_size(size), sampling_rates.edge_rays(size))
        self.rules = make_path_rules(render, seed, sampling_rates.paths_per_coarse_pixel(render, scene.width, histories), ROULETTE)
        self.rules.first_samples = sampling_rates.first_frame_paths(render, scene.width, histories)
        self.rules.min_roughness, self.rules.firefly_clamp = MIN_ROUGHNESS, FIREFLY_CLAMP
        self.variance_scale = SINGLE_PATH_VARIANCE_SCALE if self.rules.samples == 1 else 1.0
        self.history = allocate_struct(LIGHT_HISTORY, history_sizes(render, scene.width, scene.height, histories), scene.device)
        self.history.cameras, self.history.max_paths = (
            scene.camera_count,
            render.history if sampling_rates.accumulates(render, histories) else 0,
        )
        self.history.frame.fill_(int(NEVER))
        keeps = sampling_rates.keeps_frames(render, histories)
        self.history.kept = self.kept = sampling_rates.kept_views(render, scene.camera_count, histories)
        self.kept_rows = self.kept + views if 0 < self.kept < histories else self.kept
        sizes |= body_sizes(instances, scene.width, scene.height) | {"world_camera": histories if keeps else 0, "kept": self.kept_rows}
        self.moving = allocate_struct(MOVING_BODIES, {"view": views, "body": instances + len(FIXTURES)}, scene.device)
        self.guide = allocate_struct(GUIDE, sizes, scene.device)
        self.path_lists = allocate_struct(PATH_LISTS, sizes, scene.device)
        queues = queue_sizes(render, scene.width, scene.height, views, histories, scene.device)
        self.queues = allocate_struct(PATH_QUEUES, queues, scene.device)
        self.coarse_light, self.blocks = (allocate_struct(COARSE_LIGHT, sizes, scene.device) for _ in range(2))
        self.chosen = allocate_struct(RATIO_IMAGES, sizes, scene.device)
        self.ratios = allocate_struct(KEPT_RATIOS if keeps else RATIO_IMAGES, sizes, scene.device)
        self.shadow_rays = allocate_struct(SHADOW_RAYS, sizes, scene.device)
        self.shadows = allocate_struct(LAMP_SHADOWS, sizes, scene.device)
        self.edge_lists = allocate_struct(EDGE_LISTS, sizes, scene.device)
        self.shade_kernel = shade_samples_kernel if sampling_rates.supersamples(render, scene.width, histories) else shade_kernel
        self.antialias = render.antialias
        self.coverage_rays = sampling_rates.coverage_rays(render, scene.width, histories)
        sizes["cell_tile"], sizes["shadow_tile"] = self.coarse.grid.tiles, self.shadow_grid.grid.tiles
        self.flags = allocate_struct(TILE_FLAGS, sizes, scene.device)
        self.flags.stages.fill_(ALL_STAGES)
        self.flags.history_row.assign(np.arange(views))
        self.footprints = footprint_grid(scene.width, scene.height)
        self.footprint_lists = allocate_struct(FOOTPRINT_LISTS, sizes, scene.device)
        self.kept_sources = allocate_struct(KEPT_SOURCES, sizes, scene.device)

    def shade(self, snapshot: Snapshot, shot: Any, image: Any, add: Callable[[Any, Any], None] | None = None) -> None:
        """Render the radiance of a batch of views, for which `find_damage` was called. `snapshot`: the worlds. `shot`: the struct
        `ShotData`. `image`: the struct `ShadedImage`; written. `add`: adds what is behind transparent surfaces to it."""
        device = self.scene.device
        if self.traces_paths:
            with scope("trace coarse paths", device):
                self.trace_coarse_paths(shot)
            with scope("denoise", device):
                self.denoise(shot.views)
        with scope("lamp shadows", device):
            self.trace_shadows(shot, image)
        with scope("shade pixels", device):
            self.shade_pixels(shot, image)
            if add is not None:
                add(shot, image)
        if self.antialias:
            with scope("anti-alias", device):
                self.resolve_footprints(shot, image)

    def find_damage(self, snapshot: Snapshot, bodies: Any, views: Any) -> Any:
        """Find the bodies that moved since the previous frame, where the light history contains that frame, and their tiles; sets the
        history's frame to this one.

        Writes `moving`, `flags.dirty` and the frame indices of `history`; nothing if no frame is kept. Returns the struct `Damage`; None
        without reuse.
        """
        if self.history.frame.size == 0:
            return None
        options: dict[str, Any] = {"dim": views.count, "device": self.scene.device, "block_dim": VIEW_BLOCK}
        inputs = [snapshot.frames, views]
        wp.launch(kernel_for(advance_history_kernel, views), inputs=inputs, outputs=[self.history, self.moving, self.flags], **options)
        inputs = [self.scene.meshes, snapshot.bundle, views.world, views.instances, self.moving.mesh.shape[1]]
        wp.launch(find_moving_bodies_kernel, inputs=inputs, outputs=[self.moving], **options)
        if self.kept == 0:
            return None
        dim, outputs = (views.count, self.scene.grid.tiles), [self.moving, self.flags]
        wp.launch(mark_damaged_tiles_kernel, dim=dim, inputs=[bodies], outputs=outputs, device=self.scene.device, block_dim=PIXEL_BLOCK)
        return bundle(Damage, self.flags, self.moving)

    def trace_coarse_paths(self, shot: Any) -> None:
        """Coarse path pass: guide image and light of coarse pixels, traced or taken from the history (temporal accumulation). Wavefront
        path tracing where there are queues: one launch for the first bounce, then one for each further bounce."""
        scene, views, threads = self.scene, shot.views, sampling_rates.interleaved_threads(self.coarse.grid.width, self.coarse.grid.height)
        if self.history.max_paths > 0:
            self.path_lists.count.zero_()
            self.flags.due.zero_()
            inputs, outputs = [scene.paths, self.coarse, shot, self.moving], [self.history, self.path_lists, self.flags]
            launch_views(schedule_paths_kernel, views.count, threads, inputs, outputs, scene.device)
            dim, inputs = (views.count, self.coarse.grid.tiles), [self.coarse.grid]
            wp.launch(denoising.plan_stages_kernel, dim=dim, inputs=inputs, outputs=[self.flags], device=scene.device)
            inputs, outputs = (
                [scene.paths, self.coarse, shot, self.path_lists, self.flags],
                [self.history, self.guide, self.coarse_light],
            )
            self._launch(reuse_histories_kernel, self.coarse.grid, views, inputs, outputs)
        inputs = [scene.paths, self.coarse, shot, self.path_lists, self.rules]
        outputs = [self.queues, self.history, self.guide, self.coarse_light]
        if self.queues.count.shape[1] == 0:
            launch_pixels(trace_coarse_paths_kernel, views.count * threads, inputs, outputs, scene.device)
            return
        launch_views(trace_coarse_paths_kernel, views.count, threads, inputs, outputs, scene.device)
        turn = self.queues.count.shape[0]
        for first_view in range(0, views.count, turn):
            count = min(views.count - first_view, turn)
            self.queues.count.zero_()
            launch_views(start_paths_kernel, count, threads, inputs, outputs, scene.device, first_view)
            self.extend_queued_paths(shot, first_view, count)

    def extend_queued_paths(self, shot: Any, first_view: int, count: int) -> None:
        """Later bounces of the queued paths of `count` views from `first_view` on, one launch a bounce."""
        threads = self.queues.count.shape[1] * int(QUEUE_CAPACITY)
        outputs = [self.queues, self.history, self.coarse_light]
        for stage in range(self.rules.bounces - 1):
            inputs = [self.scene.paths, self.coarse, shot, self.rules, stage]
            launch_views(extend_queued_paths_kernel, count, threads, inputs, outputs, self.scene.device, first_view)

    def denoise(self, views: Any) -> None:
        """Filter visibility ratios: block means, choice of the kernel's width, smoothing."""
        shared = [self.coarse, self.guide]
        self._launch(
            denoising.filter_blocks_kernel, self.coarse.grid, views, [*shared, self.coarse_light, views, self.flags], [self.blocks]
        )
        inputs = [*shared, self.blocks, views, self.flags, self.variance_scale]
        self._launch(denoising.choose_widths_kernel, self.coarse.grid, views, inputs, [self.chosen])
        inputs = [*shared, self.chosen, views, self.flags]
        self._launch(denoising.smooth_ratios_kernel, self.coarse.grid, views, inputs, [self.ratios])

    def trace_shadows(self, shot: Any, image: Any) -> None:
        """Visibility of the lamps: shadow rays and filter on the shadow grid, rays from pixels at steep edges; see `trace_shadow_edges`."""
        coarse, views, inputs = self.shadow_grid, shot.views, [self.scene.plain, self.shadow_grid, shot]
        self.flags.shadowed.zero_()
        outputs = [self.history, self.shadow_rays, self.flags]
        self._launch(trace_shadow_rays_kernel, coarse.grid, views, [*inputs, self.moving], outputs)
        for kernel in (filter_shadows_kernel, measure_steepness_kernel):
            self._launch(kernel, coarse.grid, views, [*inputs, self.shadow_rays], [self.shadows])
        self.mark_relit_tiles(shot)
        self.trace_shadow_edges(shot, image)

    def mark_relit_tiles(self, shot: Any) -> None:
        """Mark the tiles that differ from the frame before in light and shadows; nothing without reuse."""
        if self.kept:
            inputs = [self.coarse, self.shadow_grid, shot]
            dim = (shot.views.count, shot.grid.tiles)
            kernel = kernel_for(mark_relit_tiles_kernel, *inputs)
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=[self.flags], device=self.scene.device, block_dim=PIXEL_BLOCK)

    def plan_passes(self, shot: Any, image: Any) -> None:
        """Plan what is computed anew in each tile, once all dirty ones are marked; nothing without reuse."""
        if self.kept:
            inputs, dim = [shot.grid, self.flags], (shot.views.count, shot.grid.tiles)
            wp.launch(plan_passes_kernel, dim=dim, inputs=inputs, outputs=[image], device=self.scene.device, block_dim=PIXEL_BLOCK)

    def trace_shadow_edges(self, shot: Any, image: Any) -> None:
        """Adaptive sampling at steep shadow edges: list the pixels there, trace their shadow rays, and filter the visible fractions, which
        lie in the image's radiance until the pixels are shaded."""
        scene, lists, coarse, device, views = self.scene, self.edge_lists, self.shadow_grid, self.scene.device, shot.views
        lists.count.zero_()
        self.shadows.edge.zero_()
        outputs = [self.shadows, lists]
        launch_views(
            shadow_edges.list_edge_cells_kernel, views.count, coarse.grid.tiles * int(TILE_PIXELS), [coarse, views], outputs, device
        )
        threads = EDGE_THREADS if device.is_cuda else CPU_EDGE_THREADS
        sharing = lists.count.shape[1] * threads
        inputs = [scene.meshes, coarse, scene.lights, shot, self.moving, threads]
        launch_views(shadow_edges.list_edge_pixels_kernel, views.count, sharing, inputs, [*outputs, self.flags], device)
        self.plan_passes(shot, image)
        inputs = [scene.plain, coarse, shot, lists]
        launch_pixels(shadow_edges.trace_shadow_edges_kernel, views.count * sharing, [*inputs, image, threads], [self.shadows], device)
        launch_pixels(shadow_edges.filter_shadow_edges_kernel, views.count * sharing, [*inputs, self.shadows, threads], [image], device)

    def shade_pixels(self, shot: Any, image: Any) -> None:
        """Deferred shading: radiance of each pixel."""
        self._launch(self.shade_kernel, shot.grid, shot.views, [self.scene.paths, shot, bundle(DenoisedLight, self, self.flags)], [image])
        shade_floor(self.scene, shot, image)

    def resolve_footprints(self, shot: Any, image: Any) -> None:
        """Anti-alias by coverage rays; writes `image.resolve` and `image.samples`."""
        image.samples = self.coverage_rays
        lists, device = self.footprint_lists, self.scene.device
        lists.count.zero_()
        # Atomics of a launch on the CPU hold in one thread alone, so these are not cut into pieces.
        options: dict[str, Any] = {"device": device, "block_dim": PIXEL_BLOCK}
        if self.kept_sources.word.size:
            dim, inputs = (shot.views.count, shot.grid.tiles, int(TILE_HEIGHT) + 1), [shot.grid, self.flags, self.coverage_rays]
            wp.launch(forget_sources_kernel, dim=dim, inputs=inputs, outputs=[self.kept_sources], **options)
        inputs, outputs = [self.footprints, shot, self.flags.kept_row], [image, lists, self.kept_sources]
        dim = shot.views.count * self.footprints.tiles * int(TILE_PIXELS)
        wp.launch(kernel_for(find_footprints_kernel, *inputs), dim=dim, inputs=inputs, outputs=outputs, **options)
        threads = FOOTPRINT_THREADS if device.is_cuda else CPU_FOOTPRINT_THREADS
        inputs = [self.scene.plain, self.footprints, shot, lists, self.flags.kept_row, threads]
        outputs = [image, self.kept_sources]
        dim = shot.views.count * lists.count.shape[1] * threads
        wp.launch(kernel_for(resolve_footprints_kernel, *inputs), dim=dim, inputs=inputs, outputs=outputs, **options)

    def _launch(self, kernel: wp.Kernel, grid: Any, views: Any, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel over all pixels of a grid in all views."""
        launch_pixels(kernel, views.count * grid.tiles * int(TILE_PIXELS), inputs, outputs, self.scene.device)
