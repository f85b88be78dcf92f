"""Kernel fusion for Newton's SolverSteel: one kernel for all iterations of a substep instead of ten kernels per iteration."""

import contextlib
import ctypes
import inspect
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import cache, cached_property, partial
from typing import Any

import newton
import numpy as np
import warp as wp

from synpick_warp.kernels.newton_patches import contact_rows, contact_sweep, solver_iterations, warm_start, world_order
from synpick_warp.newton_patches import KNOWN_NEWTON
from synpick_warp.newton_patches.friction_patches import sort_by_worlds
from synpick_warp.system.hardware.device import sibling_stream

RESIDENT_WARPS = 10
"""Warps of the iterations that run on a multiprocessor at the same time: 65,536 registers, up to 200 per thread. If more worlds are
simulated, those with the most contact colors start first; otherwise they would finish last, on an idle GPU."""
PATCH_WARP_CONTACTS = 8
"""Number of contacts of two bodies above which a warp grows their friction patches, and not a thread; Newton's is 32. The patches are the
same, in four fifths of the time (2,048 worlds, H200)."""
TREE_BYTES = 2048
"""Shared memory of the functions of the gripper's tree, at most, and of what alignment leaves out: the assembler counts 1,634 bytes."""

SERIAL_BLOCK = 32
"""Block size of those kernels that have a thread for each tree or body, which walks it; Newton's is 256."""
WORD = 4
"""Length of a word [bytes]."""
MAX_SMALL = 4096
"""Length up to which a memset in a CUDA graph is no kernel [bytes], as seen in profiles."""

steel: Any = sys.modules[newton.solvers.SolverSteel.__module__]
"""The solver's module, with the factories of its kernels."""
OFFSETS = int(steel.PROPAGATION_COLOR_TAIL) + 2
"""Color offsets of a world: of up to 512 colors, of contacts without a color, and the number of contacts."""


