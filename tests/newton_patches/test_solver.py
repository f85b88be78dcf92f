"""Fused solver: results are bitwise identical to those of Newton's separate kernels."""

from __future__ import annotations

import sys
from functools import cache, partial
from types import SimpleNamespace

import newton
import numpy as np
import pytest
import warp as wp
from newton._src.solvers.steel import solver_steel as steel
from newton._src.solvers.steel.kernels import accumulate_propagation_warmstart_body_impulses_ordered

from synpick_warp.codes import Phase
from synpick_warp.kernels.newton_patches import contact_sweep, world_order
from synpick_warp.kernels.newton_patches.warm_start import apply_warm_start_kernel, apply_warm_start_of_many_kernel
from synpick_warp.newton_patches import solver as fused_solver
from synpick_warp.newton_patches.narrow_phase import BLOCK
from synpick_warp.scenes import build
from synpick_warp.stages.sim import physics
from synpick_warp.stages.sim.simulate import Simulation
from tests.worlds.small_worlds import catalog, place_cubes, settings

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
    kernel = fused_solver.compose_kernel(joint_rows, refresh, contacts, propagate, 1 if stages_rows else contact_sweep.WARPS_OF_MANY)
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
        if kernel is apply_warm_start_of_many_kernel:
            wp.launch_tiled(kernel, dim=dim, inputs=inputs, outputs=out, block_dim=32 if device.is_cuda else 1, device=device)
        else:
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=out, device=device)
        return out[0].numpy(), out[1].numpy()

    expected = run(accumulate_propagation_warmstart_body_impulses_ordered, (worlds, 6), last=(rows,))
    assert not np.array_equal(expected[0], expected[1])
    for kernel, dim in ((apply_warm_start_kernel, (worlds, bodies, 6)), (apply_warm_start_of_many_kernel, (worlds, bodies))):
        np.testing.assert_array_equal(run(kernel, dim, np.full(worlds, bodies), listed), expected)


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
    ("worlds", "resident", "max_speed", "shared"),
    [(8, 8, 0.3, True), (8, 8, 4.0, True), (24, 8, 4.0, True), (24, 0, 4.0, True), (8, 8, 4.0, False)],
)
def test_worlds_move_as_with_the_launches_of_newton(device, monkeypatch, worlds, resident, max_speed, shared):
    """All but the friction rows is bitwise the same, so the solver's are compiled in. Piles fall, rest and are stirred; at the lower speed
    limit, falling bodies have velocity limit rows. Newton does not load 32 contacts at a time, takes worlds in their order (they are sorted
    if none is resident), its narrow phase uses larger blocks, and each of its friction patches is grown by one thread here. Worlds of many
    objects have impulses and patch lists in global memory, several warps, and a warm start by votes."""
    if not device.is_cuda:
        pytest.skip("on a CPU the solver's own launches run")
    config = settings(
        bake__worlds=worlds, bake__episodes=worlds, bake__mode="move", physics__max_speed=max_speed, physics__deterministic=True
    )
    monkeypatch.setattr(fused_solver, "RESIDENT_WORLDS", resident)
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
