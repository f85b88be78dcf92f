"""Clutter graph: edges from occlusion votes, made acyclic by a minimum feedback arc set, and its transitive closure (ancestors).

An edge runs from the upper object to the lower one; the instances above another are a bit set (`kernels.bitsets`). Threads share
what takes more than linear time: edges and closure a thread a row, cycles a warp a view, whose threads are called lanes (one on a CPU).
"""

import warp as wp

from synpick_warp.kernels.bitsets import NO_MEMBERS, WORD_BITS, WORD_SHIFT, bit, has_member, lowest_bit
from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.state import Observations
from synpick_warp.kernels.structs import PerceptionData

wp.set_module_options({"enable_backward": False})

LANES = 32
"""Lanes of a view on a GPU."""
CERTAIN = wp.constant(1.0e30)
"""Gain of placing a source or a sink of the graph, which removes no edge."""
UNPLACED = wp.constant(-1)
"""`Cycles.rank` of vertices that the greedy ordering has not placed yet."""
NO_CYCLE = wp.constant(-1)
"""Value of `Cycles.leader` for instances that are not part of a cycle."""


@wp.struct
class Cycles:
    """Strongly connected components by view, and the one that is being ordered."""

    pending: wp.array3d[wp.uint32]
    """Frontier of the graph search: bit sets of ancestors not expanded yet (view, instance, word)."""
    leader: wp.array2d[int]
    """Smallest instance of each instance's component; -1: it is on no cycle (view, instance)."""
    member: wp.array2d[int]
    """Instances of the component, in ascending order (view, instance)."""
    weight: wp.array3d[float]
    """weight[a, b]: weight of the edge from member b, above, to member a; 0: no edge (view, instance, instance)."""
    rank: wp.array2d[int]
    """Position of each member in the linear order, the uppermost first (view, instance)."""
    leaving: wp.array2d[float]
    """Weight of the edges from each member to unplaced members, during the greedy order (view, instance)."""
    entering: wp.array2d[float]
    """Weight of the edges from unplaced members that enter each member (view, instance)."""
    best: wp.array2d[float]
    """Dynamic programming table: maximum weight of an acyclic subgraph of each set of members; bit k stands for member k (view, subset)."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
""")
def sync_lanes():
    """Warp-level barrier (`__syncwarp`): what lanes wrote before it is visible to all lanes of the view after it."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int distance = 16; distance > 0; distance /= 2) {
        const float other_gain = __shfl_xor_sync(~0u, gain, distance);
        const int other = __shfl_xor_sync(~0u, choice, distance);
        if (other >= 0 && (choice < 0 || other_gain > gain || (other_gain == gain && other < choice))) {
            gain = other_gain;
            choice = other;
        }
    }
#endif
    return choice;
""")
def best_choice(gain: float, choice: int) -> int:
    """Warp-level argmax: the choice with the largest gain over all lanes of the view, ties by the smallest index; -1: no candidate."""
    ...


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
def close_row(above: wp.array2d[wp.uint32], instance: int, pending: wp.array2d[wp.uint32], ancestors: wp.array2d[wp.uint32]):
    """Graph search from one instance: write to its row of `ancestors` all instances from which a path leads to it. `pending`: scratch."""
    words = above.shape[1]
    for word in range(words):
        ancestors[instance, word] = above[instance, word]
        pending[instance, word] = above[instance, word]
    searching = bool(True)
    while searching:
        searching = bool(False)
        for word in range(words):
            while pending[instance, word] != NO_MEMBERS:
                bits = pending[instance, word]
                pending[instance, word] = bits & (bits - wp.uint32(1))
                k = WORD_BITS * word + lowest_bit(bits)
                for other in range(words):
                    found = above[k, other] & ~ancestors[instance, other]
                    if found != NO_MEMBERS:
                        ancestors[instance, other] = ancestors[instance, other] | found
                        pending[instance, other] = pending[instance, other] | found
                        searching = True


