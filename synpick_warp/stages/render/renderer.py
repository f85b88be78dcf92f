"""Renderer: images, annotation layers and ground truth of a batch of views, from a snapshot of all worlds; and transparent bodies: the
scene behind them, rendered without them, and its light on the pictures that show them."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import warp as wp

from synpick_warp.configs import schema
from synpick_warp.configs.cell.cameras import DepthSensor, Effects
from synpick_warp.configs.schema import Render
from synpick_warp.kernels.render.images.transparency import add_scene_behind_kernel, trace_scene_behind_kernel
from synpick_warp.kernels.render.lighting.transparency import BodyGroups, group_bodies_kernel
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.kernels.render.visibility.gbuffer import ALL_PASSES, ShadedImage, ViewBodies
from synpick_warp.stages.arrays import allocate_struct, bundle, struct_arrays
from synpick_warp.stages.buffers import LayerBuffers, Snapshot, ViewBuffers
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.render.annotate import Annotator
from synpick_warp.stages.render.cameras import allocate_view_cameras
from synpick_warp.stages.render.denoised import DenoisedRenderer, ReferenceRenderer
from synpick_warp.stages.render.layers import LayerRenderer, sensor_parameters
from synpick_warp.stages.render.looks import Dresser
from synpick_warp.stages.render.postprocess import PostProcessor, Shutter, has_effects
from synpick_warp.stages.render.raster import Rasterizer
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.render.view_setup import (
    GBUFFER,
    VIEW_BODIES,
    PropPlacer,
    bin_bodies,
    body_sizes,
    make_shot,
    set_up_views,
    with_cameras,
)
from synpick_warp.stages.timing import scope

SHADED_IMAGE = struct_arrays(ShadedImage, "view", "row", "column", passes=("view", "tile"))
BODY_GROUPS = struct_arrays(
    BodyGroups,
    "view",
    "body",
    ray_record=("view", "body", "record"),
    opaque=("view",),
    blocking=("view",),
    body_mask=("view", "tile", "body_word"),
)


def allocate_image(sizes: dict[str, int], device: wp.Device) -> Any:
    """The struct `ShadedImage` of views whose pixels are all due."""
    image = allocate_struct(SHADED_IMAGE, sizes, device)
    image.passes.fill_(ALL_PASSES)
    return image


class SceneBehind:
    """The scene without its transparent bodies, rendered by a rasterizer and a denoised renderer of its own, which keeps its own light. The
    reference renderer needs neither: its paths go on behind; layers need the first. All but the constructor only launches kernels."""

    def __init__(
        self,
        scene: RenderScene,
        front: DenoisedRenderer | ReferenceRenderer | None,
        rasterizer: Rasterizer,
        settings: tuple[Render, int],
        instances: int,
        views: int,
        histories: int,
        layers: bool,
    ) -> None:
        """Allocate scratch. `front`, `rasterizer`: those of all bodies. `settings`: those of the renderer, and the seed. `layers`: whether
        layers see through bodies. Others: as of `Renderer`."""
        sizes = {"view": views, "row": scene.height, "column": scene.width} | body_sizes(instances, scene.width, scene.height)
        self.scene = scene
        self.groups = allocate_struct(BODY_GROUPS, sizes, scene.device)
        self.rules = None if front is None else front.rules
        self.shading: DenoisedRenderer | None = None
        self.gbuffer: Any = None
        if layers or isinstance(front, DenoisedRenderer):
            self.rasterizer = Rasterizer(scene, rasterizer.counts_per_meter, views, instances, rasterizer.background)
            self.gbuffer = allocate_struct(GBUFFER, sizes, scene.device)
        if isinstance(front, DenoisedRenderer):
            self.shading = DenoisedRenderer(*settings, scene, instances, views, histories)
            self.image = allocate_image(sizes, scene.device)

    def group(self, views: Any, bodies: Any) -> None:
        """Order the struct `ViewBodies` by transparency, once it is set up and dressed."""
        wp.launch(
            group_bodies_kernel,
            dim=bodies.order.shape,
            inputs=[self.scene.surfaces, bodies],
            outputs=[self.groups],
            device=self.scene.device,
        )
        wp.copy(bodies.order, self.groups.order)
        wp.copy(bodies.ray_record, self.groups.ray_record)
        bin_bodies(self.scene, views, bodies)
        bin_bodies(self.scene, views, self.opaque(bodies, self.groups.opaque))

    def opaque(self, bodies: Any, present: Any) -> Any:
        """The struct `ViewBodies` of which camera rays meet opaque bodies alone, and all others those of `present`."""
        return bundle(ViewBodies, SimpleNamespace(present=present, body_mask=self.groups.body_mask), bodies)

    def rasterize(self, snapshot: Snapshot, shot: Any) -> Any:
        """Render the G-buffer of the scene behind views; takes their, returns its struct `ShotData`; None: nothing needs it."""
        if self.gbuffer is None:
            return None
        bodies = self.opaque(shot.bodies, self.groups.opaque)
        self.rasterizer.rasterize(bodies, shot.views, self.gbuffer)
        return make_shot(self.scene, snapshot.frames, bodies, self.gbuffer, shot.views)

    def render(self, snapshot: Snapshot, shot: Any) -> Any:
        """Shade the scene behind the views of the struct `ShotData`, if it is not traced; returns them as their light is to be found:
        without bodies that cast no shadows."""
        scene, views = self.scene, shot.views
        if self.shading is not None:
            drawn, lit = (self.opaque(shot.bodies, present) for present in (self.groups.opaque, self.groups.blocking))
            self.shading.find_damage(snapshot, drawn, views)
            self.shading.shade(snapshot, make_shot(scene, snapshot.frames, lit, self.gbuffer, views), self.image)
        lit = bundle(ViewBodies, SimpleNamespace(present=self.groups.blocking), shot.bodies)
        return make_shot(scene, snapshot.frames, lit, shot.gbuffer, views)

    def add(self, shot: Any, image: Any) -> None:
        """Add what is behind to the radiance of transparent surfaces in the struct `ShadedImage`."""
        pixels = shot.views.count * self.scene.grid.tiles * int(TILE_PIXELS)
        kernel, behind = add_scene_behind_kernel, () if self.shading is None else (self.image, self.gbuffer.depth)
        if self.shading is None:
            kernel, behind = trace_scene_behind_kernel, (self.opaque(shot.bodies, self.groups.opaque), self.rules)
        launch_pixels(kernel, pixels, [self.scene.paths, shot, *behind], [image], self.scene.device)


class Renderer:
    """Renders and annotates batches of views. Owns its scratch; `render` only launches kernels, so a CUDA graph can capture it.

    Passes: view setup, rasterization to a G-buffer, annotation layers, shading (denoised or path-traced reference), post-processing,
    boxes and pixel counts.

    Attributes:
        instances: Instance capacity of a world.
        views: Maximum number of views of a batch.
        cameras: The struct `CameraTable` of the last batch, or `LensCameras` if some cameras are distorted.
        bodies: The struct `ViewBodies` of the last batch.
        gbuffer: The struct `GBuffer` of the last batch.
        image: The struct `ShadedImage` of the last batch: linear radiance.
        shading: Shades it; None: there are no colour images.
    """

    def __init__(
        self,
        scene: RenderScene,
        settings: schema.Render,
        effects: Effects,
        depth_sensor: DepthSensor,
        *,
        seed: int,
        depth_scale: float,
        instances: int,
        views: int,
        histories: int = 0,
        colors: bool = True,
        shutter: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Allocate scratch. `seed`: seed of all random numbers. `depth_scale`: millimetres per count of the depth image. `instances`:
        instance capacity of a world, at most `MAX_INSTANCES`. `histories`: worlds times cameras whose light is averaged over the frames of
        an episode; 0: each frame is rendered by itself. `colors`: whether colour images are wanted; else they stay as they are, and nothing
        is shaded. `shutter`: exposure and readout time of colour images [frames]; 0, 0: an instant."""
        self.shutter: Shutter | None = None
        if colors and any(shutter):
            still = replace(settings, layers=())
            given = {"seed": seed, "depth_scale": depth_scale, "instances": instances, "views": views}
            self.shutter = Shutter(Renderer(scene, still, Effects(), depth_sensor, **given), *shutter, settings.shutter_samples)
        self.props = PropPlacer(scene, instances)
        bodies = self.props.bodies
        sizes = {"view": views, "row": scene.height, "column": scene.width} | body_sizes(bodies, scene.width, scene.height)
        self.dresser = Dresser(scene, seed, bodies, views) if scene.looks is not None or scene.has_details else None
        self.scene = scene = self.dresser.scene if self.dresser else scene
        self.instances = instances
        self.views = views
        self.cameras = allocate_view_cameras(views, scene.device, scene.cameras)
        self.bodies = allocate_struct(VIEW_BODIES, sizes, scene.device)
        self.gbuffer = allocate_struct(GBUFFER, sizes, scene.device)
        self.shading: DenoisedRenderer | ReferenceRenderer | None = None
        kept = 0
        if colors:
            self.image = allocate_image(sizes, scene.device)
            if has_effects(effects) or scene.is_transparent or self.shutter:
                settings = replace(settings, reuse=False)
            kept_row = None
            if settings.mode == schema.REFERENCE:
                self.shading = ReferenceRenderer(settings, seed, scene)
            else:
                self.shading = DenoisedRenderer(settings, seed, scene, bodies, views, histories)
                kept, kept_row = self.shading.kept_rows, self.shading.flags.kept_row
            self.postprocessor = PostProcessor(effects, settings.tone, seed, scene, views, kept_row, kept)
        self.rasterizer = Rasterizer(scene, 1000.0 / depth_scale, views, instances, kept=kept)
        sensor = sensor_parameters(depth_sensor, seed, depth_scale)
        self.layer_renderer = LayerRenderer(settings.layers, sensor, scene, bodies, views, depth_sensor.multipath)
        self.behind: SceneBehind | None = None
        seen = self.layer_renderer.sees_through
        if seen or (scene.is_transparent and self.shading is not None):
            self.behind = SceneBehind(scene, self.shading, self.rasterizer, (settings, seed), bodies, views, histories, seen)
        self.annotator = Annotator(scene, instances, views, kept)
        self.damage = self.rasterizer.whole

    def render(
        self, snapshot: Snapshot, views: Any, out: ViewBuffers, layers: LayerBuffers | None = None, placed: tuple[Any, Any] | None = None
    ) -> None:
        """Render and annotate a batch of views: the one place that knows the order of the passes. `snapshot`: state of the worlds. `views`:
        the struct `Views`; the renderer brings their cameras. `out`: written. `layers`: written; None: no layers. `placed`: cameras of the
        views in this frame and in the one before, by `place_cameras`; None: the scene has them. Raises ValueError: the batch has more views
        than there is scratch for."""
        if views.count > self.views:
            raise ValueError(f"{views.count} views in a batch; this renderer has scratch for {self.views}")
        if views.count == 0:
            return
        device, state = self.scene.device, snapshot
        snapshot, views = self.render_gbuffer(snapshot, views, out, placed)
        shot, behind = self._make_shot(snapshot, views)
        last = views.cameras if placed is None else placed[1]
        if layers is not None:
            with scope("layers", device):
                self.layer_renderer.render(snapshot, shot, layers, last, behind)
        if self.shading is not None:
            with scope("shade", device):
                self._shade(snapshot, shot)
            if self.shutter is not None:
                with scope("expose", device):
                    self.shutter.expose(state, views, last, self.image)
            with scope("post-process", device):
                self.postprocessor.process(shot, self.image, out)
        shot.views = views
        with scope("annotate", device):
            self.annotator.annotate(shot, self.damage, out)

    def render_radiance(self, snapshot: Snapshot, views: Any, seed: int) -> Any:
        """The struct `ShadedImage` of a batch of views whose cameras are set, with paths by another seed; arguments as of `render`."""
        for part in (self.shading, self.behind and self.behind.shading):
            if part is not None:
                part.rules.seed = seed
        snapshot, views = self.render_gbuffer(snapshot, views, None, (views.cameras, views.cameras))
        self._shade(snapshot, self._make_shot(snapshot, views)[0])
        return self.image

    def _make_shot(self, snapshot: Snapshot, views: Any) -> tuple[Any, Any]:
        """The struct `ShotData` of views whose G-buffer is rendered, and that of the scene behind them, as of `SceneBehind.rasterize`."""
        shot = make_shot(self.scene, snapshot.frames, self.bodies, self.gbuffer, self.props.widen(views))
        return shot, self.behind.rasterize(snapshot, shot) if self.behind else None

    def _shade(self, snapshot: Snapshot, shot: Any) -> None:
        """Shade `image`; arguments as of `DenoisedRenderer.shade`."""
        if self.behind is None:
            self.shading.shade(snapshot, shot, self.image)
        else:
            self.shading.shade(snapshot, self.behind.render(snapshot, shot), self.image, self.behind.add)

    def render_gbuffer(self, snapshot: Snapshot, views: Any, out: ViewBuffers | None, placed: tuple[Any, Any] | None = None) -> Any:
        """First part of `render`: G-buffer and, with `out`, depth, instances, amodal masks. Returns the snapshot with props, and the views
        with cameras."""
        scene, views = self.scene, with_cameras(views, self.cameras if placed is None else placed[0])
        snapshot, wide = self.props.place(snapshot, snapshot.fixture_visible), self.props.widen(views)
        with scope("set up views", scene.device):
            set_up_views(scene, snapshot, snapshot.fixture_visible, wide, self.bodies, placed is not None)
            if self.dresser:
                self.dresser.dress(snapshot, wide, self.bodies)
            if self.behind:
                self.behind.group(wide, self.bodies)
        self.damage = self.rasterizer.whole
        if isinstance(self.shading, DenoisedRenderer):
            self.damage = self.shading.find_damage(snapshot, self.bodies, wide) or self.damage
        with scope("rasterize", scene.device):
            self.rasterizer.rasterize(self.bodies, wide, self.gbuffer, out, self.damage)
            if out is not None:
                self.props.hide(out.instance, views.count)
        return snapshot, views
