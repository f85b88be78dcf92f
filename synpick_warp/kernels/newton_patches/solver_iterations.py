"""Fused projected Gauss-Seidel (PGS) solver: one kernel runs all iterations of Newton's SolverSteel, with one warp per world.

The device functions of an iteration are the solver's own, and `newton_patches.solver` passes them in. This module has the arrays that
they share, under the names of their parameters, and calls them in the order in which the solver launches them. Frames and units are the
solver's; twists are at centers of mass.
"""

import warp as wp

from synpick_warp.kernels.newton_patches.broad_phase import synchronize_block

wp.set_module_options({"enable_backward": False})

# Threads of a warp. A block owns one world: it is one warp, so that a barrier of the warp orders the functions of an iteration, or several
# that sweep contacts, the first of which does all else.
WARP = wp.constant(32)
# Components of a twist: linear and angular velocity.
TWIST = wp.constant(6)
# Values of the solver's `row_phase`: the rows that a sweep over joint rows visits.
INTERNAL_ROWS = wp.constant(3)
CONTACT_ROWS = wp.constant(4)
VELOCITY_LIMITS = wp.constant(5)


@wp.struct
class JointRowData:
    """Constraint rows that are solved in generalized coordinates: joint limits of the gripper (`world_...`) and free bodies (`mf_...`).

    Members are arrays of SolverSteel under the names of its parameters: number and type of rows, Jacobians J, responses Y = M⁻¹Jᵀ,
    right-hand sides, impulses and friction coefficients. `mf` is matrix-free: rows of free bodies, first contacts, up to
    `mf_contact_rows_end` (none here), then speed limits. Counts are (world), other arrays (world, row); J and Y are (world, row, dof),
    those of free bodies (world, row, 6). Suffixes a, b: the bodies of a row.
    """

    world_constraint_count: wp.array[int]
    world_dof_indices: wp.array2d[int]
    rhs_bias: wp.array2d[float]
    world_diag: wp.array2d[float]
    world_impulses: wp.array2d[float]
    J_world: wp.array3d[float]
    Y_world: wp.array3d[float]
    world_row_type: wp.array2d[int]
    world_row_parent: wp.array2d[int]
    world_row_mu: wp.array2d[float]
    world_drive_target_vel_bias: wp.array2d[float]
    world_drive_vel_multiplier: wp.array2d[float]
    world_drive_impulse_multiplier: wp.array2d[float]
    world_drive_max_impulse: wp.array2d[float]
    world_drive_vel_limit: wp.array2d[float]
    mf_constraint_count: wp.array[int]
    mf_contact_rows_end: wp.array[int]
    mf_meta: wp.array2d[int]
    mf_impulses: wp.array2d[float]
    mf_J_a: wp.array3d[float]
    mf_J_b: wp.array3d[float]
    mf_MiJt_a: wp.array3d[float]
    mf_MiJt_b: wp.array3d[float]
    mf_row_mu: wp.array2d[float]
    world_row_w: wp.array2d[float]
    mf_row_w: wp.array2d[float]
    world_torsion_group: wp.array2d[int]
    torsion_row_radius: wp.array2d[float]
    compliance_dense_gamma: wp.array2d[float]
    compliance_mf_gamma: wp.array2d[float]


@wp.struct
class ContactRowData:
    """Contacts in the order of their graph coloring, and the constraint rows, impulses and friction operators of these contacts.

    A contact has a normal row and friction rows. Contacts of one color share no body. Arrays are flat over all worlds, each of which has
    capacity for as many contacts as rows.
    """

    row_count: wp.array[int]
    """Rows of each world (world)."""
    row_parent: wp.array2d[int]
    """Of a normal row, the next one of its friction patch (world, row)."""
    rhs: wp.array2d[float]
    """Right-hand sides (world, row) [m/s]."""
    impulse: wp.array2d[float]
    """Impulses (world, row) [N s]."""
    color_offsets: wp.array[int]
    """First contact of each color (world, color); see `compose_contact_sweep`."""
    bodies: wp.array2d[int]
    """Bodies with contacts (world, slot)."""
    body_count: wp.array[int]
    """Number of bodies with contacts (world)."""
    records: wp.array[int]
    """Rows, bodies and friction patch of each contact (world, contact, `contact_rows.RECORD`)."""
    friction_operator: wp.array[float]
    """Friction operator of each contact (world, contact, `friction.FRICTION_OPERATOR`)."""
    rows: wp.array3d[float]
    """Packed constraint rows (world, row, `contact_rows.ROW`), see `pack_rows_kernel`."""
    patch_lists: wp.array[int]
    """Rows of patches with more members than a record has (world, row)."""
    patch_list_length: wp.array[int]
    """Number of words used in `patch_lists` (world)."""
    is_free: wp.array[bool]
    """Mask of the free bodies; the others are links of the gripper (body)."""
    overflow: wp.array[bool]
    """Whether a world lost contacts (world)."""


