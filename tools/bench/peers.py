"""Peers of the benchmark (`--compare`): other simulators and renderers on the same piles at rest, beside ours."""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, replace
from functools import partial

import numpy as np
import warp as wp

from synpick_warp.configs.cell.rig import Rig
from synpick_warp.configs.schema import UNOCCLUDED
from synpick_warp.errors import SynpickError
from synpick_warp.factory.assembly import Factory, build_factory, make_renderer
from synpick_warp.scenes.bins import make_bins, make_fixtures
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.buffers import Snapshot, allocate_view_buffers
from synpick_warp.stages.render.cameras import build_cameras
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.scene import build_grid
from synpick_warp.stages.render.view_setup import first_views
from synpick_warp.system.progress import SilentProgress
from tools.bench import worlds
from tools.bench.engines import CONES, Engine, MujocoEngine, make_mujoco_warp, make_ours, measure_engine, pick_pile
from tools.bench.ray_scene import RayScene
from tools.bench.run import FOREVER, Bench
from tools.bench.sensor import SensorScene, build_sensor_scene, compare_hits
from tools.options import MeasuredRow, of_part

PEERS: Mapping[str, tuple[str, ...]] = {"mujoco-warp": ("mujoco", "mujoco_warp"), "mujoco": ("mujoco",), "sensor-camera": ()}
"""Peers, and the modules that they import besides those of the product."""
RENDERERS: Mapping[str, tuple[str, Callable[..., RayScene | SensorScene]]] = {
    "sensor-camera": ("SensorCamera", build_sensor_scene),
    "mujoco-warp": ("MuJoCo Warp", RayScene),
}
"""Renderers of peers: their names in rows, and their scenes, which are built from the same arguments."""
PILE_WORLDS = 64
"""Worlds that are settled for the comparison, at most; rendering repeats them, physics takes one of them."""
SMALL_SIZE = (64, 64)
"""Image size of policies that learn in many worlds [px]."""
SMALL_WORLDS, SMALL_WORLDS_CPU = 2048, 8
"""Worlds with such images, on a GPU and on the CPU."""
CHECKED_VIEWS = 6
"""Views in which the outputs are compared, of all cameras of their worlds."""


def check_installed(peers: tuple[str, ...]) -> None:
    """Look for the peers' libraries.

    Raises:
        SynpickError: One is missing.
    """
    modules = dict.fromkeys(module for peer in peers for module in PEERS[peer])
    if missing := [module for module in modules if importlib.util.find_spec(module) is None]:
        raise SynpickError(f"--compare {','.join(peers)} needs {' and '.join(missing)}: pip install 'synpick-warp[peers]'")


