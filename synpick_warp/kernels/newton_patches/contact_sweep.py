"""Graph-colored Gauss-Seidel sweep over the contacts of a world by one block, with one contact per thread in registers.

Newton's SolverSteel loads and solves the contacts of one color after another. Piles have many colors of few contacts: an object of many
convex pieces rests on the tote with 20 contacts, each of its own color, and each color waits for memory. Here contacts are sorted by
color, each thread loads one, and the warps take turns: a warp solves its colors in sequence while the others wait. If no contact involves
the gripper, contacts stay in registers and twists in shared memory for all iterations. Worlds with more contacts than a block has threads
load them again in each iteration, and prefetch the next ones. Results are bitwise those of the solver, except for friction (`friction`).
"""

import warp as wp

from synpick_warp.kernels.newton_patches.contact_rows import (
    BODY_A,
    BODY_B,
    KIND,
    MASS,
    MEMBER_COUNT,
    MEMBER_LIST,
    MU,
    NEXT_MEMBER,
    NORMAL_ONLY,
    PATCH_MEMBERS,
    RECORD,
    ROW,
    WITH_FRICTION,
)
from synpick_warp.kernels.newton_patches.friction import FRICTION_OPERATOR, SOLVE_FRICTION
from synpick_warp.kernels.newton_patches.solver_iterations import ContactRowData, IterationSettings

HAS_FRICTION = f"record[{KIND}] == {WITH_FRICTION}"
"""CUDA expression for whether a contact has friction rows."""
MAX_SHARED_ROWS = 3072
"""Maximum number of rows of a world whose impulses and lists of patch members lie in shared memory: they take 24 of the 48 KB of a block.
Those of more rows lie in global memory, and are prefetched to the L1 cache."""
MAX_WARPS = 4
"""Maximum warps of a block. Two such blocks fit into the registers of a multiprocessor. Worlds whose rows lie in global memory always have
that many, and solve a color in all of them at once: of 3,600 contacts, a color has 50."""
SECTOR = 8
"""Words that a prefetch brings to the L1 cache at least: 32 bytes."""
TWIST_STRIDE = 8
"""Words of a body's twist in shared memory, so that it is read at once."""


def shared_bytes(rows: int, bodies: int, stages_rows: bool = True) -> int:
    """Shared memory of the sweep over the contacts of a world [bytes]; arguments as of `compose_contact_sweep`."""
    words = (bodies + 1) * TWIST_STRIDE + bodies * 6 + (rows + 31) // 32 + (2 * rows if stages_rows else 0)
    return 4 * words + bodies + 1


def compose_contact_sweep(
    rows: int, bodies: int, offsets: int, friction: str = SOLVE_FRICTION, stages_rows: bool = True, warps: int = MAX_WARPS
) -> wp.Function:
    """Create the sweep over the contacts of a world, for a GPU: all iterations of a solve in one launch, with a block for each world.

    Impulses, patch lists and starts of colors stay in shared memory from the first iteration to the last, which writes the impulses. Two
    contacts that share a body, or a patch, must have different colors. A contact of another kind than `WITH_FRICTION` and `NORMAL_ONLY` is
    skipped, and its world flagged in `overflow`.

    Args:
        rows, bodies: Capacities of a world.
        offsets: Color offsets of a world. The last two are where contacts without a color begin (solved one by one), and the number of
            contacts.
        friction: Source of the function `solve_friction`.
        stages_rows: Whether impulses and patch lists lie in shared memory; the arithmetic is the same.
        warps: Warps of a block; they do not affect the result.

    Raises:
        ValueError: `rows` exceeds `MAX_SHARED_ROWS`, and they are to lie in shared memory.
    """
    if stages_rows and rows > MAX_SHARED_ROWS:
        raise ValueError(f"{rows:,} contact rows of a world do not fit into shared memory; at most {MAX_SHARED_ROWS:,} do.")

    @wp.func_native(_source(rows, bodies, offsets, friction, stages_rows, warps))
    def sweep_contacts(
        world: int,
        iteration: int,
        is_alone: bool,
        settings: IterationSettings,
        contacts: ContactRowData,
        twist_inout: wp.array2d[float],
        impulse_inout: wp.array2d[float],
    ) -> int:
        """Gauss-Seidel sweeps over the contacts of a world by one block: update the impulses of rows and bodies, and the twists.

        Returns the number of iterations done: all remaining ones if only contacts change velocities in the world, otherwise one.
        `is_alone`: the world has no constraint rows besides contacts.
        """
        ...

    return sweep_contacts


