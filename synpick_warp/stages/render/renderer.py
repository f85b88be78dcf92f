"""Pictures and ground truth of a batch of views, from a snapshot of all worlds."""

from __future__ import annotations

from typing import Any

from synpick_warp.arrays import allocate_struct, struct_arrays
from synpick_warp.configs.schema import REFERENCE, Config
from synpick_warp.kernels.render.images.antialias import ShadedImage
from synpick_warp.stages.buffers import LayerBuffers, Snapshot, ViewBuffers
from synpick_warp.stages.render.annotate import annotate
from synpick_warp.stages.render.denoised import DenoisedRenderer
from synpick_warp.stages.render.layers import LayerRenderer, sensor_parameters
from synpick_warp.stages.render.postprocess import PostProcessor
from synpick_warp.stages.render.raster import Rasterizer
from synpick_warp.stages.render.reference import ReferenceRenderer
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.render.view_setup import GBUFFER, VIEW_BODIES, body_sizes, set_up_views
from synpick_warp.stages.timing import scope

SHADED_IMAGE = struct_arrays(ShadedImage, "view", "row", "column")


class Renderer:
    """Renders and annotates batches of views. Owns its scratch; `render` only launches, so a CUDA graph can capture it."""

    def __init__(self, config: Config, scene: RenderScene, instances: int, views: int) -> None:
        """Allocate scratch.

        Args:
            config: All settings.
            scene: Constant data.
            instances: Room for instances of a world, at most 32: one bit each.
            views: Most views of a batch.
        """
        sizes = {"view": views, "row": scene.height, "column": scene.width} | body_sizes(instances, scene.width, scene.height)
        self.scene = scene
        self.instances = instances
        self.views = views
        self.bodies = allocate_struct(VIEW_BODIES, sizes, scene.device)
        self.gbuffer = allocate_struct(GBUFFER, sizes, scene.device)
        self.image = allocate_struct(SHADED_IMAGE, sizes, scene.device)
        if config.render.mode == REFERENCE:
            self.shading: DenoisedRenderer | ReferenceRenderer = ReferenceRenderer(config.render, config.bake.seed, scene)
        else:
            self.shading = DenoisedRenderer(config.render, config.bake.seed, scene, views)
        self.rasterizer = Rasterizer(scene, 1000.0 / config.bop.depth_scale, views)
        sensor = sensor_parameters(config.depth_sensor, config.bake.seed, config.bop.depth_scale)
        self.layer_renderer = LayerRenderer(config.render.layers, sensor, scene, instances, views)
        self.postprocessor = PostProcessor(config.effects, config.render.tone, config.bake.seed, scene, views)

    def render(self, snapshot: Snapshot, views: Any, out: ViewBuffers, layers: LayerBuffers | None = None) -> None:
        """Render and annotate a batch of views: the one place that knows the order of the passes.

        Args:
            snapshot: The worlds.
            views: The struct `Views`.
            out: Written.
            layers: Written, if given.

        Raises:
            ValueError: More views than there is scratch for.
        """
        if views.count > self.views:
            raise ValueError(f"{views.count} views in a batch; this renderer has scratch for {self.views}")
        if views.count == 0:
            return
        device = self.scene.device
        self.render_gbuffer(snapshot, views, out)
        if layers is not None:
            with scope("layers", device):
                self.layer_renderer.render(snapshot, self.bodies, self.gbuffer, views, layers)
        with scope("shade", device):
            self.shading.shade(snapshot, self.bodies, self.gbuffer, views, self.image)
        with scope("post-process", device):
            self.postprocessor.process(snapshot, views, self.image, out)
        with scope("annotate", device):
            annotate(self.scene, self.bodies, views, out)

    def render_gbuffer(self, snapshot: Snapshot, views: Any, out: ViewBuffers) -> None:
        """First part of `render`: the G-buffer, and the images of depth, instances and amodal bits."""
        scene = self.scene
        with scope("set up views", scene.device):
            set_up_views(scene, scene.cameras, scene.grid, snapshot, snapshot.fixture_visible, views, self.bodies)
        with scope("rasterize", scene.device):
            self.rasterizer.rasterize(self.bodies, views, self.gbuffer, out)
