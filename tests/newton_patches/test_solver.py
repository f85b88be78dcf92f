"""Fused solver: results are bitwise identical to those of Newton's separate kernels. Broad phase: the same contacts as with Newton's, from
fewer pairs; narrow phase: which kernels are compiled."""

import subprocess
import sys
from functools import cache, partial
from types import SimpleNamespace

import newton
import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from newton._src.sim import collide
from newton._src.solvers.steel import solver_steel as steel
from newton._src.solvers.steel.kernels import accumulate_propagation_warmstart_body_impulses_ordered

from synpick_warp.codes import Phase
from synpick_warp.configs.schema import Config
from synpick_warp.kernels.newton_patches import broad_phase as kernels
from synpick_warp.kernels.newton_patches import contact_sweep, world_order
from synpick_warp.kernels.newton_patches.warm_start import apply_warm_start_kernel
from synpick_warp.newton_patches import broad_phase
from synpick_warp.newton_patches import solver as fused_solver
from synpick_warp.newton_patches.narrow_phase import BLOCK
from synpick_warp.scenes import build
from synpick_warp.stages.sim import physics
from synpick_warp.stages.sim.simulate import Simulation
from tests.harness.probe import probe
from tests.worlds.small_worlds import COARSE, CUBE, catalog, place_cubes, settings

TICKS = 30
ARCHITECTURE, BODIES, ROWS, GRIPPER_ROWS, MOST_BODIES = 90, 5, 96, 256, 253
"""Compile-time constants of the kernel under test: CUDA compute capability, capacities of a small world, the gripper's, and bodies of a
world of the most objects."""
KNOWN = {
    "_propagation_colored": True,
    "_row_schedule": "interleaved",
    "_friction_mode": "fixed_normal",
    "_contact_compliance": False,
    "_regularization_enabled": False,
    "_contact_torsion_enabled": False,
    "_has_drive_rows": False,
    "_enable_joint_velocity_limits": False,
    "_propagation_cached_warps": {},
    "_propagation_tree_sizes": [4],
    "_internal_row_phases": lambda: (True, False),
}
"""Private attributes of a solver whose options the fused kernel supports."""
NEWTONS_FRICTION = (
    steel.FRICTION_PAIR_CUDA
    + """
    const auto solve_friction = [&](
        float scale, float largest, float smallest, float axis0, float axis1,
        float residual0, float residual1, float old0, float old1, float radius, float relaxation, float& new0, float& new1) {
        const float2 pair = friction_pair_solve(
            scale, largest, smallest, axis0, axis1, residual0, residual1, old0, old1, radius, relaxation);
        const float magnitude = sqrtf(pair.x * pair.x + pair.y * pair.y);
        const float shrink = magnitude > radius ? radius / magnitude : 1.0f;
        new0 = pair.x * shrink;
        new1 = pair.y * shrink;
    };
"""
)
"""The function of `friction.SOLVE_FRICTION` with the solver's arithmetic."""


def sizes_of(rows: int, bodies: int) -> dict[str, object]:
    """Private attributes of a solver of worlds of `bodies` bodies, two of which are the gripper's, with `rows` contact rows."""
    free = build.FREE_DOFS * (bodies - 2)
    return {
        "_propagation_max_constraints": rows,
        "_max_propagation_bodies": bodies,
        "_articulation_constraint_max": GRIPPER_ROWS,
        "_mf_meta_packed": np.zeros((1, 4 * free)),
        "_max_world_dofs": free + 4,
    }


def test_the_installed_version_of_newton_is_fused():
    assert newton.__version__ == fused_solver.KNOWN_NEWTON


@pytest.mark.parametrize(
    ("rows", "bodies", "stages_rows"), [(ROWS, BODIES, True), pytest.param(3 * 5384, MOST_BODIES, False, marks=pytest.mark.slow)]
)
def test_the_kernel_of_the_iterations_compiles(tmp_path, rows, bodies, stages_rows):
    """Its calls match the signatures of the solver's device functions, and the assembler, which knows the limit, finds that it fits into
    shared memory, also with 251 brackets. Compilation for a GPU needs none."""
    free_rows, dofs = build.FREE_DOFS * (bodies - 2), build.FREE_DOFS * (bodies - 2) + 4
    joint_rows = steel._get_pgs_solve_mf_gs_kernel(
        GRIPPER_ROWS, free_rows, dofs, ARCHITECTURE, has_dense_velocity_limit_rows=False, shared_metadata=True, row_phases=True
    )
    refresh = steel._get_refresh_propagation_tree_body_qd_warp_kernel(4, 2, ARCHITECTURE)
    contacts = fused_solver.compose_contacts(rows, bodies, stages_rows)
    propagate = steel._get_propagate_tree_impulses_revolute_kernel(4, 2, ARCHITECTURE, has_free_root=True)
    kernel = fused_solver.compose_kernel(joint_rows, refresh, contacts, propagate)
    wp.compile_aot_module(kernel.module, arch=ARCHITECTURE, module_dir=tmp_path, use_ptx=False)
    (program,) = tmp_path.glob("*.cubin")
    assert b"solver_iterations_kernel" in program.read_bytes()