_SHARED = (
    """    __shared__ float impulses[{rows}];
    __shared__ int patch_list[{rows}];""",
    """
        const int listed = min(contacts.patch_list_length.data[world], {rows});
        for (int i = lane; i < row_count; i += THREADS) impulses[i] = contacts.impulse.data[first_row + i];
        for (int i = lane; i < listed; i += THREADS) patch_list[i] = contacts.patch_lists.data[first_row + i];""",
    """
        for (int i = lane; i < row_count; i += THREADS) contacts.impulse.data[first_row + i] = impulses[i];""",
    "",
)
"""CUDA source of impulses and patch lists in shared memory: declarations, statements before the first and after the last iteration, and
where the contact 32 places further is prefetched; {rows} stands for the capacity of a world."""
_GLOBAL = (
    """    float* const impulses = &contacts.impulse.data[first_row];
    const int* const patch_list = &contacts.patch_lists.data[first_row];""",
    "",
    "",
    """
            prefetch(&impulses[next_row]);""",
)
"""As `_SHARED`, in global memory."""


def _source(rows: int, bodies: int, offsets: int, friction: str, stages_rows: bool, warps: int) -> str:
    """CUDA source of the sweep by `warps` warps a block. A static body's twist is that of a slot behind the others, zero."""
    declare, begin, end, prefetch = (part.replace("{rows}", str(rows)) for part in (_SHARED if stages_rows else _GLOBAL))
    source = f"""
#if defined(__CUDA_ARCH__)
{friction}
    const auto prefetch = [](const void* address) {{ asm volatile("prefetch.global.L1 [%0];" :: "l"(address)); }};
    const int lane = threadIdx.x;
    const int end_iteration = settings.iteration_offset + settings.iterations;
    if (contacts.row_count.data[world] == 0) return is_alone ? end_iteration - iteration : 1;
    const int first_row = world * {rows};
    const int* color_offsets = &contacts.color_offsets.data[world * {offsets}];
    const int uncolored = color_offsets[{offsets} - 2], count = color_offsets[{offsets} - 1];

    __shared__ __align__(16) float twists[({bodies} + 1) * {TWIST_STRIDE}];
    __shared__ float body_impulses[{bodies} * 6];
    __shared__ bool is_free[{bodies} + 1];
{declare}
    __shared__ unsigned color_starts[({rows} + 31) / 32];
    const int row_count = min(contacts.row_count.data[world], {rows}), slots = contacts.body_count.data[world];
    if (iteration == settings.iteration_offset) {{{begin}
{_FIND_COLORS.replace("OFFSETS", str(offsets))}
    }}
{_LOAD_BODIES}
    const bool has_gripper = __syncthreads_or(holds_gripper);
    const int stop = is_alone && !has_gripper ? end_iteration : iteration + 1;
{_DECLARE}
    for (int now = iteration; now < stop; ++now)
    for (int first = 0; first < count; first += THREADS) {{
        const int index = first + lane;
        if (now == iteration || count > THREADS) {{
{_LOAD.replace("PREFETCH", prefetch)}
        }}
{_VISIT_IN_TURN if stages_rows else _VISIT_AT_ONCE}
    }}
{_STORE_BODIES}
    if (stop == end_iteration) {{{end}
    }}
    return stop - iteration;
#else
    return 1;
#endif
"""
    for name, value in {"BODIES": bodies, "WARPS": warps, "THREADS": 32 * warps}.items():
        source = source.replace(name, str(value))
    return source


_LOAD_BODIES = f"""
    bool holds_gripper = false;
    for (int i = lane; i < slots * 6; i += THREADS) {{
        const int slot = i / 6, component = i - 6 * slot, body = contacts.bodies.data[world * BODIES + slot];
        twists[slot * {TWIST_STRIDE} + component] = twist_inout.data[body * 6 + component];
        body_impulses[i] = impulse_inout.data[body * 6 + component];
        is_free[slot] = contacts.is_free.data[body];
        holds_gripper |= !is_free[slot];
    }}
    if (lane < {TWIST_STRIDE}) twists[BODIES * {TWIST_STRIDE} + lane] = 0.0f;
    is_free[BODIES] = true;"""
