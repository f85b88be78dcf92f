"""Warm start of the contact solver: the impulses of the last substep as a first guess, and the velocities that follow from them."""

import warp as wp

wp.set_module_options({"enable_backward": False})

TWIST = wp.constant(6)
"""Components of a twist."""
BATCH = wp.constant(4)
"""Number of rows of a body whose loads are in flight together."""


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


@wp.kernel(enable_backward=False, module="unique")
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

    Launched over world, body with contacts, lane: a block of one warp for each body, on a CPU of one thread. The lanes vote on 32 rows at a
    time, and each of the first six sums one component over the rows of its body, in their order: as SolverSteel, bit by bit, which has one
    thread for each world and component, that walks all rows and waits for each sum.
    """
    world, slot, lane = wp.tid()
    if slot >= body_count[world]:
        return
    body = body_list[world, slot]
    count = wp.min(row_count[world], impulse.shape[1])
    for first in range(0, TWIST, wp.block_dim()):
        axis = wp.min(first + lane, TWIST - 1)
        velocity = twist_inout[body, axis]
        total = body_impulse_inout[body, axis]
        for start in range(0, count, wp.block_dim()):
            # Choices by `where` instead of branches: no load waits for another.
            mine = wp.min(start + lane, count - 1)
            of_body = wp.where(body_a[world, mine] == body, True, body_b[world, mine] == body)
            touching = ballot(wp.where(impulse[world, mine] != 0.0, of_body, False) and start + lane < count)
            while touching != wp.uint32(0):
                for _ in range(BATCH):
                    # The last batch repeats a row without adding it.
                    row = start + wp.max(first_lane(touching), 0)
                    strength = impulse[world, row]
                    of_a = wp.where(touching != wp.uint32(0), body_a[world, row] == body, False)
                    of_b = wp.where(touching != wp.uint32(0), body_b[world, row] == body, False)
                    velocity = wp.where(of_a, velocity + response_a[world, row, axis] * strength, velocity)
                    total = wp.where(of_a, total + jacobian_a[world, row, axis] * strength, total)
                    velocity = wp.where(of_b, velocity + response_b[world, row, axis] * strength, velocity)
                    total = wp.where(of_b, total + jacobian_b[world, row, axis] * strength, total)
                    touching = touching & (touching - wp.uint32(1))
        if first + lane < TWIST:
            twist_inout[body, axis] = velocity
            body_impulse_inout[body, axis] = total