class FusedSteel(newton.solvers.SolverSteel):
    """SolverSteel with all projected Gauss-Seidel (PGS) iterations of a substep fused into one kernel, one block per world.

    SolverSteel launches ten kernels per iteration: with 16 iterations, 160 of the 364 launches of a substep. Each waits some microseconds
    for the previous one, and longer while a renderer uses the GPU. `solver_iterations` calls the same device functions, except for
    contacts: their sweep keeps them in registers (`contact_sweep`) and solves friction by Newton's method (`friction`). With the solver's
    own friction solve, results are bitwise identical. The warm start uses more threads.

    Supported are models of identical worlds, each with one articulation besides its free bodies, and the options that
    `physics.make_solver` sets. For other models, such as piles without a gripper, SolverSteel's own kernels run.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        """Prepare a solver for a model; arguments as in SolverSteel."""
        share_patches()
        super().__init__(*args, **kwargs)
        self._sides: dict[int, wp.Stream] = {}
        self._serial_kernel_block_dim = SERIAL_BLOCK
        if self.model.device.is_cuda:
            clear_by_kernels(self.model.device)
            if self._friction_anchors_enabled:
                sort_by_worlds(self._friction_patches, self.model)
                self._friction_patches.build = partial(self._build_patches, self._friction_patches.build)

    def _stage1_joint_tau(self, *args: Any, **options: Any) -> None:
        """Compute joint torques, the first of the terms that friction patches do not need; arguments as in SolverSteel."""
        self._kinematics_ready = self._record()
        super()._stage1_joint_tau(*args, **options)

    def _build_patches(self, build: Callable[..., None], *args: Any, **options: Any) -> None:
        """Build the friction patches beside the terms without contacts; arguments of `build` as in Newton."""
        with self._branch(self._kinematics_ready):
            build(*args, **options)

    def _mf_pgs_setup(self, *args: Any, **options: Any) -> None:
        """Compute the free bodies' inverse inertias and rows, the last that responses to impulses need; arguments as in SolverSteel."""
        super()._mf_pgs_setup(*args, **options)
        self._inertias_ready = self._record()

    def _propagation_setup(self, *args: Any, **options: Any) -> None:
        """Compute responses to contact impulses beside the warm start of the other rows; arguments as in SolverSteel."""
        self._velocities_ready = self._record()
        with self._branch(self._inertias_ready):
            super()._propagation_setup(*args, **options)

    def _propagation_refresh_twists(self, *, force: bool) -> None:
        """Compute the twists of bodies from joint velocities; arguments as in SolverSteel."""
        if force and self._velocities_ready is not None:
            wp.get_stream(self.model.device).wait_event(self._velocities_ready)
        super()._propagation_refresh_twists(force=force)

    _side: wp.Stream | None = None
    _inertias_ready: wp.Event | None = None
    _velocities_ready: wp.Event | None = None

    def _record(self) -> wp.Event | None:
        """Event of all launches of this substep so far; None: no branch was opened."""
        return None if self._side is None else wp.get_stream(self.model.device).record_event()

    @contextlib.contextmanager
    def _branch(self, start: wp.Event | None) -> Iterator[None]:
        """Branch of a substep's graph: launches within wait for `start` only, and those after it for all of them; None: no branch."""
        if start is None or self._side is None:
            yield
            return
        main = wp.get_stream(self.model.device)
        self._side.wait_event(start)
        with wp.ScopedStream(self._side, sync_enter=False):
            yield
        main.wait_event(self._side.record_event())

    def open_branch(self, stream: wp.Stream) -> None:
        """Have branches of steps on a CUDA stream run beside it, on the same multiprocessors. Call it before steps on another stream."""
        if stream.cuda_stream not in self._sides:
            self._sides[stream.cuda_stream] = sibling_stream(stream)
        self._side = self._sides[stream.cuda_stream]

    def _launch_propagation_solve(
        self,
        rhs: wp.array,
        propagation_rhs: wp.array,
        iterations: int,
        *,
        regularize: bool,
        freeze_drive_rows: bool = False,
        friction_start_iteration: int = 0,
        iteration_offset: int = 0,
    ) -> None:
        """Run the iterations of a solve; arguments as in SolverSteel."""
        options = {
            "regularize": regularize,
            "freeze_drive_rows": freeze_drive_rows,
            "friction_start_iteration": friction_start_iteration,
            "iteration_offset": iteration_offset,
        }
        if not self._is_fusable:
            super()._launch_propagation_solve(rhs, propagation_rhs, iterations, **options)
            return
        if self._color_unit_meta_stale:
            self._color_unit_meta_stale = False
            self._launch_gather_unit_meta()
        internal_rows, velocity_limits = self._internal_row_phases()
        settings = solver_iterations.IterationSettings()
        settings.iterations, settings.omega = iterations, self.relaxation
        settings.internal_rows, settings.velocity_limits = int(internal_rows), int(velocity_limits)
        for name, value in options.items():
            setattr(settings, name, int(value))
        wp.launch_tiled(
            self._iterations_kernel(),
            dim=[self._world_count],
            inputs=[settings, self._bodies(), self._joint_rows(rhs), self._contact_rows(propagation_rhs), self._order_worlds()],
            outputs=[self._propagation_body_qd, self._propagation_body_impulses, self._v_out],
            block_dim=int(solver_iterations.WARP) * self._sweep_warps,
            device=self.model.device,
        )

    def _launch_gather_unit_meta(self) -> None:
        """Gather the contacts of all worlds in the order of their colors, with their friction operators and rows."""
        super()._launch_gather_unit_meta()
        if not self._is_fusable:
            return
        inputs = [
            OFFSETS,
            self._color_world_offsets,
            self._color_unit_meta,
            self._propagation_J_a,
            self._propagation_J_b,
            self._propagation_MiJt_a,
            self._propagation_MiJt_b,
            self._propagation_eff_mass_inv,
            self._propagation_row_mu,
        ]
        dim = (self._world_count, int(contact_rows.THREADS))
        wp.launch(contact_rows.pack_rows_kernel, dim=dim, inputs=inputs, outputs=[self._packed_rows], device=self.model.device)

    @cached_property
    def _packed_rows(self) -> wp.array:
        """Packed constraint rows (world, row, `ROW`) float32, 128 bytes each; allocated for the maximum number of rows of each world."""
        shape = self._world_count, self._propagation_max_constraints, int(contact_rows.ROW)
        return wp.zeros(shape, dtype=wp.float32, device=self.model.device)

    def _apply_propagation_warmstart_velocity(self) -> None:
        """Warm start: apply the impulses of the last substep to the velocities, with one warp per body instead of a thread a component."""
        if not (self._is_fusable and self._ordered_rows):
            super()._apply_propagation_warmstart_velocity()
            return
        inputs = [
            self._propagation_constraint_count,
            self._propagation_body_count,
            self._propagation_body_list,
            self._propagation_body_a,
            self._propagation_body_b,
            self._propagation_J_a,
            self._propagation_J_b,
            self._propagation_MiJt_a,
            self._propagation_MiJt_b,
            self._propagation_impulses,
        ]
        outputs, device = [self._propagation_body_qd, self._propagation_body_impulses], self.model.device
        dim, block = (self._world_count, self._max_propagation_bodies), int(solver_iterations.WARP)
        wp.launch_tiled(warm_start.apply_warm_start_kernel, dim=dim, inputs=inputs, outputs=outputs, block_dim=block, device=device)
        self._propagation_propagate_impulses()

    @cached_property
    def _sweep_warps(self) -> int:
        """Warps per world: as many as run at the same time for all worlds, 1 to `MAX_WARPS`; with rows in global memory `MAX_WARPS`."""
        fitting = RESIDENT_WARPS * self.model.device.sm_count // self._world_count
        return min(max(fitting, 1), contact_sweep.MAX_WARPS) if keeps_rows_shared(self) else contact_sweep.MAX_WARPS

    @cached_property
    def _is_fusable(self) -> bool:
        """Whether the kernel of the iterations does what the solver does with this model and these options."""
        return not find_unsupported(self)

    def _iterations_kernel(self) -> wp.Kernel:
        """Kernel of the iterations, made of the device functions of the solver's own kernels."""
        size = self._propagation_tree_sizes[0]
        rows, bodies = self._propagation_max_constraints, self._max_propagation_bodies
        sweep_contacts = compose_contacts(rows, bodies, keeps_rows_shared(self), self._sweep_warps)
        return compose_kernel(
            self._pgs_solve_mf_gs_kernel_for_phase(),
            self._propagation_refresh_kernels[size],
            sweep_contacts,
            self._propagation_propagate_kernels[size],
            self._sweep_warps,
        )

    def _order_worlds(self) -> wp.array:
        """Order in which the worlds' iterations start (rank) int32; sorted only if not all are resident at a time."""
        order, bins, places, sizes = self._schedule
        if self._world_count > RESIDENT_WARPS // self._sweep_warps * self.model.device.sm_count:
            options: dict[str, Any] = {"dim": self._world_count, "device": self.model.device}
            sizes.zero_()
            inputs = [self._color_world_offsets, OFFSETS]
            wp.launch(world_order.bin_worlds_kernel, inputs=inputs, outputs=[sizes, bins, places], **options)
            wp.launch(world_order.order_worlds_kernel, inputs=[sizes, bins, places], outputs=[order], **options)
        return order

    @cached_property
    def _schedule(self) -> tuple[wp.array, wp.array, wp.array, wp.array]:
        """Order of worlds; scratch of `_order_worlds`: bin of each world, its place in the bin, and sizes of the bins."""
        worlds, device = self._world_count, self.model.device
        order = wp.array(np.arange(worlds), dtype=wp.int32, device=device)
        bins, places = (wp.empty(worlds, dtype=wp.int32, device=device) for _ in range(2))
        return order, bins, places, wp.zeros(int(world_order.COLOR_BINS), dtype=wp.int32, device=device)

    def _joint_rows(self, rhs: wp.array) -> Any:
        """Struct of the solver's rows in joint space and of free bodies; `rhs`: right-hand sides."""
        return fill(solver_iterations.JointRowData(), self._mf_gs_inputs(rhs))

    def _contact_rows(self, rhs: wp.array) -> Any:
        """Struct of the solver's contact rows with their graph coloring; `rhs`: right-hand sides."""
        return fill(
            solver_iterations.ContactRowData(),
            [
                self._propagation_constraint_count,
                self._propagation_row_parent,
                rhs,
                self._propagation_impulses,
                self._color_world_offsets,
                self._propagation_body_list,
                self._propagation_body_count,
                self._color_unit_meta,
                self._color_unit_friction_setup,
                self._packed_rows,
                self._color_ring_overflow,
                self._color_ring_overflow_cursor,
                self._is_free,
                self.constraint_overflow,
            ],
        )

    def _bodies(self) -> Any:
        """Struct of the grippers' kinematic trees and the free bodies of all worlds."""
        model = self.model
        return fill(
            solver_iterations.BodyData(),
            [
                self._propagation_tree_arts[self._propagation_tree_sizes[0]],
                self._propagation_tree_activity,
                self._art_to_world,
                self._dense_contact_world_flag,
                self._propagation_cache_guard_off,
                model.articulation_start,
                model.joint_parent,
                model.joint_child,
                model.joint_qd_start,
                self._propagation_joint_parent_slot,
                self._propagation_joint_S_flat,
                self._propagation_body_com_rel,
                self._propagation_tree_U,
                self._propagation_tree_D_inv,
                *self._free_bodies,
            ],
        )

    @cached_property
    def _is_free(self) -> wp.array:
        """Mask of the free bodies; the others are links of the gripper (body) bool."""
        free = self._free_bodies[1].numpy()
        return wp.array(np.isin(np.arange(self.model.body_count), free), dtype=wp.bool, device=self.model.device)

    @cached_property
    def _free_bodies(self) -> tuple[wp.array, wp.array]:
        """First degree of freedom and body index of each free body (world, free body) int32."""
        arrays: list[Any] = [self._free_rigid_body_indices, self.model.body_world, self._art_to_world]
        arrays += [self._propagation_tree_arts[self._propagation_tree_sizes[0]], self._articulation_dof_start, self._body_to_articulation]
        free, world_of_body, world_of_tree, tree, first_dof, tree_of_body = (array.numpy() for array in arrays)
        bodies = free.reshape(self._world_count, -1)
        worlds, trees = world_of_body[bodies], world_of_tree[tree]
        if (worlds != np.arange(self._world_count)[:, None]).any() or (trees != np.arange(self._world_count)).any():
            raise ValueError("The worlds of the model are not in order, or differ in their numbers of bodies.")
        dofs = first_dof[tree_of_body[bodies]]
        first, second = (wp.array(values, dtype=wp.int32, device=self.model.device) for values in (dofs, bodies))
        return first, second


