"""The clutter graph: edges from votes, and the heaviest acyclic subset of those that run in cycles."""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.structs import PerceptionData

wp.set_module_options({"enable_backward": False})

CERTAIN = wp.constant(1.0e30)
"""Gain of placing an object that no edge enters, or none leaves: it costs nothing."""


@wp.struct
class Cycles:
    """Scratch, one row a view: one strongly connected component at a time."""

    member: wp.array2d[int]
    """Its instances, ascending."""
    weight: wp.array3d[float]
    """weight[a, b]: that of the edge from member b, above, to member a; 0: none."""
    rank: wp.array2d[int]
    """Place of each member in the order that was found, the uppermost first."""
    best: wp.array2d[float]
    """Weight of the heaviest acyclic subset among the members in a set; bit k of the index stands for member k."""


@wp.func
def bit(instance: int) -> wp.uint32:
    return wp.uint32(1) << wp.uint32(instance)


@wp.func
def edge_weight(votes: wp.array3d[float], world: int, lower: int, upper: int, least: float) -> float:
    """Weight of the edge from `upper` to `lower`: the votes for it, less those for its opposite; fewer than `least` are none."""
    votes_for = votes[world, lower, upper]
    votes_against = votes[world, upper, lower]
    if votes_for < least:
        return 0.0
    if votes_against < least:
        return votes_for
    return wp.max(votes_for - votes_against, 0.0)


@wp.func
def close_paths(above: wp.array2d[wp.uint32], world: int, instances: int, ancestors: wp.array2d[wp.uint32]):
    """Transitive closure of a graph (Warshall, 1962)."""
    for i in range(instances):
        ancestors[world, i] = above[world, i]
    for k in range(instances):
        for i in range(instances):
            if (ancestors[world, i] & bit(k)) != wp.uint32(0):
                ancestors[world, i] = ancestors[world, i] | ancestors[world, k]


@wp.func
def gather_cycle(ancestors: wp.array2d[wp.uint32], world: int, first: int, instances: int, view: int, cycles: Cycles) -> int:
    """List the instances that have paths to `first` and from it; return their number, 0 if there are none or `first` is not the least."""
    size = int(0)
    for i in range(instances):
        if (ancestors[world, first] & bit(i)) != wp.uint32(0) and (ancestors[world, i] & bit(first)) != wp.uint32(0):
            if i < first:
                return 0
            cycles.member[view, size] = i
            size += 1
    return size


@wp.func
def best_last(view: int, subset: int, size: int, cycles: Cycles):
    """The member of a set that is best placed below all others of it, the least of equal ones, and the weight that is kept."""
    last = int(-1)
    most = float(-1.0)
    for v in range(size):
        if (subset >> v) & 1 == 1:
            kept = cycles.best[view, subset ^ (1 << v)]
            for u in range(size):
                if (subset >> u) & 1 == 1:
                    kept += cycles.weight[view, v, u]
            if kept > most:
                most = kept
                last = v
    return last, most


@wp.func
def rank_exactly(view: int, size: int, cycles: Cycles):
    """Order the members so that the edges that run downward weigh most: f(S) = max over v in S of f(S - v) + Σ over u in S of w(u → v).

    Takes 2^size steps and places (Lawler, 1964).
    """
    cycles.best[view, 0] = 0.0
    for subset in range(1, 1 << size):
        last, most = best_last(view, subset, size, cycles)
        cycles.best[view, subset] = most
    rest = (1 << size) - 1
    for place in range(size):
        last, most = best_last(view, rest, size, cycles)
        cycles.rank[view, last] = size - 1 - place
        rest = rest ^ (1 << last)


@wp.func
def rank_greedily(view: int, size: int, cycles: Cycles):
    """Order the members one by one: who has nothing above comes first, who has nothing below comes last, else first who gains most.

    The gain is the weight of the edges that leave a member less that of those that enter it, among members without a place; equal ones
    go by index. Gains sum to zero, so each choice keeps at least what it drops: at least half of all weight is kept (after Eades, Lin and
    Smyth, 1993).
    """
    for v in range(size):
        cycles.rank[view, v] = -1
    first = int(0)
    last = size - 1
    for _step in range(size):
        chosen = int(-1)
        highest = float(0.0)
        to_end = bool(False)
        for v in range(size):
            if cycles.rank[view, v] < 0:
                leaving = float(0.0)
                entering = float(0.0)
                for u in range(size):
                    if cycles.rank[view, u] < 0:
                        leaving += cycles.weight[view, u, v]
                        entering += cycles.weight[view, v, u]
                gain = leaving - entering
                if entering == 0.0 or leaving == 0.0:
                    gain = CERTAIN
                if chosen < 0 or gain > highest:
                    chosen = v
                    highest = gain
                    to_end = entering > 0.0 and leaving == 0.0
        if to_end:
            cycles.rank[view, chosen] = last
            last -= 1
        else:
            cycles.rank[view, chosen] = first
            first += 1


@wp.kernel
def order_clutter_kernel(
    # Scene:
    sight: PerceptionData,
    # In:
    views: Views,
    votes: wp.array3d[float],
    # Out:
    cycles_out: Cycles,
    above_out: wp.array2d[wp.uint32],
    ancestors_out: wp.array2d[wp.uint32],
):
    """The clutter graph of each view's world, without cycles, and its transitive closure.

    w(j → i) = max(v_ij - v_ji, 0), where v are votes, and 0 where they are fewer than `min_votes`. In every strongly connected component
    the heaviest acyclic subset of edges is kept; in components of more than `exact_cycle` objects a greedy one.
    """
    view = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    instances = votes.shape[1]
    for i in range(instances):
        edges = wp.uint32(0)
        for j in range(instances):
            if edge_weight(votes, world, i, j, sight.min_votes) > 0.0:
                edges = edges | bit(j)
        above_out[world, i] = edges
    close_paths(above_out, world, instances, ancestors_out)
    for first in range(instances):
        size = gather_cycle(ancestors_out, world, first, instances, view, cycles_out)
        if size > 0:
            for a in range(size):
                for b in range(size):
                    weight = edge_weight(votes, world, cycles_out.member[view, a], cycles_out.member[view, b], sight.min_votes)
                    cycles_out.weight[view, a, b] = weight
            if size <= sight.exact_cycle:
                rank_exactly(view, size, cycles_out)
            else:
                rank_greedily(view, size, cycles_out)
            for a in range(size):
                for b in range(size):
                    if cycles_out.weight[view, a, b] > 0.0 and cycles_out.rank[view, b] > cycles_out.rank[view, a]:
                        i = cycles_out.member[view, a]
                        above_out[world, i] = above_out[world, i] ^ bit(cycles_out.member[view, b])
    close_paths(above_out, world, instances, ancestors_out)
