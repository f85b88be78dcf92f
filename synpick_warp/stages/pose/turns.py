"""Search for the turn of an object that depth cannot see: rotations that keep its shape, compared by the correlation of colours."""

from __future__ import annotations

import warp as wp

from synpick_warp.arrays import allocate_struct, struct_arrays
from synpick_warp.kernels.pose.hypotheses import (
    CORRELATION_LANES,
    Correlation,
    choose_turns_kernel,
    correlate_turns_kernel,
    turn_poses_kernel,
)
from synpick_warp.stages.pose.models import PoseModels
from synpick_warp.stages.pose.observe import Observer
from synpick_warp.stages.pose.refine import CostScales, make_cost

CORRELATION = struct_arrays(Correlation, "candidate", "lane")


class TurnSearch:
    """Proposes the best turn of each instance as a second hypothesis. Owns its scratch.

    Attributes:
        hypotheses: Poses per instance that `propose` writes: the pose as it is, and its best turn.
    """

    hypotheses = 2

    def __init__(self, models: PoseModels, observer: Observer, scales: CostScales) -> None:
        """
        Args:
            models: The object models.
            observer: Observes the instances.
            scales: Scales of the residuals.
        """
        self.models, self.observer, self.scales, self.device = models, observer, scales, observer.device
        self.capacity = models.turns.rotation.shape[1]
        candidates = observer.instances * self.capacity
        self.correlation = allocate_struct(CORRELATION, {"candidate": candidates, "lane": int(CORRELATION_LANES)}, self.device)
        self.turned = wp.zeros(candidates, dtype=wp.transform, device=self.device)

    def propose(self, best: wp.array, mean: wp.array, gain: float, out: wp.array, *, color: bool) -> None:
        """Write two hypotheses per instance.

        Args:
            best: Poses (instance).
            mean: Running means of the correlations (instance) float32; updated.
            gain: See `choose_turns_kernel`.
            out: Hypotheses (pose); written.
            color: Compare colours; without, both hypotheses are the pose as it is.
        """
        observer, turns, device, n = self.observer, self.models.turns, self.device, self.observer.instances
        targets, capacity = observer.targets, self.capacity
        candidates = n * capacity
        wp.launch(turn_poses_kernel, dim=candidates, inputs=[turns, targets, best, capacity], outputs=[self.turned], device=device)
        if not color:
            gain = float("inf")
        cost = make_cost(self.scales, self.scales.truncation, 1, 1.0)
        inputs = [self.models.models, turns, cost, observer.images, targets, observer.observation, self.turned, capacity]
        dim = (candidates, int(CORRELATION_LANES))
        wp.launch(correlate_turns_kernel, dim=dim, inputs=inputs, outputs=[self.correlation], device=device)
        inputs = [turns, mean, targets, self.correlation, self.turned, capacity, gain]
        wp.launch(choose_turns_kernel, dim=n, inputs=inputs, outputs=[out], device=device)
