"""Perception images: G-buffers of one camera without the gripper, for batches of worlds, entirely on the device."""

from dataclasses import dataclass, replace
from typing import Any

import warp as wp

from synpick_warp.configs import schema
from synpick_warp.configs.cell.cameras import Rig, resized
from synpick_warp.errors import ConfigError
from synpick_warp.kernels.perception.components import Patches
from synpick_warp.kernels.perception.exact_hits import intersect_hits_kernel
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.kernels.render.visibility.view_setup import aim_views_kernel
from synpick_warp.kernels.state import Observations, Plans
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.stages.arrays import allocate, allocate_struct, array_group, device_array, dry_run
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.render.cameras import VIEW_CAMERAS
from synpick_warp.stages.render.raster import Rasterizer, allocate_visibility
from synpick_warp.stages.render.scene import RenderScene, build_grid, with_cameras
from synpick_warp.stages.render.view_setup import GBUFFER, VIEW_BODIES, VIEWS, PropPlacer, body_sizes, set_up_views

_LENGTHS = dict.fromkeys(("area", "distance", "contour"), "px")
_LISTS = {"largest": ("view", "instance"), "contour": ("view", "instance", "point"), "contour_length": ("view", "instance")}


class PerceptionArrays(array_group(Patches, "view", "row", "column", units=_LENGTHS, **_LISTS)):
    """Segmentation of a batch of views, each an image of one world."""


@dataclass(frozen=True, eq=False)
class SegmentationScratch:
    """Scratch of segmentation: its other members."""

    patch: wp.array = device_array("view", "row", "column", dtype=wp.uint16)
    gap: wp.array = device_array("view", "row", "column", dtype=wp.int32)
    largest_key: wp.array = device_array("view", "instance", dtype=wp.int64)
    pole_key: wp.array = device_array("view", "instance", dtype=wp.int64)
    square: wp.array = device_array("view", "instance", dtype=wp.int64, unit="2⁻²⁴ m²")


_PIXELS = dict.fromkeys(("visible", "pole", "centroid", "midpoint", "distances", "grasp_pixel"), "px")
_SETS = dict.fromkeys(("above", "ancestors"), ("world", "instance", "word"))
_SHAPES = _SETS | {"votes": ("world", "instance", "instance"), "overflow": ("world",)}


class Observation(array_group(Observations, "world", "instance", units=_PIXELS | {"depth": "m"}, **_SHAPES)):
    """Perception result of each instance, when its world was last observed. `factory.attempts.InstanceObservation` maps it to JSON."""


class Plan(array_group(Plans, "world", units={"point": "m", "yaw": "rad", "tilt": "rad"})):
    """Plan of each world, from when it was last observed."""


CPU_BYTES = 512 * 2**20
GPU_BYTES = 2 * 2**30
"""Scratch that the views of a batch may take if `perception.views` is 0."""
CPU_VIEWS = 4
"""Maximum number of views on the CPU in that case: larger batches gain nothing there, and unused views still cost a little."""


Batch = tuple[Any, Any, Any, PerceptionArrays, SegmentationScratch]
"""Arrays of a batch of worlds: the structs `Views`, `ViewBodies` and `GBuffer`, and the arrays of their segmentation."""


def allocate_batch(settings: schema.Perception, instances: int, views: int, device: wp.Device, props: int = 0) -> Batch:
    """Allocate the arrays of a batch of `views` worlds with `instances` instances, and `props`, each."""
    width, height = settings.resolution
    sizes = {"view": views, "row": height, "column": width, "instance": instances, "point": settings.contour_points}
    sizes |= body_sizes(instances + props, width, height)
    views_of_worlds, bodies, gbuffer = (allocate_struct(kind, sizes, device) for kind in (VIEWS, VIEW_BODIES, GBUFFER))
    views_of_worlds.cameras = allocate_struct(VIEW_CAMERAS, sizes, device)
    arrays, scratch = allocate(PerceptionArrays, sizes, device), allocate(SegmentationScratch, sizes, device)
    return views_of_worlds, bodies, gbuffer, arrays, scratch


def view_bytes(settings: schema.Perception, instances: int) -> int:
    """Scratch of one view [bytes]."""
    device = wp.get_device("cpu")
    with dry_run() as arrays:
        allocate_batch(settings, instances, 1, device)
        allocate_visibility(1, *settings.resolution, instances, device)
    return sum(array.row[3] for array in arrays)


def count_views(settings: schema.Perception, worlds: int, instances: int, device: wp.Device) -> int:
    """Views of a batch: the setting, or as many as fit into the memory budget; never more than there are worlds."""
    views = settings.views
    if views == 0:
        each = view_bytes(settings, instances)
        views = GPU_BYTES // each if device.is_cuda else min(CPU_BYTES // each, CPU_VIEWS)
    return min(max(views, 1), worlds)


class PerceptionImages:
    """Renders the G-buffers of a batch of worlds. Owns its scratch; `render` only launches kernels, so a CUDA graph can capture it.

    `scene` is the renderer's with the camera of perception alone, at the resolution of perception; `views`, `bodies` and `gbuffer` are the
    structs `Views`, `ViewBodies` and `GBuffer` of the batch. The caller fills `views.world` (view): each world once; -1: the view is
    unused. `drawn` are the same views with props as instances, as `bodies` has them. `arrays` and `scratch` are those of `Segmenter`."""

    def __init__(self, settings: schema.Perception, rig: Rig, render_scene: RenderScene, worlds: int, instances: int) -> None:
        """Allocate scratch and render the static background, by meshes, materials and table of the renderer's scene, whose cameras are not
        used, at the resolution of `settings`. Raises ConfigError if a batch has more pixels than 31 bits can count."""
        device = render_scene.device
        count = count_views(settings, worlds, instances, device)
        width, height = settings.resolution
        self.pixels = count * build_grid(width, height).tiles * int(TILE_PIXELS)
        if self.pixels >= 2**31:
            raise ConfigError(f"perception.views is {count}; of {width} x {height} px that is more than 2³¹ pixels; take fewer")
        seen = resized(rig.rows[rig.index(settings.camera)], settings.resolution)
        camera = make_cameras(Rig((seen,), rig.is_listed))
        # Its kernels read the normals of meshes alone, not materials that are drawn.
        self.scene = replace(with_cameras(render_scene, camera), surfaces=render_scene.plain.surfaces)
        self.views, self.bodies, self.gbuffer, self.arrays, self.scratch = allocate_batch(
            settings, instances, count, device, render_scene.prop_count
        )
        self.views.world.fill_(-1)
        self.views.count, self.views.instances = count, instances
        self.props = PropPlacer(self.scene, instances)
        self.drawn = self.props.widen(self.views)
        self.fixture_visible = wp.array([[1, 0, 0]] * worlds, dtype=wp.int32, device=device)
        self.rasterizer = Rasterizer(self.scene, 1.0, count, instances)

    def render(self, snapshot: Snapshot) -> None:
        """Rasterize each view's world without gripper shaft and cup. Unused views keep their content."""
        scene, views = self.scene, self.drawn
        wp.launch(aim_views_kernel, dim=views.count, outputs=[views], device=scene.device)
        set_up_views(scene, self.props.place(snapshot, self.fixture_visible), self.fixture_visible, views, self.bodies)
        self.rasterizer.rasterize(self.bodies, views, self.gbuffer)
        inputs = [scene.meshes, scene.grid, self.bodies, views]
        launch_pixels(intersect_hits_kernel, self.pixels, inputs, [self.gbuffer], scene.device)
        self.props.hide(self.gbuffer.segment, views.count)