"""Load the twists of a world's bodies, their impulses, and which of them are free; `holds_gripper`: a body of this thread is not."""

_STORE_BODIES = f"""
    for (int i = lane; i < slots * 6; i += THREADS) {{
        const int slot = i / 6, component = i - 6 * slot, body = contacts.bodies.data[world * BODIES + slot];
        twist_inout.data[body * 6 + component] = twists[slot * {TWIST_STRIDE} + component];
        impulse_inout.data[body * 6 + component] = body_impulses[i];
    }}"""
"""Store the twists of a world's bodies and the impulses on them."""

_DECLARE = f"""
    int record[{RECORD}], row0 = 0;
    float mass = 0.0f, mu = 0.0f, Ja[3][6] = {{0}}, Jb[3][6] = {{0}}, Ma[3][6], Mb[3][6], rhs[3], friction_operator[{FRICTION_OPERATOR}];"""
"""Declare the registers of a thread's contact."""

_LOAD = f"""
        // The next iteration begins with the first contacts again. The record of a contact is prefetched before its rows, which it tells.
        const int padded = (count + THREADS - 1) / THREADS * THREADS;
        const int next = index + THREADS < padded ? index + THREADS : lane;
        const int after = next + THREADS < padded ? next + THREADS : lane;
        if (after < count) {{
            const int* after_record = &contacts.records.data[(first_row + after) * {RECORD}];
            prefetch(after_record);
            prefetch(after_record + {KIND});
        }}
        if (next < count) {{
            const int* next_record = &contacts.records.data[(first_row + next) * {RECORD}];
            const int next_row = __ldg(next_record), next_rows = __ldg(next_record + {KIND}) == {WITH_FRICTION} ? 3 : 1;
            const float* packed = &contacts.rows.data[(size_t)(first_row + next_row) * {ROW}];
            for (int k = 0; k < next_rows * {ROW}; k += {SECTOR}) prefetch(packed + k);
            prefetch(&contacts.rhs.data[first_row + next_row]);PREFETCH
            if (next_rows == 3) {{
                prefetch(&contacts.rhs.data[first_row + next_row + 2]);
                prefetch(&contacts.friction_operator.data[(first_row + next) * {FRICTION_OPERATOR}]);
                prefetch(&contacts.friction_operator.data[(first_row + next) * {FRICTION_OPERATOR} + 4]);
            }}
        }}
        if (index >= count) {{
            #pragma unroll
            for (int k = 0; k < {RECORD}; ++k) record[k] = 0;
        }} else {{
            const int4* words = reinterpret_cast<const int4*>(&contacts.records.data[(first_row + index) * {RECORD}]);
            #pragma unroll
            for (int k = 0; k < {RECORD // 4}; ++k) {{
                const int4 four = __ldg(&words[k]);
                record[4 * k] = four.x; record[4 * k + 1] = four.y; record[4 * k + 2] = four.z; record[4 * k + 3] = four.w;
            }}
            if (record[{KIND}] == 0) contacts.overflow.data[world] = true;
        }}
        row0 = record[0];
        #pragma unroll
        for (int r = 0; r < 3; ++r) {{
            if ({HAS_FRICTION} || (r == 0 && record[{KIND}] == {NORMAL_ONLY})) {{
                const float* row = &contacts.rows.data[(size_t)(first_row + row0 + r) * {ROW}];
                float words[28];
                #pragma unroll
                for (int k = 0; k < 7; ++k) {{
                    const float4 four = __ldg(&reinterpret_cast<const float4*>(row)[k]);
                    words[4 * k] = four.x; words[4 * k + 1] = four.y; words[4 * k + 2] = four.z; words[4 * k + 3] = four.w;
                }}
                if (r == 0) mass = words[{MASS}];
                if (r == 1) mu = words[{MU}];
                #pragma unroll
                for (int k = 0; k < 6; ++k) {{
                    Ja[r][k] = words[k]; Jb[r][k] = words[6 + k]; Ma[r][k] = words[12 + k]; Mb[r][k] = words[18 + k];
                }}
                rhs[r] = __ldg(&contacts.rhs.data[first_row + row0 + r]);
            }}
        }}
        if ({HAS_FRICTION}) {{
            #pragma unroll
            for (int k = 0; k < {FRICTION_OPERATOR}; ++k)
                friction_operator[k] = __ldg(&contacts.friction_operator.data[(first_row + index) * {FRICTION_OPERATOR} + k]);
        }}"""