@wp.struct
class BodyData:
    """Kinematic trees of the grippers, with the factors of the articulated-body algorithm (Featherstone, 2008), and indices of free bodies.

    Members are arrays of SolverSteel under the names of its parameters. Every world has one articulation (tree of joints), its gripper,
    with factors S, U and D⁻¹. Arrays are (articulation), (world), (joint), (dof) or (body), as their names say.
    """

    group_to_art: wp.array[int]
    articulation_active: wp.array[int]
    art_to_world: wp.array[int]
    dense_contact_world_flag: wp.array[int]
    cache_world_flag: wp.array[int]
    articulation_start: wp.array[int]
    joint_parent: wp.array[int]
    joint_child: wp.array[int]
    joint_qd_start: wp.array[int]
    joint_parent_slot: wp.array[int]
    propagation_joint_S_flat: wp.array2d[float]
    propagation_body_com_rel: wp.array2d[float]
    propagation_tree_U: wp.array2d[float]
    propagation_tree_D_inv: wp.array3d[float]
    free_body_dofs: wp.array2d[int]
    """First degree of freedom of each free body (world, free body)."""
    free_bodies: wp.array2d[int]
    """Body index of each free body (world, free body)."""


@wp.struct
class IterationSettings:
    """Settings of the projected Gauss-Seidel solver: iterations, relaxation factor `omega`, and switches (1: on); those without a
    description are as in SolverSteel.
    """

    iterations: int
    omega: float
    regularize: int
    freeze_drive_rows: int
    friction_start_iteration: int
    iteration_offset: int
    internal_rows: int
    """1: the gripper has joint limits."""
    velocity_limits: int
    """1: free bodies have speed limits; limits of joint velocities are not supported."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
""")
def synchronize_warp():
    """Barrier of the threads of a warp: each sees what the others have written to memory."""
    ...


@wp.func
def is_any(thread: int) -> bool:
    """True: all threads of a block are of its first warp."""
    return True


@wp.func
def is_of_first_warp(thread: int) -> bool:
    """Whether a thread of a block is of its first warp."""
    return thread < WARP


@wp.func
def load_free_twists(world: int, lane: int, bodies: BodyData, v: wp.array[float], twist_inout: wp.array2d[float]):
    """Copy the velocities of the free bodies of a world from generalized velocities to twists, by one warp."""
    for element in range(lane, bodies.free_bodies.shape[1] * TWIST, WARP):
        free = element // TWIST
        axis = element - TWIST * free
        twist_inout[bodies.free_bodies[world, free], axis] = v[bodies.free_body_dofs[world, free] + axis]


@wp.func
def store_free_twists(
    world: int, lane: int, bodies: BodyData, twist: wp.array2d[float], impulse_inout: wp.array2d[float], v_inout: wp.array[float]
):
    """Copy the twists of the free bodies of a world to generalized velocities, and set the impulses of these bodies to 0, by one warp."""
    for element in range(lane, bodies.free_bodies.shape[1] * TWIST, WARP):
        free = element // TWIST
        axis = element - TWIST * free
        body = bodies.free_bodies[world, free]
        v_inout[bodies.free_body_dofs[world, free] + axis] = twist[body, axis]
        impulse_inout[body, axis] = 0.0


def bind_row_sweep(function: wp.Function) -> wp.Function:
    """Wrap the solver's Gauss-Seidel sweep in a device function that takes the structs of this module, and return that function.

    The row phase (INTERNAL_ROWS, CONTACT_ROWS or VELOCITY_LIMITS) selects the rows of `JointRowData` that a sweep solves.
    """

    @wp.func
    def sweep_rows(world: int, row_phase: int, iteration: int, settings: IterationSettings, rows: JointRowData, v_inout: wp.array[float]):
        """One Gauss-Seidel sweep over the rows of a world in a row phase: updates impulses, and the generalized velocities `v_inout`."""
        function(
            world, rows.world_constraint_count, rows.world_dof_indices, rows.rhs_bias, rows.world_diag, rows.world_impulses,
            rows.J_world, rows.Y_world, rows.world_row_type, rows.world_row_parent, rows.world_row_mu, rows.world_drive_target_vel_bias,
            rows.world_drive_vel_multiplier, rows.world_drive_impulse_multiplier, rows.world_drive_max_impulse, rows.world_drive_vel_limit,
            rows.mf_constraint_count, rows.mf_contact_rows_end, rows.mf_meta, rows.mf_impulses, rows.mf_J_a, rows.mf_J_b, rows.mf_MiJt_a,
            rows.mf_MiJt_b, rows.mf_row_mu, rows.world_row_w, rows.mf_row_w, rows.world_torsion_group, rows.torsion_row_radius,
            rows.compliance_dense_gamma, rows.compliance_mf_gamma, 1, settings.omega, settings.regularize, settings.freeze_drive_rows,
            row_phase, settings.friction_start_iteration, iteration, v_inout,
        )  # fmt: skip
        synchronize_warp()

    return sweep_rows