def measure_peers(bench: Bench, peers: tuple[str, ...]) -> Iterator[MeasuredRow]:
    """Benchmark of peers out of `PEERS` beside ours; a peer that fails costs its own rows alone.

    Images have `cameras.resolution`, in as many worlds as make a batch, and SMALL_SIZE, in many; physics runs in `bake.worlds` worlds.
    """
    started, config, device = time.perf_counter(), bench.config, bench.device
    few = config.with_values({"bake.worlds": min(config.bake.worlds, PILE_WORLDS)})
    factory = build_factory(few, SilentProgress())
    simulation = factory.simulation
    simulation.scene.settle.rest_ticks = simulation.scene.settle.max_ticks = FOREVER
    for _ in range(worlds.FALL_TICKS + worlds.SETTLE_TICKS):
        simulation.tick()
    pile = pick_pile(factory.catalog, simulation.record.snapshot)
    yield MeasuredRow(f"build and settle {few.bake.worlds} worlds", time.perf_counter() - started, "s", part="setup")
    cameras, small = factory.cameras, make_cameras(Rig.of(replace(config.cameras, resolution=SMALL_SIZE)))
    sizes = (
        (cameras, max(1, factory.stream.rings[0].batch // len(cameras))),
        (small, SMALL_WORLDS if device.is_cuda else SMALL_WORLDS_CPU),
    )
    for peer in RENDERERS:
        for shown, count in sizes if peer in peers else ():
            yield from _guard(peer, _measure_rendering(bench, factory, peer, shown, count))
    if not {"mujoco-warp", "mujoco"} & set(peers):
        return
    ours = make_ours(config, pile, device)
    yield from of_part("ours", measure_engine(lambda: ours, config, pile))
    engines: dict[str, Callable[[str], Engine]] = {
        "mujoco": partial(MujocoEngine, config, pile),
        "mujoco-warp": lambda cone: make_mujoco_warp(config, pile, device, cone, ours.peak_contacts),
    }
    for peer, make in engines.items():
        for cone in CONES if peer in peers else ():
            yield from _guard(peer, measure_engine(partial(make, cone), config, pile))


def _guard(part: str, rows: Iterator[MeasuredRow]) -> Iterator[MeasuredRow]:
    """Rows of a peer; if it raises an exception, a last row with the reason."""
    try:
        yield from of_part(part, rows)
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0]
        yield MeasuredRow(f"failed: {type(error).__name__}: {reason}", math.nan, part=part)


def _measure_rendering(bench: Bench, factory: Factory, peer: str, cameras: tuple[Camera, ...], count_worlds: int) -> Iterator[MeasuredRow]:
    """Benchmark of a peer's renderer and of ours with images of these cameras; worlds beyond the factory's show its piles again.

    Both update poses and render all views. On CUDA both launch without waiting, so that launch overhead is hidden.
    """
    name, build = RENDERERS[peer]
    config, table, device = factory.config, float(factory.stream.rings[0].renderer.scene.table.height), bench.device
    snapshot = tile_snapshot(factory.simulation.record.snapshot, count_worlds, device)
    count, pixels = count_worlds * len(cameras), cameras[0].width * cameras[0].height
    size = f"{cameras[0].width}x{cameras[0].height}, {count_worlds:,} world{'' if count_worlds == 1 else 's'}"
    yield MeasuredRow(f"{size}: views in a batch", count, "")
    fixtures = make_fixtures(make_bins(config.cell.bins), config.gripper)
    theirs = build(config.render, factory.catalog, fixtures, cameras, table, snapshot, count, device)
    renderer, unoccluded = (_make_views_of(factory, mode, cameras, count) for mode in (config.render.mode, UNOCCLUDED))
    out = allocate_view_buffers(count, *cameras[0].resolution, renderer.instances, device)
    views = first_views(count, len(cameras), renderer.instances, device)

    def time_view(*passes: Callable[[], object]) -> float:
        """Time of one view by the fastest of these [s]."""
        return min(bench.seconds_per_call(render, 0.25) for render in passes) / count

    ours_hits, theirs_hits = time_view(partial(renderer.render_gbuffer, snapshot, views, out)), time_view(*theirs.prepare(color=False))
    index, depth = theirs.read_hits(min(count, -(-CHECKED_VIEWS // len(cameras)) * len(cameras)))
    segment, counts = (array[: len(index)].numpy() for array in (out.instance, out.depth))
    for row in compare_hits(theirs.segment, index, depth, segment, counts, config.bop.depth_scale):
        yield replace(row, name=f"{size}: {row.name}")
    theirs_color = time_view(*theirs.prepare(color=True))
    colored, rest = "color by one light with shadows, depth, ids", "anti-aliasing, depth, ids, amodal masks, counts, boxes"
    plain = "render.mode unoccluded, color by light maps with shadows of one lamp and"
    for ours, seconds, outputs, their_seconds in (
        ("depth, ids, amodal masks", ours_hits, "depth, ids", theirs_hits),
        (
            f"color by light maps with indirect light and {rest}",
            time_view(partial(renderer.render, snapshot, views, out)),
            colored,
            theirs_color,
        ),
        (f"{plain} {rest}", time_view(partial(unoccluded.render, snapshot, views, out)), colored, theirs_color),
    ):
        for label, time_of_view in ((f"{size}, ours: {ours}", seconds), (f"{size}, {name}: {outputs}", their_seconds)):
            yield MeasuredRow(f"{label}: views", 1.0 / time_of_view, "1/s")
            yield MeasuredRow(f"{label}: pixels", 1e-6 * pixels / time_of_view, "Mpx/s")
        yield MeasuredRow(f"{size}: rate of ours ({ours}) over {name}'s ({outputs})", their_seconds / seconds, "")


def tile_snapshot(snapshot: Snapshot, count: int, device: wp.Device) -> Snapshot:
    """A snapshot of `count` worlds: world i shows world i modulo those of `snapshot`."""
    chosen = np.arange(count) % len(snapshot.live)
    arrays = {field.name: getattr(snapshot, field.name) for field in fields(snapshot)}
    return Snapshot(**{name: wp.array(array.numpy()[chosen], dtype=array.dtype, device=device) for name, array in arrays.items()})


def _make_views_of(factory: Factory, mode: str, cameras: tuple[Camera, ...], count: int) -> Renderer:
    """Our renderer in a mode, of `count` views of these cameras."""
    own = factory.stream.rings[0].renderer
    grid = build_grid(*cameras[0].resolution)
    scene = replace(own.scene, cameras=build_cameras(cameras, own.scene.device), grid=grid)
    return make_renderer(factory.config.with_values({"render.mode": mode}), scene, own.instances, count, histories=count)