"""Load a thread's contact; prefetch its next one, `THREADS` places further, and the record of the one after that."""

_FIND_COLORS = """
        if (lane < 32)
        for (int first = 0, color = 0; first < count; first += 32) {
            const int index = first + lane;
            unsigned starts = index >= uncolored && index < count ? 1u << lane : 0u;
            for (unsigned inside = ~0u; inside == ~0u;) {
                const int at = color + lane < OFFSETS - 1 ? color_offsets[color + lane] : count;
                const bool is_inside = at < count && at < first + 32;
                if (is_inside) starts |= 1u << (at - first);
                inside = __ballot_sync(~0u, is_inside);
                color += __popc(inside);
            }
            for (int distance = 16; distance > 0; distance /= 2) starts |= __shfl_xor_sync(~0u, starts, distance);
            if (lane == 0) color_starts[first / 32] = starts;
        }"""
"""Mark the first contact of each color by a bit, in a word for each 32 contacts, by the first warp. `color`: the first color that starts
in the word or later."""


def _dot(row: int) -> str:
    """CUDA expression for J of a row times the twists, summed in pairs."""
    terms = [f"Ja[{row}][{k}] * twist_a[{k}]" for k in range(6)] + [f"Jb[{row}][{k}] * twist_b[{k}]" for k in range(6)]
    pairs = [f"({first} + {second})" for first, second in zip(terms[::2], terms[1::2], strict=True)]
    return "((({} + {}) + ({} + {})) + ({} + {}))".format(*pairs)


def _respond(row: int, impulse: str) -> str:
    """CUDA statements that add the response to an impulse of a row to the twists."""
    return f"""
                    #pragma unroll
                    for (int k = 0; k < 6; ++k) {{
                        twist_a[k] += Ma[{row}][k] * {impulse};
                        twist_b[k] += Mb[{row}][k] * {impulse};
                    }}"""


_LOAD_PATCH = f"""
                float members[{PATCH_MEMBERS}];
                #pragma unroll
                for (int q = 0; q < {PATCH_MEMBERS}; ++q)
                    members[q] = {HAS_FRICTION} && q < record[{MEMBER_COUNT}] ? impulses[record[{MEMBER_COUNT + 1} + q]] : 0.0f;"""
"""Load the normal impulses of the patch's other contacts, which earlier colors may have changed."""

_ADD_PATCH = f"""
                    #pragma unroll
                    for (int q = 0; q < {PATCH_MEMBERS}; ++q)
                        if (q < record[{MEMBER_COUNT}]) normal_sum += members[q];
                    if (record[{NEXT_MEMBER}] >= 0 && record[{MEMBER_LIST}] >= 0) {{
                        const int* const members_left = &patch_list[record[{MEMBER_LIST}] & 0xFFFFF];
                        const int left = record[{MEMBER_LIST}] >> 20;
                        #pragma unroll 8
                        for (int q = 0; q < left; ++q) normal_sum += impulses[members_left[q]];
                    }} else {{
                        const int* const following = &contacts.row_parent.data[first_row];
                        for (int row = record[{NEXT_MEMBER}]; row >= 0 && row != row0; row = following[row]) normal_sum += impulses[row];
                    }}"""
"""Add the normal impulses of the patch's other contacts in its order: the first 4, then a list, or if that was full, link by link."""

