"""Friction rows of a contact: the Coulomb disk as a two-dimensional trust-region subproblem, by Newton's method on the secular equation.

The impulse x of the two rows minimizes ½ xᵀA x - bᵀx with |x| ≤ r, where A = J M⁻¹Jᵀ is their Delassus matrix and r the friction
coefficient times the normal impulse of the patch. Unless the unconstrained minimizer is within the disk (the contact sticks),
x = (A + αI)⁻¹ b with the multiplier α ≥ 0 for which |x| = r (Moré and Sorensen 1983). SolverSteel brackets α for every sliding contact in
every iteration. Here Newton's method for the root of 1/r - 1/|x(α)| starts from α = -xᵀ(A x - b) / r² of the impulse so far, which is exact
once x is the solution.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

FRICTION_OPERATOR = 5
"""Words of a Delassus matrix: its largest diagonal entry, both eigenvalues divided by it (largest first), eigenvector of the largest."""
MAX_ITERATIONS = 8
"""Maximum number of Newton steps. From any impulse within the disk 1 to 3 are needed, with eigenvalues in a ratio of 1,000 up to 7."""
TOLERANCE = 1e-5
"""Relative error of |x| at which Newton's method ends. Scaling to r removes it, and the direction's error is at most ½√cond(A + αI) times
it."""

SOLVE_FRICTION = f"""
#if defined(__CUDA_ARCH__)
    const auto reciprocal = [](float value) {{
        float result;
        asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(value));
        return result;
    }};
    const auto reciprocal_root = [](float value) {{
        float result;
        asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(value));
        return result;
    }};
#else
    const auto reciprocal = [](float value) {{ return 1.0f / value; }};
    const auto reciprocal_root = [](float value) {{ return 1.0f / wp::sqrt(value); }};
#endif
    const auto solve_friction = [&](
        float scale, float largest, float smallest, float axis0, float axis1,
        float residual0, float residual1, float old0, float old1, float radius, float relaxation, float& new0, float& new1) {{
        if (!(radius > 1e-18f) || !(scale > 1e-18f)) {{
            new0 = new1 = 0.0f;
            return;
        }}
        if (smallest < 1e-7f) smallest = 0.0f;
        // In the frame of the eigenvectors, divided by the scale, as is the multiplier: the velocity A x - b at the old impulse x.
        const float inverse_scale = reciprocal(scale);
        float velocity_u = (axis0 * residual0 + axis1 * residual1) * inverse_scale;
        float velocity_v = (axis0 * residual1 - axis1 * residual0) * inverse_scale;
        const float old_u = axis0 * old0 + axis1 * old1, old_v = axis0 * old1 - axis1 * old0;
        // Start within the disk: far outside, after the load fell, differences would cancel.
        float start_u = old_u, start_v = old_v;
        const float old_square = old_u * old_u + old_v * old_v;
        if (old_square > 4.0f * radius * radius) {{
            const float shrink = radius * reciprocal_root(old_square);
            start_u *= shrink;
            start_v *= shrink;
            velocity_u += largest * (start_u - old_u);
            velocity_v += smallest * (start_v - old_v);
        }}
        float u = start_u - velocity_u * reciprocal(largest);
        float v = start_v - (smallest > 0.0f ? velocity_v * reciprocal(smallest) : 0.0f);
        const bool is_idle_v = smallest == 0.0f
            && wp::abs(velocity_v) <= 1e-6f * (wp::abs(velocity_u) + wp::abs(start_u) + wp::abs(start_v));
        const bool has_minimizer = smallest > 0.0f || is_idle_v;
        if (is_idle_v && u * u <= radius * radius) {{
            const float limit = wp::sqrt(radius * radius - u * u);
            v = wp::min(wp::max(v, -limit), limit);
        }} else if (!has_minimizer || u * u + v * v > radius * radius) {{
            const float b_u = largest * start_u - velocity_u, b_v = smallest * start_v - velocity_v;
            const float inverse_radius = reciprocal(radius);
            const float b_square = b_u * b_u + b_v * b_v;
            const float upper = b_square * reciprocal_root(wp::max(b_square, 1e-37f)) * inverse_radius;
            const float lower = wp::max(wp::max(upper - largest, wp::abs(b_v) * inverse_radius - smallest), 0.0f);
            float multiplier = -(velocity_u * start_u + velocity_v * start_v) * inverse_radius * inverse_radius;
            multiplier = wp::min(wp::max(multiplier, lower), upper);
            float inverse_length = 0.0f;
            // 1/|x| is increasing and concave: from below the root steps never pass it, from above the first one goes below it.
            for (int step = 0; step < {MAX_ITERATIONS}; ++step) {{
                const float inverse_u = reciprocal(largest + multiplier);
                const float inverse_v = smallest + multiplier > 0.0f ? reciprocal(smallest + multiplier) : 0.0f;
                u = start_u - (velocity_u + multiplier * start_u) * inverse_u;
                v = start_v - (velocity_v + multiplier * start_v) * inverse_v;
                const float square = u * u + v * v;
                inverse_length = reciprocal_root(wp::max(square, 1e-37f));
                const float excess = square * inverse_length * inverse_radius - 1.0f;
                const float slope = u * u * inverse_u + v * v * inverse_v;
                if (wp::abs(excess) <= {TOLERANCE}f || !(slope > 0.0f)) break;
                multiplier = wp::max(multiplier + excess * square * reciprocal(slope), lower);
            }}
            u *= radius * inverse_length;
            v *= radius * inverse_length;
        }}
        new0 = old0 + relaxation * (axis0 * (u - old_u) - axis1 * (v - old_v));
        new1 = old1 + relaxation * (axis1 * (u - old_u) + axis0 * (v - old_v));
        const float square = new0 * new0 + new1 * new1;
        if (square > radius * radius) {{
            new0 *= radius * reciprocal_root(square);
            new1 *= radius * reciprocal_root(square);
        }}
    }};
"""
"""C++ source of a function for the impulses of two friction rows, as a local variable; on a GPU with its fast reciprocals."""


@wp.func_native(
    SOLVE_FRICTION
    + """
    float new0, new1;
    solve_friction(scale, largest, smallest, axis[0], axis[1], residual[0], residual[1], old[0], old[1], radius, relaxation, new0, new1);
    return wp::vec2(new0, new1);
"""
)
def solve_friction(
    scale: float, largest: float, smallest: float, axis: wp.vec2, residual: wp.vec2, old: wp.vec2, radius: float, relaxation: float
) -> wp.vec2:
    """Compute the impulse of two friction rows; 0 where they have no response.

    Args:
        scale, largest, smallest, axis: Delassus matrix, as `FRICTION_OPERATOR` says.
        residual: A x - b at the old impulse x: the velocities of the rows [m/s].
        old: Impulse so far, within the disk or not [N s].
        radius: Radius of the disk: the largest impulse [N s].
        relaxation: Factor of the change (successive over-relaxation), after which the impulse is projected onto the disk.
    """
    ...
