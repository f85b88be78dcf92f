"""Warm start of the contact solver: the impulses of the last substep as a first guess, and the velocities that follow from them."""

import warp as wp

wp.set_module_options({"enable_backward": False})

TWIST = wp.constant(6)
"""Components of a twist."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ballot_sync(~0u, value);
#else
    return value ? 1u : 0u;
#endif
""")
def ballot(value: bool) -> wp.uint32:
    """Warp vote (ballot): bit mask of the lanes whose `value` is true. On the CPU a warp has one lane."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return 0;
#endif
""")
def first_lane(bits: wp.uint32) -> int:
    """Index of the lowest set bit of a ballot that is not 0."""
    ...


@wp.kernel
def apply_warm_start_kernel(
    # State:
    row_count: wp.array[int],  # (world)
    body_count: wp.array[int],  # (world)
    body_list: wp.array2d[int],  # (world, slot)
    body_a: wp.array2d[int],  # (world, row)
    body_b: wp.array2d[int],  # (world, row)
    jacobian_a: wp.array3d[float],  # (world, row, 6) [1, m]
    jacobian_b: wp.array3d[float],  # (world, row, 6) [1, m]
    response_a: wp.array3d[float],  # (world, row, 6) [1/kg, 1/(kg m)]
    response_b: wp.array3d[float],  # (world, row, 6) [1/kg, 1/(kg m)]
    impulse: wp.array2d[float],  # (world, row) [N s]
    twist_inout: wp.array2d[float],  # (body, 6) [m/s, rad/s]
    body_impulse_inout: wp.array2d[float],  # (body, 6) [N s, N m s]
):
    """Warm start: add the impulses λ of the last substep to the bodies, M⁻¹Jᵀλ of their rows to `twist_inout`, Jᵀλ to `body_impulse_inout`.

    Launched over world, body with contacts, twist component; each thread sums its rows in their order. SolverSteel has one thread for each
    world and component, which walks all rows and waits for each sum. Both sum in the same order, so that results are bitwise identical.
    """
    world, slot, axis = wp.tid()
    if slot >= body_count[world]:
        return
    body = body_list[world, slot]
    velocity = twist_inout[body, axis]
    total = body_impulse_inout[body, axis]
    for row in range(wp.min(row_count[world], impulse.shape[1])):
        strength = impulse[world, row]
        a = body_a[world, row]
        b = body_b[world, row]
        if strength != 0.0:
            if a == body:
                velocity = velocity + response_a[world, row, axis] * strength
                total = total + jacobian_a[world, row, axis] * strength
            if b == body:
                velocity = velocity + response_b[world, row, axis] * strength
                total = total + jacobian_b[world, row, axis] * strength
    twist_inout[body, axis] = velocity
    body_impulse_inout[body, axis] = total


@wp.kernel(enable_backward=False, module="unique")
def apply_warm_start_of_many_kernel(
    # State:
    row_count: wp.array[int],  # (world)
    body_count: wp.array[int],  # (world)
    body_list: wp.array2d[int],  # (world, slot)
    body_a: wp.array2d[int],  # (world, row)
    body_b: wp.array2d[int],  # (world, row)
    jacobian_a: wp.array3d[float],  # (world, row, 6) [1, m]
    jacobian_b: wp.array3d[float],  # (world, row, 6) [1, m]
    response_a: wp.array3d[float],  # (world, row, 6) [1/kg, 1/(kg m)]
    response_b: wp.array3d[float],  # (world, row, 6) [1/kg, 1/(kg m)]
    impulse: wp.array2d[float],  # (world, row) [N s]
    twist_inout: wp.array2d[float],  # (body, 6) [m/s, rad/s]
    body_impulse_inout: wp.array2d[float],  # (body, 6) [N s, N m s]
):
    """Warm start of worlds of many rows: as `apply_warm_start_kernel`, bit by bit, with a warp a body that votes on 32 rows at a time.

    Launched over world, body with contacts, lane: a block of one warp for each body, on a CPU of one thread.
    """
    world, slot, lane = wp.tid()
    if slot >= body_count[world]:
        return
    body = body_list[world, slot]
    count = wp.min(row_count[world], impulse.shape[1])
    for start in range(0, count, wp.block_dim()):
        mine = start + lane
        touches = bool(False)
        if mine < count:
            touches = impulse[world, mine] != 0.0 and (body_a[world, mine] == body or body_b[world, mine] == body)
        touching = ballot(touches)
        while touching != wp.uint32(0):
            row = start + first_lane(touching)
            touching = touching & (touching - wp.uint32(1))
            strength = impulse[world, row]
            for axis in range(lane, TWIST, wp.block_dim()):
                if body_a[world, row] == body:
                    twist_inout[body, axis] = twist_inout[body, axis] + response_a[world, row, axis] * strength
                    body_impulse_inout[body, axis] = body_impulse_inout[body, axis] + jacobian_a[world, row, axis] * strength
                if body_b[world, row] == body:
                    twist_inout[body, axis] = twist_inout[body, axis] + response_b[world, row, axis] * strength
                    body_impulse_inout[body, axis] = body_impulse_inout[body, axis] + jacobian_b[world, row, axis] * strength
