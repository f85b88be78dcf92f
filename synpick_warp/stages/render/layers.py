"""Layers of a batch of views: those that the settings name, drawn from the hits of the renderer."""

from __future__ import annotations

from typing import Any

import warp as wp

from synpick_warp.arrays import allocate_struct, struct_arrays
from synpick_warp.configs.schema import Config
from synpick_warp.errors import CatalogError
from synpick_warp.kernels.render.images.depth_sensor import draw_depth_sensor_kernel
from synpick_warp.kernels.render.images.layers import (
    Motions,
    draw_albedo_kernel,
    draw_classes_kernel,
    draw_flow_kernel,
    draw_nocs_kernel,
    draw_normals_kernel,
    draw_scene_flow_kernel,
    prepare_motions_kernel,
)
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.stages.buffers import FIXTURES, LayerBuffers, Snapshot
from synpick_warp.stages.launch import launch_pixels
from synpick_warp.stages.render.depth_sensor import sensor_rules
from synpick_warp.stages.render.scene import RenderScene

MOST_CLASS = 65535
"""Largest obj_id that the layer of classes can hold."""
MOVING = {"flow", "scene_flow"}
"""Layers that need motions."""


MOTIONS = struct_arrays(Motions, "view", "body", units={"origin": "m", "shift": "m"})


class LayerRenderer:
    """Draws layers. Owns its scratch; `draw` only launches, so a CUDA graph can capture it."""

    def __init__(self, config: Config, scene: RenderScene, instances: int, views: int) -> None:
        """Allocate scratch, if motion is asked for.

        Args:
            config: All settings; `render.layers` counts.
            scene: Constant data.
            instances: Room for instances of a world.
            views: Most views of a batch.

        Raises:
            CatalogError: Classes are asked for, and an obj_id does not fit into 16 bits or means none.
        """
        self.scene = scene
        self.names = config.render.layers
        if "classes" in self.names:
            wrong = [number for number in scene.obj_id.numpy().tolist() if not 0 < number <= MOST_CLASS]
            if wrong:
                raise CatalogError(
                    f"object {wrong[0]} has no place in the layer classes, which holds 1 to {MOST_CLASS}; renumber the model"
                )
        self.sensor = sensor_rules(config)
        self.motions = None
        if MOVING.intersection(self.names):
            self.motions = allocate_struct(MOTIONS, {"view": views, "body": instances + len(FIXTURES)}, scene.device)

    def draw(
        self,
        snapshot: Snapshot,
        bodies: Any,
        gbuffer: Any,
        views: Any,
        out: LayerBuffers,
    ) -> None:
        """Draw the layers of the views.

        Args:
            snapshot: The worlds.
            bodies: The struct `ViewBodies`, prepared for these views.
            gbuffer: The struct `GBuffer` of the pixels' centres.
            views: The struct `Views`.
            out: Its arrays of the layers asked for are written.
        """
        scene, names = self.scene, self.names
        surface = [scene.meshes, scene.surfaces, scene.cameras, scene.grid, bodies, gbuffer, views]
        if "normals" in names:
            self._launch(draw_normals_kernel, views.count, surface, out.normals)
        if "albedo" in names:
            self._launch(draw_albedo_kernel, views.count, surface, out.albedo)
        if "nocs" in names:
            self._launch(draw_nocs_kernel, views.count, [scene.meshes, scene.grid, bodies, gbuffer, views], out.nocs)
        if "classes" in names:
            self._launch(draw_classes_kernel, views.count, [scene.grid, scene.obj_id, bodies, gbuffer, views], out.classes)
        if "depth_sensor" in names:
            inputs = [
                scene.meshes,
                scene.surfaces,
                scene.cameras,
                scene.grid,
                snapshot.episode,
                snapshot.frame,
                self.sensor,
                bodies,
                gbuffer,
                views,
            ]
            self._launch(draw_depth_sensor_kernel, views.count, inputs, out.depth_sensor)
        if self.motions is None:
            return
        self.prepare_motions(snapshot, views)
        motion = [scene.cameras, scene.grid, snapshot.follows, self.motions, gbuffer, views]
        if "flow" in names:
            self._launch(draw_flow_kernel, views.count, motion, out.flow)
        if "scene_flow" in names:
            self._launch(draw_scene_flow_kernel, views.count, motion, out.scene_flow)

    def prepare_motions(self, snapshot: Snapshot, views: Any) -> None:
        """How every body moved since the frame before."""
        inputs = [
            self.scene.cameras,
            snapshot.catalog_index,
            snapshot.pose,
            snapshot.fixture_pose,
            snapshot.follows,
            snapshot.last_catalog_index,
        ]
        inputs += [snapshot.last_pose, snapshot.last_fixture_pose, snapshot.last_fixture_visible, views]
        dim = (views.count, self.motions.known.shape[1])
        wp.launch(prepare_motions_kernel, dim=dim, inputs=inputs, outputs=[self.motions], device=self.scene.device)

    def _launch(self, kernel: wp.Kernel, count: int, inputs: list[Any], output: wp.array) -> None:
        launch_pixels(kernel, count * self.scene.grid.tiles * int(TILE_PIXELS), inputs, [output], self.scene.device)
