"""Bodies before cameras: scratch that every ray needs, and its launcher."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import warp as wp

from synpick_warp.arrays import device_array
from synpick_warp.kernels.render.visibility.view_setup import find_candidates_kernel, order_bodies_kernel, prepare_bodies_kernel
from synpick_warp.stages.buffers import FIXTURES, Snapshot
from synpick_warp.stages.render.scene import RenderScene, build_grid


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
    order: wp.array = device_array("view", "body", dtype=wp.int32)
    present: wp.array = device_array("view", dtype=wp.int32)
    backdrop: wp.array = device_array("view", dtype=wp.int32)
    candidates: wp.array = device_array("view", "tile", dtype=wp.uint64)


@dataclass(frozen=True, eq=False)
class HitArrays:
    """Arrays of the struct `Hits`."""

    code: wp.array = device_array("view", "row", "column", dtype=wp.uint8)
    triangle: wp.array = device_array("view", "row", "column", dtype=wp.int32)
    barycentric: wp.array = device_array("view", "row", "column", dtype=wp.vec2)
    depth: wp.array = device_array("view", "row", "column", dtype=wp.float32, unit="m")


def body_sizes(instances: int, width: int, height: int) -> dict[str, int]:
    """Extents of the dimensions that `BodyArrays` names beside the view, for images of `width` x `height` px."""
    return {"body": instances + len(FIXTURES), "tile": build_grid(width, height).tiles}


def filled(struct: Any, arrays: Any) -> Any:
    """A kernel argument of type `struct` with the arrays of a dataclass that has the same fields."""
    made = struct()
    for item in fields(arrays):
        setattr(made, item.name, getattr(arrays, item.name))
    return made


def place_bodies(
    scene: RenderScene,
    cameras: Any,
    grid: Any,
    snapshot: Snapshot,
    fixture_visible: wp.array,
    view_world: wp.array,
    view_camera: wp.array,
    count: int,
    bodies: Any,
) -> None:
    """Place every body before the cameras of the first `count` views, and list those that are there.

    Args:
        scene: Constant data, but for the cameras.
        cameras: The struct `Cameras`.
        grid: The struct `ImageGrid` of their images.
        snapshot: The worlds.
        fixture_visible: Which fixtures are there (world, fixture) int32.
        view_world: World of each view (B) int32; -1: none.
        view_camera: Camera of each view (B) int32.
        count: Views in use.
        bodies: The struct `Bodies`; written.
    """
    dim = (count, bodies.mesh.shape[1])
    instances = dim[1] - len(FIXTURES)
    inputs = [scene.meshes, cameras, grid, snapshot.catalog_index, snapshot.pose, snapshot.fixture_pose, fixture_visible]
    inputs += [view_world, view_camera, instances]
    wp.launch(prepare_bodies_kernel, dim=dim, inputs=inputs, outputs=[bodies], device=scene.device)
    wp.launch(order_bodies_kernel, dim=dim, outputs=[bodies], device=scene.device)
    inputs = [scene.meshes, cameras, grid, view_camera]
    wp.launch(find_candidates_kernel, dim=(count, grid.tiles), inputs=inputs, outputs=[bodies], device=scene.device)
