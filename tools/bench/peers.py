"""Peers of the benchmark (`--compare`): other simulators and renderers on the same piles at rest, beside ours.

Engines of physics: our solver and MuJoCo Warp by Newton's interface, MuJoCo in threads; their rates and calm.
"""

import importlib
import importlib.util
import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import newton
import numpy as np
import warp as wp

from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.configs.cell.cameras import Rig
from synpick_warp.configs.schema import UNOCCLUDED, Config
from synpick_warp.errors import SynpickError
from synpick_warp.factory.assembly import Factory, build_factory, make_renderer
from synpick_warp.scenes.bins import TABLE_SIZE, guide_walls, make_bins, make_fixtures
from synpick_warp.scenes.build import hull_mesh
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.types import Camera, Catalog, CatalogEntry
from synpick_warp.stages.buffers import Snapshot, allocate_view_buffers
from synpick_warp.stages.render.cameras import build_cameras
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.scene import build_grid
from synpick_warp.stages.render.view_setup import first_views
from synpick_warp.stages.sim.physics import make_pipeline, make_solver, may_capture
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.progress import SilentProgress
from tools.bench import worlds
from tools.bench.peer_scenes import RayScene, SensorScene, compare_hits
from tools.bench.run import FOREVER, Bench
from tools.options import MeasuredRow, of_part

PEERS: Mapping[str, tuple[str, ...]] = {"mujoco-warp": ("mujoco", "mujoco_warp"), "mujoco": ("mujoco",), "sensor-camera": ()}
"""Peers, and the modules that they import besides those of the product."""
RENDERERS: Mapping[str, tuple[str, Callable[..., RayScene | SensorScene]]] = {
    "sensor-camera": ("SensorCamera", SensorScene),
    "mujoco-warp": ("MuJoCo Warp", RayScene),
}
"""Renderers of peers: their names in rows, and their scenes, which are built from the same arguments."""
PILE_WORLDS = 64
"""Worlds that are settled for the comparison, at most; rendering repeats them, physics takes one of them."""
SMALL_SIZE = (64, 64)
"""Image size of policies that learn in many worlds [px]."""
SMALL_WORLDS, SMALL_WORLDS_CPU = 2048, 8
"""Worlds with such images, on a GPU and on the CPU."""
HEAP_HEIGHT = 0.1
"""Height above the rim up to which the centre of mass of an object counts as inside [m]."""
CHECKED_VIEWS = 6
"""Views in which the outputs are compared, of all cameras of their worlds."""


def check_installed(peers: tuple[str, ...]) -> None:
    """Look for the peers' libraries. Raises SynpickError: one is missing."""
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
    engines: dict[str, Callable[[str], NewtonEngine | MujocoEngine]] = {
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
    snapshot = stand_still(tile_snapshot(factory.simulation.record.snapshot, count_worlds, device))
    count, pixels = count_worlds * len(cameras), cameras[0].width * cameras[0].height
    size = f"{cameras[0].width}x{cameras[0].height}, {count_worlds:,} world{'' if count_worlds == 1 else 's'}"
    yield MeasuredRow(f"{size}: views in a batch", count, "")
    fixtures = make_fixtures(make_bins(config.cell.bins), config.gripper)
    theirs = build(config.render, factory.catalog, fixtures, cameras, table, snapshot, count, device)
    renderer, unoccluded = (_make_views_of(factory, mode, cameras, count) for mode in (config.render.mode, UNOCCLUDED))
    out = allocate_view_buffers(count, *cameras[0].resolution, renderer.instances, device)
    views = first_views(count, len(cameras), renderer.instances, device)

    frame = itertools.count()

    def render_next(ours: Renderer) -> None:
        """Render the next frame, so that histories of light hold, as in an episode."""
        snapshot.frame.fill_(next(frame))
        ours.render(snapshot, views, out)

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
            time_view(partial(render_next, renderer)),
            colored,
            theirs_color,
        ),
        (f"{plain} {rest}", time_view(partial(render_next, unoccluded)), colored, theirs_color),
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


def stand_still(snapshot: Snapshot) -> Snapshot:
    """A snapshot whose previous frame was the same."""
    last = ("last_pose", "last_catalog_index", "last_fixture_pose", "last_fixture_visible")
    return replace(snapshot, **{name: getattr(snapshot, name.removeprefix("last_")) for name in last})


def _make_views_of(factory: Factory, mode: str, cameras: tuple[Camera, ...], count: int) -> Renderer:
    """Our renderer in a mode, of `count` views of these cameras."""
    own = factory.stream.rings[0].renderer
    grid = build_grid(*cameras[0].resolution)
    scene = replace(own.scene, cameras=build_cameras(cameras, own.scene.device), grid=grid)
    return make_renderer(factory.config.with_values({"render.mode": mode}), scene, own.instances, count, histories=count)


