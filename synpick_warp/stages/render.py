"""Pictures and ground truth of a batch of views, from a snapshot of all worlds."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import warp as wp

from synpick_warp.arrays import allocate, device_array
from synpick_warp.configs.schema import REFERENCE, Config
from synpick_warp.kernels.camera_rays import TILE_PIXELS
from synpick_warp.kernels.hits import Bodies, Hits, prepare_bodies_kernel, trace_hits_kernel, trace_sample_kernel
from synpick_warp.kernels.occlusion import OcclusionRays, Sample, filter_occlusion_kernel, occlude_kernel
from synpick_warp.kernels.shading import shade_kernel
from synpick_warp.stages.annotate import annotate
from synpick_warp.stages.buffers import FIXTURES, LayerBuffers, Snapshot, ViewBuffers
from synpick_warp.stages.develop import Developer
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.layers import LayerPainter
from synpick_warp.stages.reference import ReferencePicture
from synpick_warp.stages.render_scene import RenderScene

AMBIENT_REACH = 0.3
"""How far away things hide the sky [m]: the walls of a tote do, other furniture does not."""
PLASTIC = (0.7548776662466927, 0.5698402909980532)
"""Powers of the inverse plastic number: multiples of them fill a square evenly (Roberts, 2018)."""


@dataclass(frozen=True, eq=False)
class BodyArrays:
    """Arrays of the struct `Bodies`."""

    mesh: wp.array = device_array("view", "body", dtype=wp.int32)
    turn: wp.array = device_array("view", "body", dtype=wp.mat33)
    start: wp.array = device_array("view", "body", dtype=wp.vec3, unit="m")
    near: wp.array = device_array("view", "body", dtype=wp.float32, unit="m")
    box: wp.array = device_array("view", "body", dtype=wp.vec4i, unit="px")
    world_turn: wp.array = device_array("view", "body", dtype=wp.mat33)
    position: wp.array = device_array("view", "body", dtype=wp.vec3, unit="m")
    sphere: wp.array = device_array("view", "body", dtype=wp.vec4, unit="m, m²")


@dataclass(frozen=True, eq=False)
class HitArrays:
    """Arrays of the struct `Hits`."""

    code: wp.array = device_array("view", "row", "column", dtype=wp.uint8)
    triangle: wp.array = device_array("view", "row", "column", dtype=wp.int32)
    barycentric: wp.array = device_array("view", "row", "column", dtype=wp.vec2)
    depth: wp.array = device_array("view", "row", "column", dtype=wp.float32, unit="m")


@dataclass(frozen=True, eq=False)
class PictureArrays:
    """What lies between hits and colour."""

    occlusion: wp.array = device_array("view", "row", "column", dtype=wp.vec2)
    """Visible shares of the main light and of the sky, as the rays found them."""
    smoothed: wp.array = device_array("view", "row", "column", dtype=wp.vec2)
    """The same, after the first pass of the filter."""
    radiance: wp.array = device_array("view", "row", "column", dtype=wp.vec3)
    """Linear, before exposure."""


def filled(struct: Any, arrays: Any) -> Any:
    """A kernel argument of type `struct` with the arrays of a dataclass that has the same fields."""
    made = struct()
    for item in fields(arrays):
        setattr(made, item.name, getattr(arrays, item.name))
    return made


def color_samples(count: int) -> list[Any]:
    """The structs `Sample` of a pixel's colour samples; the first of one sample is the pixel's centre, so that its hit is shared."""
    samples = []
    for number in range(count):
        sample = Sample()
        shift = [(number * step) % 1.0 for step in PLASTIC]
        sample.offset = wp.vec2(*((((number + 0.5) * step) % 1.0) - 0.5 if count > 1 else 0.0 for step in PLASTIC))
        sample.shift = wp.vec2(*shift)
        sample.weight = 1.0 / count
        sample.footprint = count**-0.5
        sample.number = number
        samples.append(sample)
    return samples


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
        sizes = {"view": views, "body": instances + len(FIXTURES), "row": scene.height, "column": scene.width}
        self.scene = scene
        self.instances = instances
        self.views = views
        self.counts_per_meter = 1000.0 / config.bop.depth_scale
        self.arrays = (
            allocate(BodyArrays, sizes, scene.device),
            allocate(HitArrays, sizes, scene.device),
            allocate(PictureArrays, sizes, scene.device),
        )
        self.bodies = filled(Bodies, self.arrays[0])
        self.hits = filled(Hits, self.arrays[1])
        self.picture = self.arrays[2]
        self.rays = OcclusionRays()
        self.rays.shadow = config.render.shadow_rays
        self.rays.ambient = config.render.ambient_rays
        self.rays.ambient_reach = AMBIENT_REACH
        self.samples = color_samples(config.render.color_samples)
        self.reference = ReferencePicture(config, scene, instances) if config.render.mode == REFERENCE else None
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
        self.trace_hits(view_camera, count, out)
        if layers is not None:
            # Here, because further colour samples replace the hits.
            self.layers.draw(snapshot, self.bodies, self.hits, view_world, view_camera, count, layers)
        if self.reference is None:
            self.shade_samples(snapshot, view_world, view_camera, count)
        else:
            self.reference.trace_paths(snapshot, self.bodies, view_world, view_camera, count, self.picture.radiance)
        self.develop(snapshot, view_world, view_camera, count, out)
        annotate(self.scene, self.bodies, view_camera, count, out)

    def shade_samples(self, snapshot: Snapshot, view_world: wp.array, view_camera: wp.array, count: int) -> None:
        """Radiance of the fast picture: all colour samples."""
        for sample in self.samples:
            if len(self.samples) > 1:
                self.trace_sample(view_camera, count, sample)
            self.occlude(snapshot, view_world, view_camera, count, sample)
            self.filter_occlusion(view_camera, count, sample)
            self.shade(snapshot, view_world, view_camera, count, sample)

    def prepare_bodies(self, snapshot: Snapshot, view_world: wp.array, view_camera: wp.array, count: int) -> None:
        """Place every body before every view's camera."""
        scene = self.scene
        inputs = [scene.meshes, scene.cameras, scene.grid, snapshot.entry, snapshot.pose, snapshot.fixture_pose]
        inputs += [snapshot.fixture_visible, view_world, view_camera, self.instances]
        dim = (count, self.instances + len(FIXTURES))
        wp.launch(prepare_bodies_kernel, dim=dim, inputs=inputs, outputs=[self.bodies], device=scene.device)

    def trace_hits(self, view_camera: wp.array, count: int, out: ViewBuffers) -> None:
        """Depth, identities and amodal bits, and the hits for shading."""
        scene = self.scene
        inputs = [scene.meshes, scene.table, scene.cameras, scene.grid, self.bodies, view_camera, self.instances, self.counts_per_meter]
        self._launch(trace_hits_kernel, count, inputs, [self.hits, out.instance, out.depth, out.amodal])

    def trace_sample(self, view_camera: wp.array, count: int, sample: Any) -> None:
        """Hits of one colour sample."""
        scene = self.scene
        inputs = [scene.meshes, scene.table, scene.cameras, scene.grid, self.bodies, view_camera, self.instances, sample.offset]
        self._launch(trace_sample_kernel, count, inputs, [self.hits])

    def occlude(self, snapshot: Snapshot, view_world: wp.array, view_camera: wp.array, count: int, sample: Any) -> None:
        """Hidden shares of main light and sky."""
        scene = self.scene
        inputs = [scene.meshes, scene.table, scene.cameras, scene.grid, scene.lights, snapshot.light, snapshot.light_turn]
        inputs += [self.bodies, self.hits, view_world, view_camera, self.instances, self.rays, sample]
        self._launch(occlude_kernel, count, inputs, [self.picture.occlusion])

    def filter_occlusion(self, view_camera: wp.array, count: int, sample: Any) -> None:
        """First pass of the filter over hidden shares."""
        scene = self.scene
        inputs = [scene.meshes, scene.cameras, scene.grid, self.bodies, self.hits, self.picture.occlusion]
        inputs += [view_camera, self.instances, sample]
        self._launch(filter_occlusion_kernel, count, inputs, [self.picture.smoothed])

    def shade(self, snapshot: Snapshot, view_world: wp.array, view_camera: wp.array, count: int, sample: Any) -> None:
        """Radiance of one colour sample, added to the picture."""
        scene = self.scene
        inputs = [scene.meshes, scene.surfaces, scene.cameras, scene.grid, scene.lights, snapshot.light, snapshot.light_turn]
        inputs += [self.bodies, self.hits, self.picture.smoothed, view_world, view_camera, self.instances, sample]
        self._launch(shade_kernel, count, inputs, [self.picture.radiance])

    def develop(self, snapshot: Snapshot, view_world: wp.array, view_camera: wp.array, count: int, out: ViewBuffers) -> None:
        """Radiance to bytes."""
        self.developer.develop(snapshot, view_world, view_camera, count, self.picture.radiance, out)

    def _launch(self, kernel: wp.Kernel, count: int, inputs: list[Any], outputs: list[Any]) -> None:
        pixels = count * self.scene.grid.tiles * int(TILE_PIXELS)
        launch_pixels(kernel, pixels, inputs, outputs, self.scene.device)