@wp.func
def find_leader(ancestors: wp.array2d[wp.uint32], instance: int) -> int:
    """Smallest instance of the strongly connected component of an instance; NO_CYCLE: it is on no cycle."""
    if not has_member(ancestors, instance, instance):
        return NO_CYCLE
    for word in range(ancestors.shape[1]):
        bits = ancestors[instance, word]
        while bits != NO_MEMBERS:
            other = WORD_BITS * word + lowest_bit(bits)
            if has_member(ancestors, other, instance):
                return other
            bits = bits & (bits - wp.uint32(1))
    return NO_CYCLE


@wp.func
def gather_component(first: int, instances: int, view: int, lane: int, cycles: Cycles) -> int:
    """List the component whose leader is `first` in `cycles.member` and return its size; 0 if `first` leads none."""
    if cycles.leader[view, first] != first:
        return 0
    size = int(0)
    for i in range(first, instances):
        if cycles.leader[view, i] == first:
            if lane == 0:
                cycles.member[view, size] = i
            size += 1
    return size


@wp.func
def weigh_component(votes: wp.array3d[float], world: int, view: int, size: int, lane: int, lanes: int, min_votes: float, cycles: Cycles):
    """Write the weights of the edges among the members of a component to `cycles.weight`."""
    for a in range(size):
        lower = cycles.member[view, a]
        for b in range(lane, size, lanes):
            cycles.weight[view, a, b] = edge_weight(votes, world, lower, cycles.member[view, b], min_votes)


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
def rank_exactly(view: int, size: int, lane: int, lanes: int, cycles: Cycles):
    """Minimum feedback arc set by dynamic programming over subsets (as Held and Karp, 1962; Lawler, 1964).

    Takes O(2ⁿ n²) time, shared by the lanes, and O(2ⁿ) memory for n members.

    Maximum weight of downward edges among the members of S: f(S) = max over v in S of f(S - v) + Σ over u in S of w(u → v). Sets are taken
    by their number of members. Writes `cycles.best` and the optimal order to `cycles.rank`.
    """
    if lane == 0:
        cycles.best[view, 0] = 0.0
    sync_lanes()
    for count in range(1, size + 1):
        for subset in range(lane, 1 << size, lanes):
            if int(wp.bit_count(wp.uint32(subset))) == count:
                last, most = best_last(view, subset, size, cycles)
                cycles.best[view, subset] = most
        sync_lanes()
    rest = (1 << size) - 1
    for place in range(size):
        last, most = best_last(view, rest, size, cycles)
        if lane == 0:
            cycles.rank[view, last] = size - 1 - place
        rest = rest ^ (1 << last)


@wp.func
def sum_weights(view: int, v: int, size: int, cycles: Cycles):
    """Sum the weights between member v and the unplaced ones, in ascending order, to `cycles.leaving` and `cycles.entering`."""
    leaving = float(0.0)
    entering = float(0.0)
    for u in range(size):
        if cycles.rank[view, u] == UNPLACED:
            leaving += cycles.weight[view, u, v]
            entering += cycles.weight[view, v, u]
    cycles.leaving[view, v] = leaving
    cycles.entering[view, v] = entering


@wp.func
def choose_next(view: int, size: int, placed: int, lane: int, lanes: int, cycles: Cycles) -> int:
    """Member to place next in a greedy order, see `rank_greedily`: twice its index, plus 1 if it goes to the end.

    A lane sums anew for those of its members that share an edge with the member placed last (`placed`; -1: all). The sums of others would
    differ by a zero, so that the choice depends neither on which are skipped nor on the number of lanes.
    """
    choice = int(-1)
    highest = float(0.0)
    for v in range(lane, size, lanes):
        if cycles.rank[view, v] == UNPLACED:
            stale = bool(True)
            if placed >= 0:
                stale = cycles.weight[view, placed, v] > 0.0 or cycles.weight[view, v, placed] > 0.0
            if stale:
                sum_weights(view, v, size, cycles)
            leaving = cycles.leaving[view, v]
            entering = cycles.entering[view, v]
            gain = leaving - entering
            if entering == 0.0 or leaving == 0.0:
                gain = CERTAIN
            if choice < 0 or gain > highest:
                choice = 2 * v
                highest = gain
                if entering > 0.0 and leaving == 0.0:
                    choice += 1
    return best_choice(highest, choice)


