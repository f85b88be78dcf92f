"""Broad phase: the same contacts as with Newton's, from fewer pairs; narrow phase: which kernels are compiled."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import newton
import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from newton._src.sim import collide

from synpick_warp.codes import Phase
from synpick_warp.configs.schema import Config
from synpick_warp.kernels.newton_patches import broad_phase as kernels
from synpick_warp.newton_patches import broad_phase
from synpick_warp.scenes import build
from synpick_warp.stages.sim import physics
from synpick_warp.stages.sim.simulate import Simulation
from tests.harness.probe import probe
from tests.worlds.small_worlds import CUBE, catalog, settings

WORLDS, FRAMES, STEPS = 3, 4, 6
TICKS = 30
ARRAYS = ("shape0", "shape1", "point0", "point1", "normal")
"""Arrays of contacts that are compared."""


pack_direction, unpack_direction = probe(kernels.pack_direction), probe(kernels.unpack_direction)


@given(st.lists(st.tuples(*[st.floats(-1.0, 1.0, width=32)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3), min_size=1, max_size=20))
def test_packed_directions_are_right_within_a_ten_thousandth(vectors):
    directions = np.concatenate((vectors, np.vstack((np.eye(3), -np.eye(3)))))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    packed = pack_direction(directions, device="cpu")
    unpacked = unpack_direction(packed, device="cpu")
    assert (packed != 0).all()
    np.testing.assert_allclose(unpacked, directions, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(unpacked, axis=1), 1.0, atol=1e-6)


def make_model(config: Config, device: wp.Device) -> build.BuiltModel:
    """Worlds with boxes, cubes and angles, one in each slot."""
    built = build.build_model(config, catalog(), device)
    slots = built.layout.single_slots + built.layout.compound_slots
    variant = np.full((config.bake.worlds, built.layout.bodies_per_world), -1, np.int32)
    entries = [slot % 2 for slot in range(built.layout.single_slots)] + [2] * built.layout.compound_slots
    variant[:, build.GRIPPER_BODIES : build.GRIPPER_BODIES + slots] = built.variant[entries]
    built.model.select_body_variants(wp.array(variant.reshape(-1), dtype=wp.int32, device=device))
    return built


def make_newton_pipeline(monkeypatch: pytest.MonkeyPatch, config: Config, model: newton.Model) -> newton.CollisionPipeline:
    """A pipeline with Newton's broad phase."""
    with monkeypatch.context() as patch:
        patch.setattr(physics, "KNOWN_NEWTON", "another")
        pipeline = physics.make_pipeline(config.physics, model)
    assert type(pipeline.broad_phase) is newton.geometry.BroadPhaseAllPairs
    return pipeline


def read_contacts(contacts: newton.Contacts) -> list[np.ndarray]:
    """Contacts in the order in which the pipeline sorts them for the solver."""
    count = int(contacts.rigid_contact_count.numpy()[0])
    return [getattr(contacts, f"rigid_contact_{name}").numpy()[:count] for name in ARRAYS]


@pytest.mark.parametrize("most", [broad_phase.MANY_SHAPES, 0])
def test_contacts_of_moving_and_jumping_bodies_are_those_of_newton(device, monkeypatch, most):
    """Bodies jump to random poses in the tote and then move by millimeters, so that cached axes are stale, valid and nearly valid. Worlds
    of more shapes than `most` have a thread for each."""
    monkeypatch.setattr(broad_phase, "MANY_SHAPES", most)
    config = settings(bake__worlds=WORLDS, arrangement__max_objects=6)
    model = make_model(config, device).model
    reference, found = make_newton_pipeline(monkeypatch, config, model), physics.make_pipeline(config.physics, model)
    assert type(found.broad_phase) is broad_phase.SeparatingBroadPhase
    known, ours = reference.contacts(), found.contacts()
    state, random = model.state(), np.random.default_rng(3)
    contacts, pairs = 0, np.zeros(2, int)
    for _ in range(FRAMES):
        poses = np.concatenate(
            (random.uniform((-0.15, -0.1, 0.0), (0.15, 0.1, 0.12), (model.body_count, 3)), np.zeros((model.body_count, 4))), 1
        )
        poses[:, 3:] = random.normal(size=(model.body_count, 4))
        for _ in range(STEPS):
            poses += random.normal(scale=1e-3, size=poses.shape)
            poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
            state.body_q.assign(poses.astype(np.float32))
            reference.collide(state, known)
            found.collide(state, ours)
            for expected, value in zip(read_contacts(known), read_contacts(ours), strict=True):
                np.testing.assert_array_equal(value, expected)
            contacts += int(known.rigid_contact_count.numpy()[0])
            pairs += [int(pipeline.broad_phase_pair_count.numpy()[0]) for pipeline in (reference, found)]
    assert contacts > 100
    assert pairs[1] < 0.8 * pairs[0]


