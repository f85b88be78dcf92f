"""Small scenes that simulate quickly, also with perception: boxes and an L of two boxes, and settings of episodes of a second or two."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh
import warp as wp
from scipy.spatial.distance import pdist

from synpick_warp.codes import Task
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import Config
from synpick_warp.scenes import build
from synpick_warp.scenes.bins import make_bins, make_fixtures
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.collision.hulls import mass_properties
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.lights import load_lights
from synpick_warp.scenes.types import FIRST_DISTRACTOR, Catalog, CatalogEntry, ConvexPiece, Material, TriangleMesh
from synpick_warp.stages.render.scene import RenderScene, build_render_scene
from synpick_warp.stages.sim.physics import MIN_GPU_WORLDS, Physics
from synpick_warp.stages.sim.simulate import Simulation, TickRecord
from synpick_warp.stages.stream import TickReport, read_tick
from tests.harness.environment import default_device
from tests.worlds.toy_scene import entry

BOX = ((0.08, 0.06, 0.04),)
CUBE = ((0.05, 0.05, 0.05),)
"""Sizes [m] of an object's boxes; the second of an L stands beside the first."""
PLATE = ((0.2, 0.2, 0.01),)
ANGLE = ((0.09, 0.03, 0.03), (0.03, 0.06, 0.03))
DENSITY = 500.0
COARSE = {"physics.step": 4e-3, "physics.steps_per_tick": 16, "physics.substeps": 1, "physics.iterations": 6}
"""Overrides under which a tick takes half the time, where its physics need not be the paper's."""
QUICK_PICKS = {"pick.appear_height": 0.2, "pick.lift_height": 0.2, "pick.lift_speed": 1.2, "pick.near_speed": 0.5}
"""Overrides under which an attempt takes about 10 ticks instead of 55."""

QUICK = {
    "bake.worlds": 1,
    "bake.episodes": 1,
    "bake.device": default_device(),
    "bake.writers": 1,
    "arrangement.max_objects": 3,
    "arrangement.volume": 6e-4,
    "settle.min_time": 0.1,
    "settle.rest_ticks": 1,
    "settle.relax_time": 0.6,
    "settle.tries": 3,
    "move.rounds": 1,
    "move.speed": 2.0,
    "move.start_height": 0.15,
}
"""Overrides on the preset `smoke`."""


def settings(**overrides: object) -> Config:
    """QUICK with changes; keys with __ for the dot."""
    return load_config("smoke", QUICK | {key.replace("__", "."): value for key, value in overrides.items()})


def catalog(*shapes: Sequence[tuple[float, float, float]]) -> Catalog:
    """Objects made of boxes: obj_ids from 1."""
    return Catalog(tuple(_entry(number, sizes) for number, sizes in enumerate(shapes or (BOX, CUBE, ANGLE), start=1)))


def cluttered_catalog() -> Catalog:
    """Two kinds of boxes, and without labels a plate and an L."""
    names = ("box", "cube", "plate", "angle")
    bodies = [replace(body, name=name) for body, name in zip(catalog(BOX, CUBE, PLATE, ANGLE).entries, names, strict=True)]
    return Catalog(tuple(bodies[:2]), tuple(replace(body, obj_id=FIRST_DISTRACTOR - index) for index, body in enumerate(bodies[2:])))


def pieces(sizes: Sequence[tuple[float, float, float]]) -> tuple[ConvexPiece, ...]:
    """One box about the origin, or two side by side along y with a common lower x and z."""
    made = []
    shift = np.zeros(3)
    for size in sizes:
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * size
        made.append(simplify_hull(corners + shift, 8))
        shift = np.array([-(sizes[0][0] - sizes[-1][0]) / 2, (sizes[0][1] + sizes[-1][1]) / 2, 0.0])
    return tuple(made)


def _entry(obj_id: int, sizes: Sequence[tuple[float, float, float]]) -> CatalogEntry:
    parts = pieces(sizes)
    whole = trimesh.util.concatenate([trimesh.Trimesh(part.vertices, part.faces, process=False) for part in parts])
    whole.unmerge_vertices()
    return replace(solid(whole, parts), obj_id=obj_id, name=f"boxes_{obj_id}")


def solid(whole: trimesh.Trimesh, parts: tuple[ConvexPiece, ...] = ()) -> CatalogEntry:
    """Object 1 of a mesh [m] and its collision shape, by default the hull."""
    parts = parts or (simplify_hull(whole.vertices, 64),)
    vertices = np.asarray(whole.vertices, np.float32)
    mesh = TriangleMesh(
        vertices, np.asarray(whole.faces, np.int32), np.asarray(whole.vertex_normals, np.float32), np.zeros((len(vertices), 2), np.float32)
    )
    properties = mass_properties(parts)
    mass = DENSITY * properties.volume
    return replace(
        entry(mesh, Material((0.6, 0.5, 0.4), None, 0.0, 0.5)),
        name="solid",
        pieces=parts,
        volume=properties.volume,
        mass=mass,
        center_of_mass=properties.center_of_mass,
        inertia=mass * properties.unit_inertia,
        diameter=float(pdist(np.concatenate([part.vertices for part in parts])).max()),
    )


