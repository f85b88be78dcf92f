"""Pictures and ground truth of a batch of views, from a snapshot of all worlds."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from synpick_warp.arrays import allocate, device_array
from synpick_warp.configs.schema import REFERENCE, Config
from synpick_warp.kernels.render.images.antialias import Picture
from synpick_warp.kernels.render.visibility.gbuffer import Bodies, Hits
from synpick_warp.stages.buffers import LayerBuffers, Snapshot, ViewBuffers
from synpick_warp.stages.render.annotate import annotate
from synpick_warp.stages.render.denoised import FastPicture
from synpick_warp.stages.render.layers import LayerPainter
from synpick_warp.stages.render.postprocess import Developer
from synpick_warp.stages.render.raster import Rasterizer
from synpick_warp.stages.render.reference import ReferencePicture
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.render.view_setup import BodyArrays, HitArrays, body_sizes, filled, place_bodies


@dataclass(frozen=True, eq=False)
class PictureArrays:
    """Arrays of the struct `Picture`: what lies between hits and colour."""

    radiance: wp.array = device_array("view", "row", "column", dtype=wp.vec3)
    mix: wp.array = device_array("view", "row", "column", dtype=wp.uint32)


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
        self.arrays = (
            allocate(BodyArrays, sizes, scene.device),
            allocate(HitArrays, sizes, scene.device),
            allocate(PictureArrays, sizes, scene.device),
        )
        self.bodies = filled(Bodies, self.arrays[0])
        self.hits = filled(Hits, self.arrays[1])
        self.picture = filled(Picture, self.arrays[2])
        if config.render.mode == REFERENCE:
            self.shading: FastPicture | ReferencePicture = ReferencePicture(config, scene, instances)
        else:
            self.shading = FastPicture(config, scene, instances, views)
        self.rasterizer = Rasterizer(scene, instances, 1000.0 / config.bop.depth_scale, views)
        self.layers = LayerPainter(config, scene, instances, views)
        self.developer = Developer(config, scene, views)

    def render(
        self,
        snapshot: Snapshot,
        view_world: wp.array,
        view_camera: wp.array,
        count: int,
        out: ViewBuffers,
        layers: LayerBuffers | None = None,
    ) -> None:
        """Render and annotate the first `count` views.

        Args:
            snapshot: The worlds.
            view_world: World of each view (B) int32.
            view_camera: Camera of each view (B) int32.
            count: Views in use, known on the host.
            out: Written.
            layers: Written, if given.

        Raises:
            ValueError: More views than there is scratch for.
        """
        if count > self.views:
            raise ValueError(f"{count} views in a batch; this renderer has scratch for {self.views}")
        if count == 0:
            return
        self.prepare_bodies(snapshot, view_world, view_camera, count)
        self.find_hits(view_camera, count, out)
        if layers is not None:
            self.layers.draw(snapshot, self.bodies, self.hits, view_world, view_camera, count, layers)
        self.shading.shade(snapshot, self.bodies, self.hits, view_world, view_camera, count, self.picture)
        self.develop(snapshot, view_world, view_camera, count, out)
        annotate(self.scene, self.bodies, view_camera, count, out)

    def prepare_bodies(self, snapshot: Snapshot, view_world: wp.array, view_camera: wp.array, count: int) -> None:
        """Place every body before every view's camera."""
        scene = self.scene
        visible = snapshot.fixture_visible
        place_bodies(scene, scene.cameras, scene.grid, snapshot, visible, view_world, view_camera, count, self.bodies)

    def find_hits(self, view_camera: wp.array, count: int, out: ViewBuffers) -> None:
        """Depth, identities and amodal bits, and the hits for shading."""
        self.rasterizer.find(self.bodies, view_camera, count, self.hits, out)

    def develop(self, snapshot: Snapshot, view_world: wp.array, view_camera: wp.array, count: int, out: ViewBuffers) -> None:
        """Radiance to bytes."""
        self.developer.develop(snapshot, view_world, view_camera, count, self.picture, out)
