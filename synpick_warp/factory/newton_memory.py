"""Memory of Newton's model, collision pipeline and solver, which cannot be built in a dry run: by factors measured with Newton 1.8."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.configs.episodes.fills import most_objects
from synpick_warp.configs.schema import Arrangement, Physics
from synpick_warp.scenes.bins import GUIDES, make_bins
from synpick_warp.scenes.build import FREE_DOFS
from synpick_warp.scenes.capacities import FEW
from synpick_warp.stages.arrays import Row

# Allocations for each item of a world's capacities [bytes]: name, setting, size on a CPU, on a GPU, and there at least. Measured on a CPU
# from the growth of all allocations of model, collision pipeline and solver: 928, 24, 180 and, with the options of a GPU, 952, 24, 156. On
# a GPU rows have further arrays (solve mode "colored"): by Newton's source 109 for its graph coloring, and 128 for our packed row.
# Contacts and pairs have at least those of `newton.Contacts` and their sorter.
_CAPACITIES = (
    ("Newton's contacts", "contacts_per_world", 900, 900, 250),
    ("Newton's shape pairs", "pairs_per_world", 24, 24, 16),
    ("Newton's contact rows", "rows_per_world", 160, 397, 397),
    ("Newton's gripper rows", "gripper_rows_per_world", 48, 40, 40),
)
_ROW_DOF = 16
"""Memory of a gripper's row for each degree of freedom of its world: Jacobian and response, for all of them and by body [bytes]."""
_BODY, _SHAPE = (3200, 5700), 680
"""Memory of a body slot, on a CPU and on a GPU, and of each of its shapes, measured as above [bytes]."""


def newton_rows(
    worlds: int, arrangement: Arrangement, physics: Physics, bins: Sequence[BinSizes], own_bins: bool, is_cuda: bool, pieces: int = 1
) -> Iterator[tuple[Row, tuple[str, ...]]]:
    """Rows of Newton's arrays, each with the full keys of the settings by which it grows.

    Where `arrangement.counts` sets the number of bodies, they are counted, and rows are within 10 % of what is allocated. A volume budget
    may need few of them, and rows are a lower bound.

    Args:
        worlds: Number of worlds.
        arrangement, physics: Settings.
        bins: Sizes of all bins.
        own_bins: Whether they are the user's own, which have shapes of their own.
        is_cuda: Whether the arrays lie in a GPU's memory.
        pieces: Convex pieces of each object, as far as they are known.
    """
    bodies = most_objects(arrangement.counts)
    # The capacities of many objects follow from their number.
    many = ("bake.worlds", "arrangement.max_objects") if arrangement.max_objects > FEW else ()
    for name, setting, cpu, gpu, least in _CAPACITIES:
        count, each = getattr(physics, setting), (gpu if bodies else least) if is_cuda else cpu
        if name == "Newton's gripper rows":
            each += _ROW_DOF * FREE_DOFS * bodies
        yield (name, (worlds * count,), "", worlds * count * each), many or (f"physics.{setting}", "bake.worlds")
    if bodies:
        size = worlds * bodies * (_BODY[is_cuda] + _SHAPE * pieces)
        yield ("Newton's bodies", (worlds * bodies,), "", size), ("bake.worlds", "arrangement.max_objects")
    if own_bins or bodies:
        # A separating axis for each pair of a world's shapes, of all bins with their guide walls, and at least one for each object.
        objects = pieces * bodies or arrangement.max_objects
        shapes = sum(len(one.pieces) + GUIDES for one in make_bins(bins)) + objects
        row = ("separating axes", (worlds, shapes * (shapes - 1) // 2), "", worlds * 2 * shapes * (shapes - 1))
        yield row, many or ("bake.worlds",)