def report(record: TickRecord) -> TickReport:
    """Report of a tick."""
    return read_tick(record)


def run_ticks(simulation: Simulation, ticks: int) -> list[TickReport]:
    """Run ticks; return their reports."""
    reports = []
    for _ in range(ticks):
        simulation.tick()
        reports.append(report(simulation.record))
    return reports


def place_cubes(config: Config, device: wp.Device, pose: np.ndarray, velocity: np.ndarray | None = None) -> Physics:
    """Build worlds with a cube each in the real physics, beside a gripper above the tote. `config`: settings of these worlds. `device`:
    device of the simulation. `pose`: position [m] and quaternion xyzw of the cubes (world, 7). `velocity`: their linear velocity (world, 3)
    [m/s]; None: at rest."""
    built = build.build_model(config, catalog(CUBE), device)
    physics, worlds, first = Physics(config.physics, built), len(pose), build.GRIPPER_DOFS
    coordinates, velocities = (array.numpy().reshape(worlds, -1) for array in (physics.state.joint_q, physics.state.joint_qd))
    coordinates[:, 2] = 1.0  # The gripper hovers.
    coordinates[:, first : first + build.FREE_COORDS] = pose
    if velocity is not None:
        velocities[:, first : first + 3] = velocity
    physics.state.joint_q.assign(coordinates.reshape(-1))
    physics.state.joint_qd.assign(velocities.reshape(-1))
    variant = np.full((worlds, built.layout.bodies_per_world), -1, np.int32)
    variant[:, build.GRIPPER_BODIES] = built.variant[0]
    restarted = wp.array(np.ones(worlds + 1, bool), dtype=bool, device=device)
    physics.load(wp.array(variant.reshape(-1), dtype=wp.int32, device=device), restarted)
    return physics


LIGHTS = 1

SHORT = QUICK_PICKS | {"bake.mode": "pick", "perception.resolution": [320, 180]}
"""Settings of short attempts."""
CALM = {"pick.appear_height": 0.3, "pick.lift_height": 0.3, "pick.lift_speed": 0.6, "pick.near_speed": 0.2}
"""Overrides on SHORT with slower motion: the descent takes several ticks, and a lifted object does not swing at the end."""

BRIEF = COARSE | SHORT | {"arrangement.max_objects": 3, "pick.failures": 1, "perception.resolution": [160, 90]}
BRIEF |= {"physics.guide_height": 0.4, "bake.mode": "mixed", "bake.episodes": 8}
"""Overrides under which an attempt takes few ticks, each of little computation."""


def render_scene(config: Config, objects: Catalog, device: Any) -> RenderScene:
    """The scene of a bake, under one light."""
    fixtures, lights = make_fixtures(make_bins(config.cell.bins), config.gripper), load_lights("")[:LIGHTS]
    return build_render_scene(config.render, -config.tote.wall, objects, fixtures, make_cameras(config.rig), lights, device)


def brief(device: Any, worlds: int, **changed: Any) -> Simulation:
    """Simulation with settings BRIEF and overrides; on a GPU with at least MIN_GPU_WORLDS worlds, so that results do not depend on the
    number."""
    worlds = max(worlds, MIN_GPU_WORLDS) if device.is_cuda else worlds
    return picking(settings(**BRIEF | {"bake__worlds": worlds} | changed), catalog(), device)


def picking(config: Config, objects: Catalog, device: Any, **other: Any) -> Simulation:
    """Simulation with perception; `other`: further arguments of `Simulation`."""
    return Simulation(config, objects, LIGHTS, device, render_scene(config, objects, device), **other)


def find_choices(simulation: Simulation) -> np.ndarray:
    """Worlds at a moment of choice: an attempt was planned in this tick, and begins with the next. Waits for the device."""
    task, steps = simulation.attempts.task.numpy(), simulation.attempts.steps.numpy()
    return np.flatnonzero((task == Task.APPROACH) & (steps == 0))


def own_grasps(simulation: Simulation, worlds: Sequence[int]) -> dict[str, np.ndarray]:
    """Planned grasps of worlds as the arrays of `Trials.upload`: row i is the i-th of `worlds`, candidate 0. Waits for the device."""
    plan = simulation.plan
    arrays = {name: getattr(plan, name).numpy()[np.asarray(worlds, int)] for name in ("target", "point", "normal", "yaw", "tilt")}
    return {"row": np.arange(len(worlds), dtype=np.int32), "candidate": np.zeros(len(worlds), np.int32)} | arrays
