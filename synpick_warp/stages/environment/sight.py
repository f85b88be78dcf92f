"""Observations of the vector environment, on the device: images of one camera in all worlds, and state vectors."""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from synpick_warp.configs import schema
from synpick_warp.configs.cell.rig import Rig
from synpick_warp.kernels.environment import attempts, observations
from synpick_warp.stages.arrays import allocate, device_array
from synpick_warp.stages.buffers import Snapshot, allocate_view_buffers
from synpick_warp.stages.launch import launch, launch_pixels
from synpick_warp.stages.perception.images import PerceptionImages
from synpick_warp.stages.render.view_setup import make_views
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.view_ring import CameraGroup


@dataclass(frozen=True, eq=False)
class SightArrays:
    """Latest images and state vectors of every world; None: not observed."""

    depth: wp.array = device_array("world", "row", "column", dtype=wp.float32, unit="m")
    """Planar depth; 0: no surface."""
    segment: wp.array = device_array("world", "row", "column", dtype=wp.uint8)
    """Segmentation id: 0 nothing, 1 + instance_id, or a `Segment`."""
    normal: wp.array = device_array("world", "row", "column", dtype=wp.vec3)
    """Unit shading normal in the world's frame, facing the camera."""
    color: wp.array = device_array("world", "row", "column", dtype=wp.vec3ub)
    """sRGB, red first."""
    mask: wp.array = device_array("world", "row", "column", dtype=wp.uint8)
    """1: the pixel shows the target."""
    point: wp.array = device_array("world", dtype=wp.vec3, unit="m")
    """Grasp point that perception finds on the target; 0 without one."""
    state: wp.array = device_array("world", "value", dtype=wp.float32)
    """State vector of gripper and instances; see `write_states_kernel`."""


IMAGES = {"depth", "segment", "normal", "mask"}
"""Arrays that follow from the G-buffer, without shading."""


class Sight:
    """Sensor suite of all worlds: renders images and writes state vectors, without copies to the host."""

    def __init__(
        self,
        settings: schema.Perception,
        rig: Rig,
        simulation: Simulation,
        group: CameraGroup,
        resolution: tuple[int, int],
        wanted: Collection[str],
        shows_gripper: bool,
    ) -> None:
        """Allocate images and vectors: `wanted` fields of `SightArrays`, of `perception.camera` or the first, whose group has the renderer,
        at a resolution (width, height) [px]. `shows_gripper`: whether images other than `color` show the gripper."""
        self.simulation, self.group, self.renderer, self.device = simulation, group, group.renderer, simulation.device
        self.camera = rig.index(settings.camera)
        width, height = resolution
        self._window = round(settings.normal_window * width / settings.resolution[0])
        worlds, instances = simulation.layout.worlds, simulation.layout.instances
        values = int(observations.GRIPPER_VALUES) + instances * int(observations.INSTANCE_VALUES)
        sizes = {"world": worlds, "row": height, "column": width, "value": values}
        only = {*wanted, *(IMAGES - {"mask"} if IMAGES & set(wanted) else ())}
        self.arrays = allocate(SightArrays, sizes, self.device, only)
        self.images: PerceptionImages | None = None
        if IMAGES & only:
            seen = replace(settings, resolution=(width, height), views=0, contour_points=1)  # Contours are not traced.
            self.images = PerceptionImages(seen, rig, self.renderer.scene, worlds, instances)
            shown = int(shows_gripper)
            visible = [[simulation.scene.bins.visible, shown, shown]] * worlds
            self.images.fixture_visible.assign(np.array(visible, np.int32))
        self._buffers = allocate_view_buffers(self.renderer.views, width, height, instances, self.device) if "color" in only else None

    def observe(self, snapshot: Snapshot) -> SightArrays:
        """Observe all worlds; returns the arrays, which the next call overwrites."""
        simulation, arrays = self.simulation, self.arrays
        worlds = np.arange(simulation.layout.worlds)
        if self.images is not None:
            for first in range(0, len(worlds), self.images.views.count):
                self._copy_images(snapshot, worlds[first : first + self.images.views.count])
        if arrays.color is not None:
            for first in range(0, len(worlds), self.renderer.views):
                self._render(snapshot, worlds[first : first + self.renderer.views])
        if arrays.mask is not None:
            sources = {"segment": arrays.segment, "target": simulation.plan.target, "mask_out": arrays.mask}
            launch(observations.write_target_masks_kernel, arrays.mask.shape, **sources)
        if arrays.point is not None:
            plan = simulation.plan
            launch(observations.write_target_points_kernel, len(worlds), target=plan.target, planned=plan.point, point_out=arrays.point)
        if arrays.state is not None:
            sources = (simulation.scene, simulation.state, simulation.seals, simulation.plan, simulation.physics.state)
            given = {"object_id": self.renderer.scene.obj_id, "values_out": arrays.state}
            launch(observations.write_states_kernel, len(worlds), *sources, **given)
        return arrays

    def grasp_pixels(self, pixel: wp.array, point: wp.array, direction: wp.array, instance: wp.array, running: wp.array) -> None:
        """Back-project pixels (world) of the last images to surface points, with direction and instance; see `grasp_pixels_kernel`. Raises
        ValueError if there are no images."""
        if self.images is None:
            raise ValueError("pixels are no actions without images")
        given = {"window": self._window, "views": self.images.views, "pixel": pixel, "running": running}
        given |= {"point": point, "direction": direction, "instance": instance}
        launch(attempts.grasp_pixels_kernel, len(pixel), self.arrays, **given)

    def _copy_images(self, snapshot: Snapshot, worlds: np.ndarray) -> None:
        """Render the G-buffer of a batch of worlds, and copy depth, segmentation and normals to their images."""
        images, arrays = self.images, self.arrays
        padded = np.full(images.views.count, -1, np.int32)
        padded[: len(worlds)] = worlds
        images.views.world.assign(padded)
        images.render(snapshot)
        inputs = [images.scene.meshes, images.scene.surfaces, images.scene.grid, images.bodies, images.gbuffer, images.views]
        launch_pixels(observations.copy_images_kernel, images.pixels, inputs, [arrays.depth, arrays.segment, arrays.normal], self.device)

    def _render(self, snapshot: Snapshot, worlds: np.ndarray) -> None:
        """Shade the colour images of a batch of worlds."""
        renderer = self.renderer
        camera = np.full(len(worlds), self.camera, np.int32)
        rows = [wp.array(values, dtype=wp.int32, device=self.device) for values in (worlds, camera, self.group.slots(camera))]
        views = make_views(rows[0], rows[1], len(worlds), renderer.instances, slot=rows[2])
        renderer.render(snapshot, views, self._buffers)
        first, count = int(worlds[0]), len(worlds)
        wp.copy(self.arrays.color[first : first + count], self._buffers.color[:count])