@pytest.mark.slow
def test_piles_move_as_with_the_broad_phase_of_newton(device, monkeypatch):
    """Piles that fall, rest and are stirred have bitwise identical trajectories; at least half the pairs without contacts are rejected."""
    worlds = 8 if device.is_cuda else 2
    config = settings(bake__worlds=worlds, bake__episodes=worlds, bake__mode="move", physics__deterministic=True)
    found, phases, simulations = [], set(), []
    for version in (physics.KNOWN_NEWTON, "another"):
        monkeypatch.setattr(physics, "KNOWN_NEWTON", version)
        simulation = Simulation(config, catalog(), 2, device)
        simulations.append(simulation)
        poses = []
        for _ in range(TICKS):
            simulation.tick()
            poses.append(simulation.physics.state.joint_q.numpy())
            phases |= set(simulation.state.phase.numpy().tolist())
        found.append(poses)
    np.testing.assert_array_equal(*found)
    assert Phase.ACT in phases
    ours, newtons = (int(simulation.physics.pipeline.broad_phase_pair_count.numpy()[0]) for simulation in simulations)
    contacts = read_contacts(simulations[0].physics.contacts)
    touching = len(set(zip(*(shapes.tolist() for shapes in contacts[:2]), strict=True)))
    assert touching <= ours
    assert ours - touching <= 0.5 * (newtons - touching)


@pytest.mark.parametrize(("gap", "height", "overlaps", "kept"), [(1e-3, 5.0, 1, 1), (9e-3, 5.0, 1, 0), (1e-3, 1600.0, 0, 0)])
def test_boxes_with_overlapping_bounds_are_rejected_beyond_their_contact_margins(device, gap, height, overlaps, kept):
    """Two cubes, turned by 45 degrees about z, have faces at a distance `gap`; all others are far away. UNREACHED, they do not count."""
    built = build.build_model(settings(bake__worlds=1, arrangement__max_objects=2), catalog(CUBE), device)
    cubes = np.arange(build.GRIPPER_BODIES, build.GRIPPER_BODIES + 2)
    variant = np.full(built.model.body_count, -1, np.int32)
    variant[cubes] = built.variant[0]
    built.model.select_body_variants(wp.array(variant, dtype=wp.int32, device=device))
    poses = np.zeros((len(variant), 7), np.float32)
    poses[:, :3] = 10.0 * np.arange(1, len(poses) + 1)[:, None]
    poses[:, 6] = 1.0
    normal = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
    for body, distance in zip(cubes, (0.0, CUBE[0][0] + gap), strict=True):
        poses[body] = (*((5.0, 5.0, height) + distance * normal), 0.0, 0.0, np.sin(np.pi / 8), np.cos(np.pi / 8))
    state = built.model.state()
    state.body_q.assign(poses)
    pipeline = physics.make_pipeline(settings().physics, built.model)
    pipeline.collide(state, pipeline.contacts())
    assert int(pipeline.broad_phase.overlap_count.numpy()[0]) == overlaps  # pyright: ignore[reportAttributeAccessIssue]
    assert int(pipeline.broad_phase_pair_count.numpy()[0]) == kept


def test_newton_lets_all_pairs_collide_but_static_ones_and_those_of_a_body(device, monkeypatch):
    """Pairs of shapes of one body, and of static shapes, never collide; all others may, except those that are filtered explicitly."""
    config = settings(bake__worlds=WORLDS, arrangement__max_objects=3)
    model = make_model(config, device).model
    count = model.shape_count // WORLDS
    colliding = broad_phase.find_colliding(make_newton_pipeline(monkeypatch, config, model), count)
    body = model.shape_body.numpy()[:count]
    lower, higher = np.triu_indices(count, 1)
    expected = np.zeros_like(colliding)
    expected[lower, higher] = (body[lower] != body[higher]) & ((body[lower] >= 0) | (body[higher] >= 0))
    wrong = np.argwhere(expected != colliding)
    excluded = {tuple(pair) for pair in np.sort(np.array(sorted(model.shape_collision_filter_pairs)), axis=1) if max(pair) < count}
    assert {tuple(pair) for pair in wrong} <= excluded
    assert colliding.sum() > 0.5 * len(lower)


