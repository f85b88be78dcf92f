"""Narrow phase of collision detection: launch sizes and order of contacts on a GPU, early compilation of its kernels, which take longest to
compile, and contact matching between substeps in which no contact loses its impulse to another one, in place of Newton's."""

import contextlib
import threading
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import newton
import warp as wp
from newton._src.geometry import inertia, support_function
from newton._src.geometry import narrow_phase as narrow
from newton._src.geometry.contact_match import ContactMatcher
from newton._src.sim import collide
from newton._src.sim import model as newton_model
from newton._src.solvers.steel import solver_steel  # noqa: F401  (Newton imports it late, and its modules are split below.)
from warp._src import context

from synpick_warp.kernels.newton_patches import contact_matching, hull_support, key_ranks
from synpick_warp.kernels.newton_patches.solver_iterations import WARP
from synpick_warp.system.hardware.device import HIGH_PRIORITY
from synpick_warp.system.hardware.kernels import ModuleBuild, build_of, split_modules

# Of the kernels in these modules of Newton, a bake launches a fifth.
split_modules(("newton._src.geometry.", "newton._src.sim.", "newton._src.solvers.solver", "newton._src.solvers.steel."))
for _type in (bool, float, int, wp.uint64, wp.vec2i, wp.vec3, wp.vec3i, wp.vec4i, wp.transform):
    # Newton adds these overloads one launch after the other, and each compiles all of them before it once more.
    wp.overload(newton_model._copy_variant_shape_kernel, {"variant_values": wp.array(dtype=_type), "values": wp.array(dtype=_type)})

# On a GPU, Newton tests convex shapes in one kernel, or in four where the pairs of all worlds together exceed a threshold. They round
# differently: an episode of few objects would depend on the number of worlds.
collide._SPLIT_GJK_MPR_LEAN_PAIR_COUNT_THRESHOLD = collide._SPLIT_GJK_MPR_FULL_PAIR_COUNT_THRESHOLD = 0
# Hulls are tested for contacts by their vertices alone; functions of Newton's look this one up when they are compiled.
support_function._support_map_convex_mesh_exhaustive = hull_support.map_support
BLOCK, BLOCKS, WORLD_BLOCKS = 32, 8, 2
"""Blocks of the narrow phase: one warp each, 8 for each multiprocessor of a GPU or 2 for each world, whichever is more. Newton has four
warps a block (one warp, if a hull has 256 or more vertices), 4 blocks a multiprocessor. A thread tests a pair of shapes for as long as it
takes, and a block holds the registers of all its threads until the last one is done: a tick of 16 to 150 worlds is 3 to 7 % shorter so. A
world has some 60 pairs, about as many as its two blocks have threads."""
SMALL_BLOCK = 64
"""Threads a block of `small_blocks`."""
RANKED = 1 << 15
"""Maximum capacity for contacts, that of 64 worlds, up to which their keys are sorted by rank; the time is quadratic in the number of
contacts."""
REFINE_BLOCK = 32
"""Block size of the narrow phase's refinement in Newton; its kernel takes longer to compile than any other."""
_BUILDERS = {
    "geometry.bvh": "compute_shape_local_bounds compute_enabled_shapes compute_shape_world_transforms compute_shape_bvh_bounds "
    "compute_bvh_group_roots mark_inactive_bvh_shapes",
    "geometry.broad_phase_nxn": "_nxn_broadphase_kernel",
    "sim.model": "_select_body_variants_kernel _copy_variant_shape_kernel",
    "solvers.steel.friction_patches": "_accumulate_body_radius",
    "solvers.steel.kernels": "gather_free_root_anchors compute_spatial_inertia compute_com_transforms compute_effective_joint_armature "
    "gather_group_armature",
}
"""Kernels that Newton launches while it builds a model, by their file; each has a module of its own, see `split_modules`."""
SHIPPED = Path(__file__).with_name("narrow_phase.zip")
"""Archive of those compiled modules that take longer than all others together on 16 cores, for common GPUs; see `tools.narrow_phase`."""