_SOLVE = f"""
{_LOAD_PATCH}
                const int slot_a = record[{BODY_A}] >= 0 ? record[{BODY_A}] : BODIES;
                const int slot_b = record[{BODY_B}] >= 0 ? record[{BODY_B}] : BODIES;
                float4* const shared_a = reinterpret_cast<float4*>(&twists[slot_a * {TWIST_STRIDE}]);
                float4* const shared_b = reinterpret_cast<float4*>(&twists[slot_b * {TWIST_STRIDE}]);
                const float4 linear_a = shared_a[0], angular_a = shared_a[1], linear_b = shared_b[0], angular_b = shared_b[1];
                float twist_a[6] = {{linear_a.x, linear_a.y, linear_a.z, linear_a.w, angular_a.x, angular_a.y}};
                float twist_b[6] = {{linear_b.x, linear_b.y, linear_b.z, linear_b.w, angular_b.x, angular_b.y}};
                float* const impulse = &impulses[row0];
                const float old0 = impulse[0];
                float normal_sum = old0, change0 = 0.0f, change1 = 0.0f, change2 = 0.0f;
                if (mass > 0.0f) {{
                    float new0 = old0 + settings.omega * (-({_dot(0)} + rhs[0]) * mass);
                    if (new0 < 0.0f) new0 = 0.0f;
                    change0 = new0 - old0;
                    impulse[0] = new0;
                    normal_sum = new0;
{_respond(0, "change0")}
                }}
                if ({HAS_FRICTION}) {{
                  if (now < settings.friction_start_iteration) {{
                    impulse[1] = 0.0f;
                    impulse[2] = 0.0f;
                  }} else {{
{_ADD_PATCH}
                    const float radius = fmaxf(mu * normal_sum, 0.0f);
                    const float old1 = impulse[1], old2 = impulse[2];
                    const float residual1 = {_dot(1)} + rhs[1];
                    const float residual2 = {_dot(2)} + rhs[2];
                    float new1, new2;
                    solve_friction(
                        friction_operator[0], friction_operator[1], friction_operator[2], friction_operator[3], friction_operator[4],
                        residual1, residual2, old1, old2, radius, settings.omega, new1, new2);
                    change1 = new1 - old1;
                    change2 = new2 - old2;
                    impulse[1] = new1;
                    impulse[2] = new2;
{_respond(2, "change2")}
{_respond(1, "change1")}
                  }}
                }}
                if (slot_a < BODIES) {{
                    shared_a[0] = make_float4(twist_a[0], twist_a[1], twist_a[2], twist_a[3]);
                    shared_a[1] = make_float4(twist_a[4], twist_a[5], 0.0f, 0.0f);
                }}
                if (slot_b < BODIES) {{
                    shared_b[0] = make_float4(twist_b[0], twist_b[1], twist_b[2], twist_b[3]);
                    shared_b[1] = make_float4(twist_b[4], twist_b[5], 0.0f, 0.0f);
                }}
                // Only the gripper's impulses are needed, by the propagation through its joints.
                if (!is_free[slot_a]) {{
                    #pragma unroll
                    for (int k = 0; k < 6; ++k) {{
                        float& sum = body_impulses[slot_a * 6 + k];
                        sum = fmaf(Ja[1][k], change1, fmaf(Ja[2][k], change2, fmaf(Ja[0][k], change0, sum)));
                    }}
                }}
                if (!is_free[slot_b]) {{
                    #pragma unroll
                    for (int k = 0; k < 6; ++k) {{
                        float& sum = body_impulses[slot_b * 6 + k];
                        sum = fmaf(Jb[1][k], change1, fmaf(Jb[2][k], change2, fmaf(Jb[0][k], change0, sum)));
                    }}
                }}"""
"""Solve a thread's contact: first its normal row, then both friction rows at once; their responses are added in the solver's order."""

_VISIT_IN_TURN = f"""
        for (int turn = 0; turn < WARPS && first + 32 * turn < count; ++turn) {{
            if (lane / 32 == turn) {{
                unsigned starts = color_starts[first / 32 + turn] & ~1u;
                for (int begin = 32 * turn; begin < 32 * turn + 32;) {{
                    const int end = 32 * turn + (starts ? __ffs(starts) - 1 : 32);
                    if (record[{KIND}] != 0 && begin <= lane && lane < end) {{
{_SOLVE}
                    }}
                    __syncwarp();
                    starts &= starts - 1;
                    begin = end;
                }}
            }}
            __syncthreads();
        }}"""
"""Solve the contacts of one warp after another, each color by color; a barrier separates the warps."""

_VISIT_AT_ONCE = f"""
        unsigned starts = color_starts[first / 32] & ~1u;
        for (int begin = 0, word = 0; begin < THREADS;) {{
            while (starts == 0 && ++word < WARPS && first + 32 * word < count) starts = color_starts[first / 32 + word];
            const int end = starts ? 32 * word + __ffs(starts) - 1 : THREADS;
            if (record[{KIND}] != 0 && begin <= lane && lane < end) {{
{_SOLVE}
            }}
            __syncthreads();
            starts &= starts - 1;
            begin = end;
        }}"""
"""Solve the contacts of all warps color by color, with a barrier after each color. A color may span several warps."""
