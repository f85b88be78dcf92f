"""Benchmark of our renderer against MuJoCo Warp's ray renderer: the same worlds and cameras, large and small images."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np
import warp as wp

from synpick_warp.configs.cell.rig import Rig
from synpick_warp.configs.schema import UNOCCLUDED
from synpick_warp.factory.assembly import Factory, make_renderer
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.fixtures import make_fixtures
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.render.scene import build_cameras, build_grid
from tools.bench.compare.ray_scene import RayScene
from tools.bench.compare.sensor import CHECKED_VIEWS, OurViews, compare_hits, rate_rows
from tools.bench.physics import BURST, seconds_per_call
from tools.options import Row

SMALL_SIZE = (64, 64)
"""Image size of policies that learn in many worlds [px]."""
SMALL_WORLDS, SMALL_WORLDS_CPU = 2048, 8
"""Worlds with such images, on a GPU and on the CPU."""


def measure_rendering(factory: Factory, min_seconds: float) -> Iterator[Row]:
    """Benchmark of both renderers, with images of `cameras.resolution` in as many worlds as make a batch, and with small ones in many.

    Worlds beyond the factory's show its piles again.
    """
    cameras, device = factory.cameras, factory.simulation.device
    yield from _measure_size(factory, cameras, max(1, factory.stream.rings[0].batch // len(cameras)), min_seconds)
    small = make_cameras(Rig.of(replace(factory.config.cameras, resolution=SMALL_SIZE)))
    yield from _measure_size(factory, small, SMALL_WORLDS if device.is_cuda else SMALL_WORLDS_CPU, min_seconds)


def _measure_size(factory: Factory, cameras: tuple[Camera, ...], worlds: int, min_seconds: float) -> Iterator[Row]:
    """Benchmark of both renderers with images of these cameras in `worlds` worlds."""
    device, scene, config = factory.simulation.device, factory.stream.rings[0].renderer.scene, factory.config
    snapshot = tile_snapshot(factory.simulation.record.snapshot, worlds, device)
    count, pixels = worlds * len(cameras), cameras[0].width * cameras[0].height
    size = f"{cameras[0].width}x{cameras[0].height}, {worlds:,} world{'' if worlds == 1 else 's'}"
    yield Row(f"{size}: views in a batch", count, "")
    ours = make_views_of(factory, config.render.mode, cameras, snapshot, worlds)
    meshes = [(entry.mesh, entry.material) for entry in factory.catalog.entries]
    table = (float(scene.table.height), config.render.table_color) if config.render.table else None
    theirs = RayScene(meshes, make_fixtures(make_bins(config.cell.bins), config.gripper), cameras, table, snapshot, worlds, device)

    def time_view(function: functools.partial[None]) -> float:
        """Time of one view [s]."""
        return seconds_per_call(function, device, min_seconds / 4, BURST) / count

    context = theirs.make_context(color=False)
    seconds = time_view(functools.partial(ours.render_gbuffer)), time_view(functools.partial(theirs.render, context))
    checked = min(worlds, -(-CHECKED_VIEWS // len(cameras)))
    index, depth = theirs.read_hits(context, checked)
    segment, counts = (array[: len(index)].numpy() for array in (ours.out.instance, ours.out.depth))
    for row in compare_hits(theirs.segment, index, depth, segment, counts, config.bop.depth_scale):
        yield replace(row, name=f"{size}: {row.name}")
    yield from _pair(size, pixels, "depth, ids, amodal bits", "depth, ids", seconds)
    context = theirs.make_context(color=True)
    seconds = time_view(functools.partial(ours.render)), time_view(functools.partial(theirs.render, context))
    everything = "color by light maps with indirect light and anti-aliasing, depth, ids, amodal bits, counts, boxes"
    theirs_colored = "color by one light with shadows, depth, ids"
    yield from _pair(size, pixels, everything, theirs_colored, seconds)
    unoccluded = make_views_of(factory, UNOCCLUDED, cameras, snapshot, worlds)
    seconds = time_view(functools.partial(unoccluded.render)), seconds[1]
    plain = "render.mode unoccluded, color by light maps with shadows of one lamp and anti-aliasing, depth, ids, amodal bits, counts, boxes"
    yield from _pair(size, pixels, plain, theirs_colored, seconds)


def _pair(size: str, pixels: int, ours: str, theirs: str, seconds: tuple[float, float]) -> Iterator[Row]:
    """Rows of the rates of both renderers, from the times of a view [s] by ours and theirs, and of their ratio."""
    our_seconds, their_seconds = seconds
    yield from rate_rows(f"{size}, ours: {ours}", our_seconds, pixels)
    yield from rate_rows(f"{size}, MuJoCo Warp: {theirs}", their_seconds, pixels)
    yield Row(f"{size}: rate of ours ({ours}) over MuJoCo Warp's ({theirs})", their_seconds / our_seconds, "")


def tile_snapshot(snapshot: Snapshot, worlds: int, device: wp.Device) -> Snapshot:
    """A snapshot of `worlds` worlds: world i shows world i modulo those of `snapshot`."""
    chosen = np.arange(worlds) % len(snapshot.live)
    arrays = {field.name: getattr(snapshot, field.name) for field in fields(snapshot)}
    return Snapshot(**{name: wp.array(array.numpy()[chosen], dtype=array.dtype, device=device) for name, array in arrays.items()})


def make_views_of(factory: Factory, mode: str, cameras: tuple[Camera, ...], snapshot: Snapshot, worlds: int) -> OurViews:
    """Our renderer in a mode and at the image size of `cameras`, for all cameras of the first worlds of a snapshot."""
    count, scene = worlds * len(cameras), factory.groups[0].renderer.scene
    scene = replace(scene, cameras=build_cameras(cameras, scene.device), grid=build_grid(cameras[0].width, cameras[0].height))
    config = factory.config.with_values({"render.mode": mode})
    return OurViews(make_renderer(config, scene, factory.groups[0].renderer.instances, count, histories=count), snapshot, count)