# ---- physics ----


LIFT, SPREAD = 0.1, 2.0
"""Start of a fall: heights above the floor at rest times SPREAD, plus LIFT [m]. The lowest objects land after 0.14 s."""
FALL_STEPS, LEAD_STEPS, REST_STEPS = 250, 500, 250
"""Time steps of a fall, of settling from our pile at rest into the engine's, and of the measurement at rest."""
WARM_STEPS, GRAPH_STEPS = 2, 10
"""Steps before the first measurement, and steps in a captured graph."""
CONES = {"pyramidal": 10, "elliptic": 20}
"""MuJoCo's friction cones -> maximum iterations of its solver (Newton's method, not the library Newton)."""
CONTACT_ROOM, MIN_CONTACTS, CAPACITY_STEP = 2.0, 64, 16
"""Contact capacity of a world in MuJoCo Warp: multiple of the largest count at our runs' ends, minimum, and its divisor."""
CONTACT_ROWS = 4
"""Constraint rows of a contact in the pyramidal cone; the elliptic one has three."""
WORLDS_PER_THREAD = 4
"""Worlds of each thread of MuJoCo."""
LINEAR = slice(0, 3)
"""First three components: position of a pose, linear part of a velocity (Newton's bodies, MuJoCo's free joints)."""


@dataclass(frozen=True, eq=False)
class EqualPile:
    """Objects of one world, which all worlds repeat, with their object-to-world poses."""

    entries: tuple[CatalogEntry, ...]
    pose: np.ndarray
    """x, y, z [m], quaternion x, y, z, w (body, 7) float64."""

    def lift(self) -> "EqualPile":
        """Start of a fall: the same pile, stretched vertically by SPREAD and raised by LIFT; x, y and orientations stay."""
        pose = self.pose.copy()
        pose[:, 2] = LIFT + SPREAD * pose[:, 2]
        return replace(self, pose=pose)