def resize_blocks(pipeline: newton.CollisionPipeline) -> None:
    """Set the block size, number of threads and stream of Newton's narrow phase, on a GPU."""
    model = pipeline.model
    if model.device.is_cuda:
        blocks = max(BLOCKS * model.device.sm_count, WORLD_BLOCKS * model.world_count)
        pipeline.narrow_phase.split_convex_block_dim = BLOCK
        pipeline.narrow_phase.split_convex_total_num_threads = BLOCK * blocks
        pipeline.narrow_phase._split_refine_stream = wp.Stream(model.device, priority=HIGH_PRIORITY)


@contextlib.contextmanager
def small_blocks(threads: int = SMALL_BLOCK) -> Iterator[None]:
    """Have launches of this thread that leave the block size to Warp use blocks of `threads` threads on a GPU instead of 256.

    A launch over the bodies of 48 worlds has 1,300 threads, with 256 a block on 6 of 132 multiprocessors, where they wait for memory of
    which each thread reads its own cache lines.
    """
    before, _thread.block = getattr(_thread, "block", 0), threads
    try:
        yield
    finally:
        _thread.block = before


def _resolve_block(device: wp.Device, block: int | None) -> int:
    """Block size of a launch with argument `block`."""
    small = getattr(_thread, "block", 0)
    return _resolve_launch_block_dim(device, small if small and block is None and device.is_cuda else block)


_thread, _resolve_launch_block_dim = threading.local(), context._resolve_launch_block_dim
context._resolve_launch_block_dim = _resolve_block


def rank_contacts(pipeline: newton.CollisionPipeline) -> None:
    """Replace the radix sort of a pipeline's contacts by a rank sort, with the same order, on a GPU and up to a capacity of `RANKED`."""
    sorter: Any = pipeline._contact_sorter
    if sorter is not None and pipeline.model.device.is_cuda and sorter._capacity <= RANKED:
        sorter._sort_keys_copy.is_ranked = True


def sort_pairs(keys: wp.array, values: wp.array, count: int, begin_bit: int = 0, end_bit: int | None = None) -> None:
    """Sort key-value pairs in place of Warp's `radix_sort_pairs`, with its arguments. Keys marked by `rank_contacts` are sorted by rank;
    their values must be 0, 1, 2, ..., as in Newton's contact sorter."""
    if not getattr(keys, "is_ranked", False):
        _radix_sort_pairs(keys, values, count, begin_bit, end_bit)
        return
    lanes = int(WARP) if keys.device.is_cuda else 1
    rank, take, device = key_ranks.rank_keys_kernel, key_ranks.take_sorted_kernel, keys.device
    wp.launch(rank, dim=(count, lanes), inputs=[count, lanes], outputs=[keys, values], device=device)
    wp.launch(take, dim=count, inputs=[count], outputs=[keys, values], device=device)


_radix_sort_pairs = wp.utils.radix_sort_pairs
wp.utils.radix_sort_pairs = sort_pairs


def spread_pairs(kernel: wp.Kernel) -> wp.Kernel:
    """Kernel of GJK, its refinement or manifolds that gives few pairs of shapes to one thread of each warp, not to all of the first warps.

    The threads of a warp test different pairs, and wait for each other's memory and branches."""
    source, thread = kernel.adj.source, f"tid % {BLOCK} * (total_num_threads // {BLOCK}) + tid // {BLOCK}"
    for first in ("first = tid\n", "range(tid, num_work_items"):
        source = source.replace(first, first.replace("tid", thread))
    return wp.Kernel(kernel.func, kernel.key, kernel.module, kernel.options, source=source)


def _create_split_kernels(*args: Any, create: Any = narrow.create_narrow_phase_kernels_gjk_mpr_split, **options: Any) -> tuple[Any, ...]:
    """Kernels of MPR, GJK, its refinement and manifolds, with the arguments of Newton's function; all but MPR spread their pairs."""
    mpr, *kernels = create(*args, **options)
    return mpr, *map(spread_pairs, kernels)


narrow.create_narrow_phase_kernels_gjk_mpr_split = _create_split_kernels