def test_more_rows_than_fit_into_shared_memory_lie_in_global_memory():
    """Known: 8 bytes a row, and 57 a body, of 48 KB: 3,072 rows and 32 objects fit, 251 objects do not, nor do more rows."""
    with pytest.raises(ValueError, match="4,096 contact rows"):
        fused_solver.compose_contacts(4096, BODIES)
    for rows, bodies, shared in (
        (1536, 26, True),
        (3072, 34, True),
        (3072, MOST_BODIES, False),
        (4096, 34, False),
        (16152, MOST_BODIES, False),
    ):
        solver = SimpleNamespace(**KNOWN | sizes_of(rows, bodies))
        assert fused_solver.keeps_rows_shared(solver) is shared
        assert fused_solver.find_unsupported(solver) == []
    assert fused_solver.find_unsupported(SimpleNamespace(**KNOWN | sizes_of(3072, 504))) == ["too many bodies for shared memory"]


def test_what_the_kernel_does_not_support_is_found():
    """Each unsupported value of the private attributes that `FusedSteel` checks after construction is reported."""
    others: list[object] = [False, "phased", "bisection", True, True, True, True, True, {4: 1}, [4, 7], lambda: (False, False)]
    known = KNOWN | sizes_of(1536, BODIES)
    assert fused_solver.find_unsupported(SimpleNamespace(**known)) == []
    for name, value in zip(KNOWN, others, strict=True):
        assert len(fused_solver.find_unsupported(SimpleNamespace(**known | {name: value}))) == 1


def test_a_solver_with_the_settings_of_a_gpu_differs_by_the_device_alone(monkeypatch):
    """The private attributes that `FusedSteel` reads exist, and its arrays of rows and bodies match the types of the kernel's structs."""
    choose = physics._sweep
    monkeypatch.setattr(physics, "_sweep", lambda settings, slots, _: choose(settings, slots, True))
    monkeypatch.setattr(physics, "choose_solver", lambda _: fused_solver.FusedSteel)
    config = settings(bake__worlds=3, arrangement__max_objects=2)
    with pytest.warns(newton.NewtonWarning, match="colored"):
        solver = place_cubes(config, wp.get_device("cpu"), np.tile((0.1, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0), (3, 1))).solver
    assert fused_solver.find_unsupported(solver) == ["solve_mode"]
    bodies, rows = solver._bodies(), solver._joint_rows(solver._rhs)
    assert bodies.free_bodies.shape == bodies.free_body_dofs.shape == (3, solver._free_rigid_body_count // 3)
    assert (np.diff(bodies.free_body_dofs.numpy(), axis=1) == build.FREE_DOFS).all()
    assert rows.world_constraint_count.shape == rows.mf_contact_rows_end.shape == (3,)


def test_a_cpu_and_other_versions_run_the_solver_of_newton(monkeypatch):
    gpu = SimpleNamespace(is_cuda=True)
    assert fused_solver.choose_solver(gpu) is fused_solver.FusedSteel
    assert fused_solver.choose_solver(SimpleNamespace(is_cuda=False)) is newton.solvers.SolverSteel
    monkeypatch.setattr(newton, "__version__", "1.8.1")
    assert fused_solver.choose_solver(gpu) is newton.solvers.SolverSteel


def test_warps_grow_smaller_patches_unless_the_kernels_are_loaded(monkeypatch):
    patches = sys.modules[steel._FrictionPatchState.__module__]
    for loaded, limit in (({"cpu": object()}, 32), ({}, fused_solver.PATCH_WARP_CONTACTS)):
        monkeypatch.setattr(patches, "_FLOOD_MIN_CONTACTS", 32)
        monkeypatch.setattr(patches._build.module, "execs", loaded)
        fused_solver.share_patches()
        assert limit == patches._FLOOD_MIN_CONTACTS


def test_warm_start_sums_impulses_as_newton_does(device):
    """Random rows between bodies of a world and with static bodies (-1), some without an impulse; bodies are listed in any order."""
    random = np.random.default_rng(4)
    worlds, bodies, rows = 3, 7, 64
    count = np.array([rows, 40, 0])
    pairs = (
        np.array([[random.permutation(bodies)[:2] for _ in range(rows)] for _ in range(worlds)]) + bodies * np.arange(worlds)[:, None, None]
    )
    pairs[:, ::5, 1] = -1
    pairs[:, 2::7, 0] = -1
    impulse = random.normal(size=(worlds, rows)) * (random.random((worlds, rows)) > 0.2)
    listed = np.array([random.permutation(bodies) + bodies * world for world in range(worlds)])
    jacobians = random.normal(size=(4, worlds, rows, 6)).astype(np.float32)

    def run(kernel: wp.Kernel, dim: tuple[int, ...], *lists: np.ndarray, last: tuple[int, ...] = ()) -> tuple[np.ndarray, np.ndarray]:
        out = [wp.array(np.linspace(-1.0, 1.0, worlds * bodies * 6).reshape(-1, 6), dtype=float, device=device) for _ in range(2)]
        ints = [
            wp.array(np.ascontiguousarray(values), dtype=int, device=device) for values in (count, *lists, pairs[..., 0], pairs[..., 1])
        ]
        floats = [wp.array(values, dtype=float, device=device) for values in (*jacobians, impulse)]
        inputs = [*ints, *floats, *last]
        if kernel is apply_warm_start_kernel:
            wp.launch_tiled(kernel, dim=dim, inputs=inputs, outputs=out, block_dim=32 if device.is_cuda else 1, device=device)
        else:
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=out, device=device)
        return out[0].numpy(), out[1].numpy()

    expected = run(accumulate_propagation_warmstart_body_impulses_ordered, (worlds, 6), last=(rows,))
    assert not np.array_equal(expected[0], expected[1])
    found = run(apply_warm_start_kernel, (worlds, bodies), np.full(worlds, bodies), listed)
    np.testing.assert_array_equal(found, expected)


