"""Transparent bodies: the scene behind them, rendered without them, and its light on the pictures that show them."""

from types import SimpleNamespace
from typing import Any

import warp as wp

from synpick_warp.configs.schema import Render
from synpick_warp.kernels.render.images.transparency import add_scene_behind_kernel, trace_scene_behind_kernel
from synpick_warp.kernels.render.lighting.transparency import BodyGroups, group_bodies_kernel
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.kernels.render.visibility.gbuffer import ALL_PASSES, ShadedImage, ViewBodies
from synpick_warp.stages.arrays import allocate_struct, bundle, struct_arrays
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.render.denoised import DenoisedRenderer, ReferenceRenderer
from synpick_warp.stages.render.raster import Rasterizer
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.render.view_setup import GBUFFER, bin_bodies, body_sizes, make_shot

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