@pytest.mark.parametrize("most", [broad_phase.MANY_SHAPES, 0])
def test_pairs_up_to_the_capacity_keep_their_contacts(device, monkeypatch, most):
    """Overlaps beyond the capacity are dropped, the others kept; `overlap_count` includes both."""
    monkeypatch.setattr(broad_phase, "MANY_SHAPES", most)
    config = settings(bake__worlds=1, arrangement__max_objects=6, physics__pairs_per_world=16)
    model = make_model(config, device).model
    pipeline, state = physics.make_pipeline(config.physics, model), model.state()
    poses = np.zeros((model.body_count, 7), np.float32)
    poses[:, 6] = 1.0
    poses[:, 2] = 10.0
    state.body_q.assign(poses)
    contacts = pipeline.contacts()
    pipeline.collide(state, contacts)
    assert int(pipeline.broad_phase.overlap_count.numpy()[0]) > 16  # pyright: ignore[reportAttributeAccessIssue]
    assert 8 <= int(pipeline.broad_phase_pair_count.numpy()[0]) <= 16  # On a GPU any 16 overlaps are tested.
    touching = read_contacts(contacts)[:2]
    assert len(set(zip(*(shapes.tolist() for shapes in touching), strict=True))) > 4


@pytest.mark.parametrize(
    ("world", "body", "group"),
    [
        ((0, 0, 1), (0, 1, 2), (1, 1, 1)),
        ((-1, 0, 0, 1), (-1, 0, 1, 2), (1, 1, 1, 1)),
        ((1, 0), (1, 0), (1, 1)),
        ((0, 0, 1, 1), (0, 1, 2, 2), (1, 1, 1, 1)),
        ((0, 0, 1, 1), (0, 1, 2, 3), (1, 1, 1, 2)),
    ],
)
def test_worlds_that_differ_keep_the_broad_phase_of_newton(world, body, group):
    model = SimpleNamespace(world_count=2, shape_count=len(world), body_count=4)
    for name, values in (("shape_world", world), ("shape_body", body), ("shape_collision_group", group)):
        setattr(model, name, wp.array(values, dtype=wp.int32, device="cpu"))
    newtons = object.__new__(newton.geometry.BroadPhaseAllPairs)
    pipeline = SimpleNamespace(model=model, broad_phase=newtons)
    broad_phase.replace_broad_phase(pipeline)  # pyright: ignore[reportArgumentType]
    assert pipeline.broad_phase is newtons


# ---- compilation: what a bake does not launch is not compiled ----

SHARED_MODULES = """
from warp._src import context
from synpick_warp.factory import assembly
from newton.solvers import SolverSteel
for name, module in context.user_modules.items():
    if name.startswith(("newton._src.geometry.", "newton._src.sim.", "newton._src.solvers.steel.")) and len(module._get_live_kernels()) > 1:
        print(name)
"""


@pytest.mark.slow
def test_no_two_kernels_of_newton_share_a_module():
    """In a process of its own: what others have imported before decides nothing."""
    assert subprocess.run([sys.executable, "-c", SHARED_MODULES], check=True, capture_output=True, text=True).stdout == ""


def test_one_small_world_has_the_kernels_of_many(device):
    """On a GPU, Newton chooses by the number of pairs in all worlds; the thresholds must still be where they are replaced."""
    for count in (1, 64):
        config = settings(bake__worlds=count, arrangement__max_objects=2)
        pipeline = physics.make_pipeline(config.physics, build.build_model(config, catalog(CUBE), device).model)
        assert pipeline.narrow_phase.split_gjk_mpr == device.is_cuda
    assert {collide._SPLIT_GJK_MPR_LEAN_PAIR_COUNT_THRESHOLD, collide._SPLIT_GJK_MPR_FULL_PAIR_COUNT_THRESHOLD} == {0}