def test_worlds_with_the_most_colors_come_first(device):
    """Random numbers of units per color, as the solver's offsets tell them: none, all bins, and more colors than bins."""
    random = np.random.default_rng(5)
    bins, entries = int(world_order.COLOR_BINS), 200
    colors = np.r_[0, bins - 1, bins, entries - 1, random.integers(0, bins, 60)]
    units = np.zeros((len(colors), entries), int)
    for row, count in zip(units, colors, strict=True):
        row[1 : count + 1] = random.integers(1, 9, count)
    offsets = wp.array(units.cumsum(1).ravel(), dtype=int, device=device)
    sizes = wp.zeros(bins, dtype=int, device=device)
    of, places, order = (wp.empty(len(colors), dtype=int, device=device) for _ in range(3))
    options = {"dim": len(colors), "device": device}
    wp.launch(world_order.bin_worlds_kernel, inputs=[offsets, entries], outputs=[sizes, of, places], **options)
    wp.launch(world_order.order_worlds_kernel, inputs=[sizes, of, places], outputs=[order], **options)
    found = order.numpy()
    assert sorted(found) == list(range(len(colors)))
    assert (np.diff(np.minimum(colors, bins - 1)[found]) <= 0).all()


@pytest.mark.parametrize(
    ("worlds", "resident", "max_speed", "shared", "warps"),
    [(8, 8, 0.3, True, 4), (8, 8, 4.0, True, 1), (24, 8, 4.0, True, 4), (24, 0, 4.0, True, 2), (8, 8, 4.0, False, 4)],
)
def test_worlds_move_as_with_the_launches_of_newton(device, monkeypatch, worlds, resident, max_speed, shared, warps):
    """All but the friction rows is bitwise the same, so the solver's are compiled in. Piles fall, rest and are stirred; at the lower speed
    limit, falling bodies have velocity limit rows. Newton does not keep contacts in registers (those of one or two warps are fewer than
    piles have), takes worlds in their order (they are sorted if none is resident), its narrow phase uses larger blocks, and each of its
    friction patches is grown by one thread here. Worlds of many objects have impulses and patch lists in global memory."""
    if not device.is_cuda:
        pytest.skip("on a CPU the solver's own launches run")
    config = settings(
        bake__worlds=worlds, bake__episodes=worlds, bake__mode="move", physics__max_speed=max_speed, physics__deterministic=True
    )
    monkeypatch.setattr(fused_solver, "RESIDENT_WARPS", resident)
    monkeypatch.setattr(fused_solver.FusedSteel, "_sweep_warps", warps)
    if not shared:
        monkeypatch.setattr(fused_solver, "keeps_rows_shared", lambda _: False)
    compose = cache(partial(contact_sweep.compose_contact_sweep, offsets=fused_solver.OFFSETS, friction=NEWTONS_FRICTION))
    monkeypatch.setattr(fused_solver, "compose_contacts", compose)
    found, phases = {}, set()
    for version in (fused_solver.KNOWN_NEWTON, "another"):
        for module in (fused_solver, physics):
            monkeypatch.setattr(module, "KNOWN_NEWTON", version)
        simulation = Simulation(config, catalog(), 2, device)
        simulation.physics.solver._friction_patches.device_flood = version == fused_solver.KNOWN_NEWTON
        found[version] = []
        for _ in range(TICKS):
            simulation.tick()
            found[version].append(simulation.physics.state.joint_q.numpy())
            phases |= set(simulation.state.phase.numpy().tolist())
        solver, narrow_phase = simulation.physics.solver, simulation.physics.pipeline.narrow_phase
        assert isinstance(solver, fused_solver.FusedSteel) == (version != "another")
        assert (narrow_phase.split_convex_block_dim == BLOCK) == (version != "another")
        assert fused_solver.find_unsupported(solver) == []
    fused, launched = found.values()
    np.testing.assert_array_equal(fused, launched)
    assert Phase.ACT in phases


# ---- broad phase ----

WORLDS, FRAMES, STEPS = 3, 4, 6
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
    config = settings(bake__worlds=worlds, bake__episodes=worlds, bake__mode="move", physics__deterministic=True, **COARSE)
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
import gc; gc.disable()
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