@wp.func
def rank_greedily(view: int, size: int, lane: int, lanes: int, cycles: Cycles):
    """Greedy feedback arc set (after Eades, Lin and Smyth, 1993): sources first, sinks last, else the member of largest gain first.

    The gain is the weight of the edges that leave a member minus that of the edges that enter it, among unplaced members; ties go by
    index. Gains sum to zero, so each choice keeps at least the weight it removes: at least half of the total weight is kept. Takes
    O(e n + n²) time for n members and e edges, shared by the lanes. Writes `cycles.rank`.
    """
    for v in range(lane, size, lanes):
        cycles.rank[view, v] = UNPLACED
    sync_lanes()
    first = int(0)
    last = size - 1
    placed = int(-1)
    for _step in range(size):
        choice = choose_next(view, size, placed, lane, lanes, cycles)
        placed = choice >> 1
        place = first
        if choice & 1 != 0:
            place = last
            last -= 1
        else:
            first += 1
        sync_lanes()
        if lane == 0:
            cycles.rank[view, placed] = place
        sync_lanes()


@wp.func
def remove_upward(view: int, size: int, lane: int, lanes: int, cycles: Cycles, above: wp.array2d[wp.uint32]):
    """Remove the edges of a component that run from a lower rank to a higher one."""
    for a in range(lane, size, lanes):
        i = cycles.member[view, a]
        for b in range(size):
            if cycles.weight[view, a, b] > 0.0 and cycles.rank[view, b] > cycles.rank[view, a]:
                j = cycles.member[view, b]
                above[i, j >> WORD_SHIFT] = above[i, j >> WORD_SHIFT] ^ bit(j)


@wp.kernel
def link_clutter_kernel(perception: PerceptionData, observation_inout: Observations, views: Views):
    """Edges of the clutter graph, cycles included: `above` receives the bit set of each instance's direct predecessors.

    w(j → i) = max(v_ij - v_ji, 0), where votes v below `min_votes` count as 0. Launched over view, instance, word.
    """
    view, instance, word = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    edges = wp.uint32(0)
    for upper in range(WORD_BITS * word, wp.min(WORD_BITS * (word + 1), observation_inout.votes.shape[1])):
        if edge_weight(observation_inout.votes, world, instance, upper, perception.min_votes) > 0.0:
            edges = edges | bit(upper)
    observation_inout.above[world, instance, word] = edges


@wp.kernel
def close_clutter_kernel(observation_inout: Observations, views: Views, cycles_out: Cycles):
    """Transitive closure of the clutter graph, by a search from each instance: `ancestors` receives the instances from which a path leads
    to it. Launched over view, instance.
    """
    view, instance = wp.tid()
    world = views.world[view]
    if world >= 0:
        close_row(observation_inout.above[world], instance, cycles_out.pending[view], observation_inout.ancestors[world])


@wp.kernel
def break_cycles_kernel(perception: PerceptionData, lanes: int, observation_inout: Observations, views: Views, cycles_out: Cycles):
    """Make each world's clutter graph acyclic: in every strongly connected component the acyclic subset of maximum weight is kept; in
    components of more than `exact_cycle` objects a greedy one.

    `ancestors` is the closure of `above` with cycles. Launched over view, lane; on a GPU the lanes are a warp.
    """
    view, lane = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    instances = observation_inout.votes.shape[1]
    for i in range(lane, instances, lanes):
        cycles_out.leader[view, i] = find_leader(observation_inout.ancestors[world], i)
    sync_lanes()
    for first in range(instances):
        size = gather_component(first, instances, view, lane, cycles_out)
        if size > 0:
            sync_lanes()
            weigh_component(observation_inout.votes, world, view, size, lane, lanes, perception.min_votes, cycles_out)
            sync_lanes()
            if size <= perception.exact_cycle:
                rank_exactly(view, size, lane, lanes, cycles_out)
            else:
                rank_greedily(view, size, lane, lanes, cycles_out)
            sync_lanes()
            remove_upward(view, size, lane, lanes, cycles_out, observation_inout.above[world])
            sync_lanes()
