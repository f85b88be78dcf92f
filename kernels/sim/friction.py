"""Friction of a contact: the quadratic problem of two friction rows within a circle, solved by Newton's method on the secular equation.

The impulse x minimizes ½ xᵀA x - bᵀx with |x| ≤ r, where A is the symmetric 2x2 matrix of responses and r the friction coefficient times
the load. Unless the free minimum is within the circle (the contact sticks), x = (A + αI)⁻¹ b with the multiplier α for which |x| = r: a
trust-region subproblem (Moré and Sorensen 1983). SolverSteel brackets α for every sliding contact in every iteration. Here Newton's method
for the root of 1/|x(α)| - 1/r starts from the multiplier of the impulse so far, which changes little once the iterations converge.
"""

import warp as wp

FRICTION_OPERATOR = 5
"""Words of A, by eigenvalues: its largest diagonal entry, both eigenvalues divided by it (largest first), eigenvector of the largest."""
MAX_ITERATIONS = 8
"""Maximum number of Newton steps; from an arbitrary impulse 2 or 3 are needed. The last impulse is on the circle in any case."""
TOLERANCE = 1e-5
"""Relative error of |x|, whose direction is then as exact. From a solution Newton's method does not move."""

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
        if (radius <= 0.0f) {{
            new0 = new1 = 0.0f;
            return;
        }}
        // In the eigenvectors' frame, scaled: residual A x - b at the old impulse, and the impulse of a contact that sticks.
        const float inverse_scale = reciprocal(scale);
        const float residual_u = (axis0 * residual0 + axis1 * residual1) * inverse_scale;
        const float residual_v = (axis0 * residual1 - axis1 * residual0) * inverse_scale;
        const float old_u = axis0 * old0 + axis1 * old1, old_v = axis0 * old1 - axis1 * old0;
        float u = old_u - (largest > 0.0f ? residual_u * reciprocal(largest) : 0.0f);
        float v = old_v - (smallest > 0.0f ? residual_v * reciprocal(smallest) : 0.0f);
        const bool has_minimum = largest > 0.0f && (smallest > 0.0f || residual_v == 0.0f);
        if (!has_minimum || u * u + v * v > radius * radius) {{
            const float b_u = largest * old_u - residual_u, b_v = smallest * old_v - residual_v;
            const float inverse_radius = reciprocal(radius);
            const float b_square = b_u * b_u + b_v * b_v;
            const float highest = b_square * reciprocal_root(wp::max(b_square, 1e-37f)) * inverse_radius;
            const float lowest = wp::max(wp::max(highest - largest, wp::abs(b_v) * inverse_radius - smallest), 0.0f);
            float multiplier = -(residual_u * old_u + residual_v * old_v) * inverse_radius * inverse_radius;
            multiplier = wp::min(wp::max(multiplier, lowest), highest);
            float inverse_length = 0.0f;
            for (int step = 0; step < {MAX_ITERATIONS}; ++step) {{
                const float inverse_u = largest + multiplier > 0.0f ? reciprocal(largest + multiplier) : 0.0f;
                const float inverse_v = smallest + multiplier > 0.0f ? reciprocal(smallest + multiplier) : 0.0f;
                u = old_u - (residual_u + multiplier * old_u) * inverse_u;
                v = old_v - (residual_v + multiplier * old_v) * inverse_v;
                const float square = u * u + v * v;
                inverse_length = reciprocal_root(wp::max(square, 1e-37f));
                const float excess = square * inverse_length * inverse_radius - 1.0f;
                const float slope = u * u * inverse_u + v * v * inverse_v;
                if (wp::abs(excess) <= {TOLERANCE}f || !(slope > 0.0f)) break;
                multiplier = wp::max(multiplier + excess * square * reciprocal(slope), lowest);
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
    """Compute the impulse of two friction rows.

    Args:
        scale, largest, smallest, axis: A, as `FRICTION_OPERATOR` says.
        residual: A x - b at the old impulse: the velocities of the rows [m/s].
        old: Impulse so far [N s].
        radius: Largest impulse [N s].
        relaxation: Factor of the change (over-relaxation), after which the impulse is projected onto the circle.
    """
    ...
