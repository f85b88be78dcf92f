"""Clutter graph: edges from occlusion votes, made acyclic by a minimum feedback arc set, and its transitive closure (ancestors).

An edge runs from the upper object to the lower one. Sets of instances are bit masks, so a world has at most 32.
"""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.structs import PerceptionData

wp.set_module_options({"enable_backward": False})

CERTAIN = wp.constant(1.0e30)
"""Gain of placing a source or a sink of the graph, which removes no edge."""


@wp.struct
class Cycles:
    """Strongly connected component that is being ordered, by view: its members, weight[a, b] of the edge from b, above, to a (0: none),
    rank of each member (0: uppermost), and dynamic programming table by set of members.
    """

    member: wp.array2d[int]
    """Instances of the component, in ascending order (view, instance)."""
    weight: wp.array3d[float]
    """weight[a, b]: weight of the edge from member b, above, to member a; 0: no edge (view, instance, instance)."""
    rank: wp.array2d[int]
    """Position of each member in the linear order, the uppermost first (view, instance)."""
    best: wp.array2d[float]
    """Dynamic programming table: maximum weight of an acyclic subgraph of each set of members; bit k of the index stands for member k
    (view, subset)."""


@wp.func
def bit(instance: int) -> wp.uint32:
    """Bit field in which only this instance's bit is set."""
    return wp.uint32(1) << wp.uint32(instance)


@wp.func
def edge_weight(votes: wp.array3d[float], world: int, lower: int, upper: int, min_votes: float) -> float:
    """Weight of the edge from `upper` to `lower`: its votes minus those of the opposite edge, at least 0.

    0 below `min_votes` votes; opposite votes below it count as 0.
    """
    votes_for = votes[world, lower, upper]
    votes_against = votes[world, upper, lower]
    if votes_for < min_votes:
        return 0.0
    if votes_against < min_votes:
        return votes_for
    return wp.max(votes_for - votes_against, 0.0)


@wp.func
def close_graph(above: wp.array2d[wp.uint32], world: int, instances: int, ancestors: wp.array2d[wp.uint32]):
    """Transitive closure of a graph (Warshall, 1962): write to `ancestors` the instances from which a path leads to each instance."""
    for i in range(instances):
        ancestors[world, i] = above[world, i]
    for k in range(instances):
        for i in range(instances):
            if (ancestors[world, i] & bit(k)) != wp.uint32(0):
                ancestors[world, i] = ancestors[world, i] | ancestors[world, k]


@wp.func
def gather_component(ancestors: wp.array2d[wp.uint32], world: int, first: int, instances: int, view: int, cycles: Cycles) -> int:
    """List the strongly connected component of `first` in `cycles.member` and return its size.

    0 if `first` is on no cycle or is not the smallest index of its component, which is then listed at another call.
    """
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
    """Member of a set that is best placed last, below all others of the set, ties by index; and the maximum weight then kept."""
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
    """Minimum feedback arc set by dynamic programming over subsets (as Held and Karp, 1962; Lawler, 1964).

    Takes O(2ⁿ n²) time and O(2ⁿ) memory for n members.

    Maximum weight of downward edges among the members of S: f(S) = max over v in S of f(S - v) + Σ over u in S of w(u → v).
    Writes `cycles.best` and the optimal order to `cycles.rank`.
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
    """Greedy feedback arc set (after Eades, Lin and Smyth, 1993): sources first, sinks last, else the member of largest gain first.

    The gain is the weight of the edges that leave a member minus that of the edges that enter it, among unplaced members; ties go by
    index. Gains sum to zero, so each choice keeps at least the weight it removes: at least half of the total weight is kept. Writes
    `cycles.rank`.
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
    perception: PerceptionData,
    # In:
    views: Views,
    votes: wp.array3d[float],  # (world, instance, instance)
    # Out:
    cycles_out: Cycles,
    above_out: wp.array2d[wp.uint32],  # (world, instance)
    ancestors_out: wp.array2d[wp.uint32],  # (world, instance)
):
    """Build the acyclic clutter graph of each view's world (`above`: bit masks of direct predecessors) and its closure (`ancestors`).

    w(j → i) = max(v_ij - v_ji, 0), where votes v below `min_votes` count as 0. In every strongly connected component the acyclic subset of
    maximum weight is kept; in components of more than `exact_cycle` objects a greedy one. Launched over view.
    """
    view = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    instances = votes.shape[1]
    for i in range(instances):
        edges = wp.uint32(0)
        for j in range(instances):
            if edge_weight(votes, world, i, j, perception.min_votes) > 0.0:
                edges = edges | bit(j)
        above_out[world, i] = edges
    close_graph(above_out, world, instances, ancestors_out)
    for first in range(instances):
        size = gather_component(ancestors_out, world, first, instances, view, cycles_out)
        if size > 0:
            for a in range(size):
                for b in range(size):
                    weight = edge_weight(votes, world, cycles_out.member[view, a], cycles_out.member[view, b], perception.min_votes)
                    cycles_out.weight[view, a, b] = weight
            if size <= perception.exact_cycle:
                rank_exactly(view, size, cycles_out)
            else:
                rank_greedily(view, size, cycles_out)
            for a in range(size):
                for b in range(size):
                    if cycles_out.weight[view, a, b] > 0.0 and cycles_out.rank[view, b] > cycles_out.rank[view, a]:
                        i = cycles_out.member[view, a]
                        above_out[world, i] = above_out[world, i] ^ bit(cycles_out.member[view, b])
    close_graph(above_out, world, instances, ancestors_out)