def pick_pile(catalog: Catalog, snapshot: Snapshot) -> EqualPile:
    """Pile of the world with the median number of objects."""
    indices, poses = snapshot.catalog_index.numpy(), snapshot.pose.numpy()
    counts = (indices >= 0).sum(axis=1)
    world = int(np.argsort(counts, kind="stable")[len(counts) // 2])
    present = indices[world] >= 0
    return EqualPile(tuple(catalog.bodies[index] for index in indices[world][present]), poses[world][present].astype(np.float64))


def build_piles(config: Config, pile: EqualPile, worlds: int, device: wp.Device) -> newton.Model:
    """Build `worlds` equal worlds of bins, table, guide walls and the pile; no gripper, no empty body slots.

    Shapes, masses, friction and damping are those of a bake. Joint coordinates are the pile's poses, object by object.
    """
    physics, bins = config.physics, make_bins(config.cell.bins)
    world, scene = (newton.ModelBuilder(gravity=(0.0, 0.0, -physics.gravity)) for _ in range(2))
    for builder in (world, scene):
        newton.solvers.SolverSteel.register_custom_attributes(builder)
    shape = newton.ModelBuilder.ShapeConfig(density=0.0, mu=physics.friction, gap=physics.gap, restitution=0.0)
    for one in bins:
        for piece in (*one.pieces, *guide_walls(one.sizes, physics.guide_height)):
            world.add_shape_convex_hull(-1, mesh=hull_mesh(piece), cfg=shape)
    table = wp.transform(wp.vec3(0.0, 0.0, bins[0].sizes.ground - TABLE_SIZE[2]), wp.quat_identity())
    world.add_shape_box(-1, xform=table, hx=TABLE_SIZE[0], hy=TABLE_SIZE[1], hz=TABLE_SIZE[2], cfg=shape)
    damping = {"steel:rigid_body_angular_damping": physics.angular_damping, "steel:rigid_body_max_linear_velocity": physics.max_speed}
    for entry, pose in zip(pile.entries, pile.pose, strict=True):
        body = world.add_body(
            xform=wp.transform(*pose.tolist()),
            mass=entry.mass,
            com=wp.vec3(*entry.center_of_mass),
            inertia=wp.mat33(entry.inertia),
            lock_inertia=True,
            custom_attributes=damping,
        )
        for piece in entry.pieces:
            world.add_shape_convex_hull(body, mesh=hull_mesh(piece), cfg=shape)
    scene.replicate(world, copy_count=worlds)
    with warnings.catch_warnings():
        # Newton raises the inertia of bodies of a few millimetres to its threshold, and says so.
        warnings.filterwarnings("ignore", "Eigenvalues below threshold")
        return scene.finalize(device=device)


class NewtonEngine:
    """Engine behind Newton's solver interface. Its steps are captured as a graph, where a bake captures them."""

    def __init__(
        self,
        name: str,
        config: Config,
        pile: EqualPile,
        device: wp.Device,
        make: Callable[[newton.Model], newton.solvers.SolverBase],
        substeps: int = 1,
    ) -> None:
        """Build `bake.worlds` worlds, and the solver by `make`; a time step is `substeps` of collision detection and solver."""
        self.name, self.worlds, self.device = name, config.bake.worlds, device
        self.model = build_piles(config, pile, self.worlds, device)
        self.pipeline = make_pipeline(config.physics, self.model)
        self.contacts, self.solver = self.pipeline.contacts(), make(self.model)
        self.state: Any = self.model.state()
        self._other, self.control = self.model.state(), self.model.control()
        self.substeps, self.dt = substeps, config.physics.step / substeps
        self.peak_contacts = 0
        self._graph: wp.Graph | None = None
        # The first steps run eagerly: they load kernels and trigger late allocations.
        self.start(pile)
        self._advance(WARM_STEPS)
        if may_capture(device):
            with wp.ScopedCapture(device=device) as capture:
                self._advance(GRAPH_STEPS)
            self._graph = capture.graph

    def start(self, pile: EqualPile) -> None:
        """Set all worlds to the poses of a pile, at rest."""
        pose = np.tile(pile.pose.astype(np.float32).reshape(-1), self.worlds)
        assert self.model.joint_q is not None  # Models with rigid bodies have it.
        for values in (self.model.joint_q, self.state.joint_q):
            values.assign(pose)
        self.state.joint_qd.zero_()
        self.solver.reset(self.state)
        self.pipeline.reset_contact_matching()
        newton.eval_fk(self.model, self.state.joint_q, self.state.joint_qd, self.state)

    def run(self, steps: int) -> float:
        """Simulate this many steps of all worlds; returns the time taken [s]."""
        wp.synchronize_device(self.device)
        started = time.perf_counter()
        if self._graph is not None:
            for _ in range(steps // GRAPH_STEPS):
                wp.capture_launch(self._graph)
            steps %= GRAPH_STEPS
        self._advance(steps)
        wp.synchronize_device(self.device)
        seconds = time.perf_counter() - started
        contacts = int(self.contacts.rigid_contact_count.numpy()[0])
        self.peak_contacts = max(self.peak_contacts, -(-contacts // self.worlds))
        return seconds

    def _advance(self, steps: int) -> None:
        """Launch steps, each of `substeps` collisions and solves; the result is in `state`."""
        current, following = self.state, self._other
        for _ in range(steps * self.substeps):
            self.pipeline.collide(current, self.contacts)
            self.solver.step(current, following, self.control, self.contacts, self.dt)
            current, following = following, current
        if current is not self.state:
            self.state.assign(current)

    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions [m] and linear velocities [m/s] of all bodies (world, body, 3)."""
        pose, velocity = (array.numpy().reshape(self.worlds, -1, size) for array, size in ((self.state.body_q, 7), (self.state.body_qd, 6)))
        return pose[..., LINEAR], velocity[..., LINEAR]


def make_ours(config: Config, pile: EqualPile, device: wp.Device) -> NewtonEngine:
    """Engine with our solver, and the settings of a bake."""
    physics = config.physics
    name = f"SolverSteel ({physics.substeps} x {physics.iterations} iterations)"
    return NewtonEngine(name, config, pile, device, lambda model: make_solver(physics, model, len(pile.entries)), physics.substeps)


def make_mujoco_warp(config: Config, pile: EqualPile, device: wp.Device, cone: str, peak_contacts: int) -> NewtonEngine:
    """MuJoCo Warp with the contacts of our collision pipeline; memory for `CONTACT_ROOM` times `peak_contacts` contacts a world."""
    contacts = max(MIN_CONTACTS, -(-int(CONTACT_ROOM * peak_contacts) // CAPACITY_STEP) * CAPACITY_STEP)

    def make(model: newton.Model) -> newton.solvers.SolverBase:
        solver = newton.solvers.SolverMuJoCo(
            model,
            use_mujoco_contacts=False,
            solver="newton",
            cone=cone,
            iterations=CONES[cone],
            nconmax=contacts,
            njmax=CONTACT_ROWS * contacts,
        )
        # Printing from kernels that the limit of iterations is reached would cost more than the solver; lost contacts are still printed.
        limits = importlib.import_module("mujoco_warp").OverflowType
        solver.mjw_model.opt.warn_overflow = limits.ALL & ~(limits.ITERATIONS | limits.LS_ITERATIONS)
        return solver

    return NewtonEngine(f"MuJoCo Warp ({cone} cone, {CONES[cone]} iterations)", config, pile, device, make)


class MujocoEngine:
    """MuJoCo's engine in C with its own collision detection: `WORLDS_PER_THREAD` worlds for each of the process's CPU cores."""

    def __init__(self, config: Config, pile: EqualPile, cone: str) -> None:
        self.mujoco, self.rollout = importlib.import_module("mujoco"), importlib.import_module("mujoco.rollout")
        self.config, self.cone, self.threads = config, cone, count_cores()
        self.worlds = WORLDS_PER_THREAD * self.threads
        self.name = f"MuJoCo ({cone} cone, {CONES[cone]} iterations, {self.threads} threads)"
        self.start(pile)

    def start(self, pile: EqualPile) -> None:
        """Build MuJoCo's model of a pile, and set all worlds to its poses, at rest."""
        model = build_piles(self.config, pile, 1, wp.get_device("cpu"))
        # A single contact for two hulls, MuJoCo's default, lets a pile sink 15 mm into the floor.
        solver = newton.solvers.SolverMuJoCo(
            model, use_mujoco_cpu=True, enable_multiccd=True, solver="newton", cone=self.cone, iterations=CONES[self.cone]
        )
        self.model, spec = solver.mj_model, int(self.mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self.model.opt.timestep = self.config.physics.step
        state = np.zeros(self.mujoco.mj_stateSize(self.model, spec))
        self.mujoco.mj_getState(self.model, solver.mj_data, state, spec)
        self.state = np.tile(state, (self.worlds, 1))
        self.data = [self.mujoco.MjData(self.model) for _ in range(self.threads)]

    def run(self, steps: int) -> float:
        """Simulate this many steps of all worlds in threads; returns the time taken [s]."""
        started = time.perf_counter()
        states, _ = self.rollout.rollout(self.model, self.data, self.state, nstep=steps)
        seconds = time.perf_counter() - started
        self.state = states[:, -1].copy()
        return seconds

    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions [m] and linear velocities [m/s] of all bodies (world, body, 3)."""
        positions, end = 1 + self.model.nq, 1 + self.model.nq + self.model.nv
        coordinates, velocities = self.state[:, 1:positions], self.state[:, positions:end]
        return coordinates.reshape(self.worlds, -1, 7)[..., LINEAR], velocities.reshape(self.worlds, -1, 6)[..., LINEAR]


def is_inside(sizes: BinSizes, position: np.ndarray) -> np.ndarray:
    """Whether positions (N, 3) lie above the floor, within the rim's opening, and at most `HEAP_HEIGHT` above the rim."""
    rim = np.array(sizes.opening) / 2
    return (np.abs(position[:, :2]) < rim).all(axis=1) & (position[:, 2] > 0.0) & (position[:, 2] < sizes.height + HEAP_HEIGHT)


def measure_engine(make: Callable[[], NewtonEngine | MujocoEngine], config: Config, pile: EqualPile) -> Iterator[MeasuredRow]:
    """Rate of an engine while the pile falls and lands; rate and calm at rest. A world-step is `physics.step` of simulated time."""
    engine = make()

    def rate(steps: int) -> float:
        return steps * engine.worlds / engine.run(steps)

    engine.start(pile.lift())
    worlds = f"{engine.worlds} worlds of {len(pile.entries)} objects"
    yield MeasuredRow(f"{engine.name}, {worlds}, falling: world-steps", rate(FALL_STEPS), "1/s")
    engine.start(pile)
    engine.run(LEAD_STEPS)
    yield MeasuredRow(f"{engine.name}, at rest: world-steps", rate(REST_STEPS), "1/s")
    position, velocity = engine.bodies()
    speed = 1e3 * np.linalg.norm(velocity, axis=-1)
    yield MeasuredRow(f"{engine.name}, at rest: mean speed", float(speed.mean()), "mm/s")
    yield MeasuredRow(f"{engine.name}, at rest: median speed", float(np.median(speed)), "mm/s")
    moved = np.linalg.norm(position - pile.pose[:, :3], axis=-1)
    yield MeasuredRow(f"{engine.name}, at rest: mean distance from the start", 1e3 * float(moved.mean()), "mm")
    inside = is_inside(make_bins(config.cell.bins)[0].sizes, position.reshape(-1, 3)).mean()
    yield MeasuredRow(f"{engine.name}, at rest: objects in the tote", 100.0 * float(inside), "%")