def choose_solver(device: wp.Device) -> type[newton.solvers.SolverSteel]:
    """The solver for a device: FusedSteel on a GPU with the version of Newton that it knows, else SolverSteel."""
    return FusedSteel if device.is_cuda and newton.__version__ == KNOWN_NEWTON else newton.solvers.SolverSteel


def share_patches() -> None:
    """Have warps grow more of the friction patches. Newton's kernels contain the limit, so not if they have been loaded before."""
    patches: Any = sys.modules[steel._FrictionPatchState.__module__]
    if not patches._build.module.execs:
        patches._FLOOD_MIN_CONTACTS = PATCH_WARP_CONTACTS


def clear_by_kernels(device: Any) -> None:
    """Have `zero_` of a GPU's arrays clear up to `MAX_SMALL` bytes by a kernel, in any thread.

    CUDA turns longer memsets of a graph into kernels itself. Shorter ones are commands of another kind, before and after which a graph
    waits: 19 of them take 100 us of a substep of 48 worlds on an H200.
    """
    memset, zero = device.memset, ctypes.pointer(ctypes.c_int32(0))

    def clear(pointer: int, value: int, size: int) -> None:
        if value == 0 and size <= MAX_SMALL and size % WORD == 0 and pointer % WORD == 0:
            device.memtile(pointer, zero, WORD, size // WORD)
        else:
            memset(pointer, value, size)

    if memset.__name__ != clear.__name__:
        device.memset = clear


def find_unsupported(solver: Any) -> list[str]:
    """Names of the options of a SolverSteel, and properties of its model, that the fused kernel does not support; empty: it can be used."""
    unsupported = {
        "solve_mode": not solver._propagation_colored,
        "row_schedule": solver._row_schedule != "interleaved",
        "friction_mode": solver._friction_mode != "fixed_normal",
        "contact_compliance": solver._contact_compliance,
        "contact_regularization": solver._regularization_enabled,
        "contact torsion": solver._contact_torsion_enabled,
        "drive_mode": solver._has_drive_rows,
        "enable_joint_velocity_limits": solver._enable_joint_velocity_limits,
        "propagation_cached_response": bool(solver._propagation_cached_warps),
        "no articulation, or several kinds": len(solver._propagation_tree_sizes) != 1,
        "too many bodies for shared memory": not _fits(solver, False),
        # Without limits the solver skips the gripper's pass in worlds without contacts in generalized coordinates; the kernel does not.
        "neither joint limits nor speed limits": not any(solver._internal_row_phases()),
    }
    return [name for name, is_unsupported in unsupported.items() if is_unsupported]


def keeps_rows_shared(solver: Any) -> bool:
    """Whether impulses of a SolverSteel's contact rows, and its patch lists, fit into shared memory beside all else."""
    return solver._propagation_max_constraints <= contact_sweep.MAX_SHARED_ROWS and _fits(solver, True)


def _fits(solver: Any, stages: bool) -> bool:
    """Whether the kernel of the iterations fits into the static shared memory of a block, with or without impulses and patch lists."""
    contacts = contact_sweep.shared_bytes(solver._propagation_max_constraints, solver._max_propagation_bodies, stages)
    rows, bodies_rows, dofs = solver._articulation_constraint_max, solver._mf_meta_packed.shape[1] // 4, solver._max_world_dofs
    options = {"has_drive_rows": False, "fuse_vel_limits": False}
    resident = steel._mfgs_metadata_bytes(rows, **options) <= steel._MFGS_RESIDENT_METADATA_MAX_BYTES
    joints = steel._mfgs_block_shared_bytes(rows, bodies_rows, dofs, shared_metadata=resident, **options)
    return contacts + joints + TREE_BYTES <= steel._STATIC_SHARED_MEMORY_BYTES


def fill(struct: Any, values: Iterable[wp.array | None]) -> Any:
    """Assign `values` to the fields of a struct in their order, None for an empty array; returns the struct."""
    for name, value in zip(struct._cls.vars, values, strict=True):
        setattr(struct, name, value)
    return struct


@cache
def compose_kernel(
    rows: wp.Kernel, refresh: wp.Kernel, contacts: wp.Function, propagation: wp.Kernel, warps: int = contact_sweep.MAX_WARPS
) -> wp.Kernel:
    """Kernel of the iterations from the sweep over contacts by `warps` a block, and kernels of the solver, each of which calls one device
    function."""
    return solver_iterations.compose_iterations(
        solver_iterations.bind_row_sweep(device_function(rows)),
        solver_iterations.bind_tree_refresh(device_function(refresh)),
        contacts,
        solver_iterations.bind_propagation(device_function(propagation)),
        warps,
    )


@cache
def compose_contacts(rows: int, bodies: int, stages_rows: bool = True, warps: int = contact_sweep.MAX_WARPS) -> wp.Function:
    """Device function of the contact sweep, with the color offsets of SolverSteel; arguments as in `compose_contact_sweep`."""
    return contact_sweep.compose_contact_sweep(rows, bodies, OFFSETS, stages_rows=stages_rows, warps=warps)


def device_function(kernel: wp.Kernel) -> wp.Function:
    """Device function that a kernel of the solver wraps."""
    (function,) = (value for value in inspect.getclosurevars(kernel.func).nonlocals.values() if isinstance(value, wp.Function))
    return function
