"""Launching the search for what the rays through pixels' centres meet, before a backdrop that is rendered once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from synpick_warp.arrays import allocate, device_array
from synpick_warp.errors import CatalogError
from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS
from synpick_warp.kernels.render.visibility.gbuffer import Bodies, Hits
from synpick_warp.kernels.render.visibility.raster import (
    MOST_TRIANGLES,
    Marks,
    clear_marks_kernel,
    mark_blocks_kernel,
    mark_triangles_kernel,
    read_marks_kernel,
)
from synpick_warp.stages.buffers import FIXTURES, Snapshot, ViewBuffers
from synpick_warp.stages.launch import launch_pixels, launch_views
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.render.view_setup import BodyArrays, HitArrays, body_sizes, filled, place_bodies

BLOCKS = 32768
"""Blocks of large triangles that a view has room for: thirteen objects of some hundred to some thousand triangles, as the embedded ones,
have 14,000 at full HD in front of a camera, dense meshes a tenth of that. Without room a single thread does them, which is slow."""
TRIANGLE_THREADS = 4096
"""Threads that share the triangles of a body on a GPU: a dense mesh keeps them busy, and those of a box cost little."""
BLOCK_THREADS = 16384
"""Threads that share the blocks of a view on a GPU."""


@dataclass(frozen=True, eq=False)
class MarkArrays:
    """Arrays of the struct `Marks`."""

    nearest: wp.array = device_array("view", "row", "column", dtype=wp.uint64)
    block: wp.array = device_array("view", "block", dtype=wp.vec4i)
    blocks: wp.array = device_array("view", dtype=wp.int32)


class Rasterizer:
    """Finds primary hits. Owns its scratch and the backdrop; `find` only launches.

    Attributes:
        backdrop: The struct `Hits`, a row a camera: what the tote, standing where it always does, and the table show.
    """

    def __init__(self, scene: RenderScene, instances: int, counts_per_meter: float, views: int, backdrop: Any = None) -> None:
        """
        Args:
            scene: Constant data.
            instances: Room for instances of a world.
            counts_per_meter: Counts of the depth image.
            views: Most views of a batch.
            backdrop: As the attribute; None: it is rendered.

        Raises:
            CatalogError: A mesh has more triangles than a mark can name.
        """
        most = max(len(mesh.indices) // 3 for mesh in scene.keep)
        if most > MOST_TRIANGLES:
            raise CatalogError(f"a mesh has {most} triangles; at most {MOST_TRIANGLES} can be rendered")
        self.scene = scene
        self.instances = instances
        self.counts_per_meter = counts_per_meter
        self.marks = filled(Marks, allocate(MarkArrays, mark_sizes(views, scene.width, scene.height), scene.device))
        self.backdrop = render_backdrop(scene) if backdrop is None else backdrop

    def find(self, bodies: Any, view_camera: wp.array, count: int, hits: Any, out: ViewBuffers) -> None:
        """What each pixel of the first `count` views shows.

        Args:
            bodies: The struct `Bodies`, prepared for these views.
            view_camera: Camera of each view (B) int32.
            count: Views in use.
            hits: The struct `Hits`; written.
            out: Its `instance`, `depth` and `amodal` are written.
        """
        scene, marks, device = self.scene, self.marks, self.scene.device
        pixels = count * scene.grid.tiles * int(TILE_PIXELS)
        launch_pixels(clear_marks_kernel, pixels, [scene.grid], [marks, out.amodal], device)
        inputs = [scene.meshes, scene.cameras, scene.grid, bodies, view_camera, self.instances]
        threads = (TRIANGLE_THREADS, BLOCK_THREADS) if device.is_cuda else (1, 1)
        each = bodies.mesh.shape[1] * threads[0]
        launch_views(mark_triangles_kernel, count, each, [*inputs, threads[0]], [marks, out.amodal], device)
        launch_views(mark_blocks_kernel, count, threads[1], [*inputs, threads[1]], [marks, out.amodal], device)
        inputs = [scene.meshes, scene.table, scene.cameras, scene.grid, self.backdrop, bodies, marks, view_camera]
        inputs += [self.instances, self.counts_per_meter]
        launch_pixels(read_marks_kernel, pixels, inputs, [hits, out.instance, out.depth], device)


def render_backdrop(scene: RenderScene) -> Any:
    """What every camera sees of a world that has the tote alone: the struct `Hits`, a row a camera."""
    device, cameras = scene.device, scene.camera_count
    sizes = {"view": cameras, "row": scene.height, "column": scene.width} | body_sizes(0, scene.width, scene.height)
    world = allocate(Snapshot, {"world": 1, "instance": 0, "fixture": len(FIXTURES)}, device)
    world.fixture_pose.fill_(wp.transform_identity())
    tote = wp.array([[1, 0, 0]], dtype=wp.int32, device=device)
    view_world = wp.zeros(cameras, dtype=wp.int32, device=device)
    view_camera = wp.array(range(cameras), dtype=wp.int32, device=device)
    bodies, hits = filled(Bodies, allocate(BodyArrays, sizes, device)), filled(Hits, allocate(HitArrays, sizes, device))
    place_bodies(scene, scene.cameras, scene.grid, world, tote, view_world, view_camera, cameras, bodies)
    # Nothing stands before it yet; its depth image is of no use, in whatever unit.
    bodies.backdrop.zero_()
    out = allocate(ViewBuffers, sizes, device, ("instance", "depth", "amodal"))
    Rasterizer(scene, 0, 1.0, cameras, backdrop=hits).find(bodies, view_camera, cameras, hits, out)
    return hits


def mark_sizes(views: int, width: int, height: int) -> dict[str, int]:
    """Extents of the dimensions that `MarkArrays` names."""
    return {"view": views, "row": height, "column": width, "block": BLOCKS}