def slow_builds(device: wp.Device) -> list[ModuleBuild]:
    """Modules that take longest to compile, longest first, and that every bake launches: Newton's narrow phase of convex shapes.

    Kernels that are created twice are one: their modules have the same name, and the same source.
    """
    return [ModuleBuild(kernel.module, device.alias, block) for kernel, block in _narrow_kernels(device.is_cuda)]


def early_builds(device: wp.Device) -> list[ModuleBuild]:
    """Modules that Newton needs to build a model: by launches they would be compiled one after the other."""
    modules = (wp.get_module(f"newton._src.{file}.{name}") for file, names in _BUILDERS.items() for name in names.split())
    kernels = [inertia.validate_and_correct_inertia_kernel, inertia.compute_body_inverses_kernel]
    return [build_of(kernel, device) for kernel in (*kernels, *(kernel for module in modules for kernel in module.kernels.values()))]


def take_shipped(device: wp.Device) -> None:
    """Copy those of `slow_builds` that are shipped for this GPU, and of these versions of all sources, into the kernel cache."""
    for build in slow_builds(device):
        build.take_shipped(SHIPPED)


@cache
def _narrow_kernels(on_gpu: bool) -> list[tuple[Any, int]]:
    """Kernels of the narrow phase as a collision pipeline has them, and their block sizes. Those that write contacts are generic."""
    options: dict[str, Any] = {"support_func": narrow.support_map_lean, "post_process_contact": narrow.post_process_minkowski_only}
    writer = {"writer_data": collide.ContactWriterData}
    if not on_gpu:
        kernel = narrow.create_narrow_phase_kernel_gjk_mpr(True, collide.write_contact, **options)
        wp.overload(kernel, writer)
        return [(kernel, 1)]
    mpr, gjk, refine, manifold = narrow.create_narrow_phase_kernels_gjk_mpr_split(True, collide.write_contact, **options)
    wp.overload(manifold, writer)
    return [(refine, REFINE_BLOCK), (manifold, BLOCK), (mpr, BLOCK), (gjk, BLOCK)]


MAX_DISTANCE = 0.02
"""Largest distance of a contact from the one whose impulse it starts with, if none within Newton's distance is left [m]."""


class CompleteMatcher(ContactMatcher):
    """Newton's contact matching, after which contacts without a partner get one of those left over (`complete_matching_kernel`)."""

    def __init__(self, matcher: ContactMatcher) -> None:
        """Prepare a matcher with the settings of `matcher`, Newton's, which has not matched anything yet."""
        super().__init__(
            matcher._capacity,
            sorter=matcher._sorter,
            shape_world=matcher._shape_world,
            world_count=matcher._world_count,
            shape_index_bits=matcher._shape_index_bits,
            sub_key_bits=matcher._sub_key_bits,
            pos_threshold=matcher._pos_threshold_sq**0.5,
            normal_dot_threshold=matcher._normal_dot_threshold,
            device=matcher._prev_count.device,
        )

    def match(self, *args: Any, **contacts: Any) -> None:
        """Match the contacts of a substep with those of the last one; arguments as in Newton's `match`, by keyword."""
        super().match(*args, **contacts)
        history = contact_matching.ContactHistory()
        history.count, history.key, history.position = self._prev_count, self._prev_sorted_keys, self._prev_pos_world
        history.normal, history.pair_bits = self._prev_normal, self._pair_sub_key_mask
        names = ("contact_count", "sort_keys", "shape0", "shape1", "point0", "point1", "normal")
        inputs = [contacts["shape_body"], MAX_DISTANCE, self._normal_dot_threshold, history, contacts["body_q"]]
        wp.launch(
            contact_matching.complete_matching_kernel,
            dim=self._capacity,
            inputs=inputs + [contacts[name] for name in names],
            outputs=[contacts["match_index_out"]],
            device=contacts["device"],
        )


def complete_matching(pipeline: newton.CollisionPipeline) -> None:
    """Replace the contact matching of a pipeline, before it is used."""
    assert pipeline._contact_matcher is not None
    pipeline._contact_matcher = CompleteMatcher(pipeline._contact_matcher)