def bind_tree_refresh(function: wp.Function) -> wp.Function:
    """Adapt the solver's forward kinematics of velocities to this module: returns a device function that takes its structs."""

    @wp.func
    def refresh_tree(world: int, bodies: BodyData, v: wp.array[float], twist_inout: wp.array2d[float]):
        """Forward kinematics of velocities: write the twists of a gripper's bodies from its joint velocities `v`."""
        function(
            world, bodies.group_to_art, bodies.articulation_active, bodies.art_to_world, bodies.dense_contact_world_flag, 1,
            bodies.articulation_start, bodies.joint_parent, bodies.joint_child, bodies.joint_qd_start, bodies.joint_parent_slot,
            bodies.propagation_joint_S_flat, bodies.propagation_body_com_rel, v, twist_inout,
        )  # fmt: skip

    return refresh_tree


def bind_propagation(function: wp.Function) -> wp.Function:
    """Wrap the solver's articulated-body algorithm (Featherstone, 2008) in a device function of these structs, which is returned."""

    @wp.func
    def propagate(world: int, bodies: BodyData, impulse_inout: wp.array2d[float], twist_inout: wp.array2d[float], v_inout: wp.array[float]):
        """Articulated-body algorithm: update joint velocities and twists by the impulses on a gripper's bodies, and clear these."""
        function(
            world, bodies.group_to_art, bodies.articulation_active, bodies.art_to_world, bodies.cache_world_flag,
            bodies.articulation_start, bodies.joint_parent, bodies.joint_child, bodies.joint_qd_start, bodies.joint_parent_slot,
            bodies.propagation_joint_S_flat, bodies.propagation_body_com_rel, bodies.propagation_tree_U, bodies.propagation_tree_D_inv,
            impulse_inout, twist_inout, v_inout,
        )  # fmt: skip

    return propagate


def compose_iterations(
    sweep_rows: wp.Function, refresh_tree: wp.Function, sweep_contacts: wp.Function, propagate: wp.Function, warps: int
) -> wp.Kernel:
    """Create the kernel of the iterations from the device functions of the solver, wrapped by those above, for blocks of `warps`."""
    leads, synchronize = (is_any, synchronize_warp) if warps == 1 else (is_of_first_warp, synchronize_block)

    @wp.kernel(enable_backward=False, module="unique")
    def solver_iterations_kernel(
        # Scene:
        settings: IterationSettings,
        bodies: BodyData,
        # State:
        rows: JointRowData,
        contacts: ContactRowData,
        # In:
        order: wp.array[int],  # (rank)
        # Out:
        twist_inout: wp.array2d[float],  # (body, 6) [m/s, rad/s]
        impulse_inout: wp.array2d[float],  # (body, 6) [N s, N m s]
        v_inout: wp.array[float],  # (dof) [m/s, rad/s]
    ):
        """Run all projected Gauss-Seidel (PGS) iterations of a substep: `v_inout` and `twist_inout` receive the solved velocities.

        An iteration sweeps joint limits, contacts in generalized coordinates, colored contacts, the response of the gripper to these, and
        speed limits; sweeps without rows are skipped. Velocities of free bodies exist twice: in `v`, generalized velocities, and as twists.
        They are copied between the two in every iteration if a sweep over `v` can change them, otherwise before the first and after the
        last one. If contacts are the only rows, and none involves the gripper, one call of `sweep_contacts` runs all iterations, as the
        gripper's velocities stay constant. `impulse_inout` ends as 0. Launched over rank, thread of a block: one block per world, worlds
        in `order`.
        """
        rank, lane = wp.tid()
        world = order[rank]
        has_limits = settings.internal_rows != 0 and rows.world_constraint_count[world] > 0
        free_contacts = rows.mf_contact_rows_end[world]
        has_contacts = bodies.dense_contact_world_flag[world] != 0 or free_contacts > 0
        has_velocity_limits = settings.velocity_limits != 0 and rows.mf_constraint_count[world] > free_contacts
        is_alone = not (has_limits or has_contacts or has_velocity_limits)
        step = int(0)
        while step < settings.iterations:
            iteration = settings.iteration_offset + step
            if leads(lane):
                if has_limits:
                    sweep_rows(world, INTERNAL_ROWS, iteration, settings, rows, v_inout)
                if has_contacts:
                    sweep_rows(world, CONTACT_ROWS, iteration, settings, rows, v_inout)
                refresh_tree(world, bodies, v_inout, twist_inout)
                if step == 0 or has_contacts or has_velocity_limits:
                    load_free_twists(world, lane, bodies, v_inout, twist_inout)
            synchronize()
            step += sweep_contacts(world, iteration, is_alone, settings, contacts, twist_inout, impulse_inout)
            synchronize()
            if leads(lane):
                propagate(world, bodies, impulse_inout, twist_inout, v_inout)
                if step == settings.iterations or has_contacts or has_velocity_limits:
                    store_free_twists(world, lane, bodies, twist_inout, impulse_inout, v_inout)
                synchronize_warp()
                if has_velocity_limits:
                    sweep_rows(world, VELOCITY_LIMITS, iteration, settings, rows, v_inout)

    return solver_iterations_kernel
