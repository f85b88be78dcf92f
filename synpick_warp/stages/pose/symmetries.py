"""Near-symmetry search: rotations that keep an object's shape, which depth cannot tell apart, compared by correlation of colours."""

from __future__ import annotations

import warp as wp

from synpick_warp.kernels.pose.hypotheses import (
    CORRELATION_LANES,
    Correlation,
    choose_symmetry_kernel,
    correlate_symmetries_kernel,
    symmetric_poses_kernel,
)
from synpick_warp.stages.arrays import allocate_struct, struct_arrays
from synpick_warp.stages.pose.models import PoseModels
from synpick_warp.stages.pose.observe import Observer
from synpick_warp.stages.pose.refine import LossScales, make_loss

CORRELATION = struct_arrays(Correlation, "candidate", "lane")


class SymmetrySearch:
    """Search for the near-symmetry of each instance whose colours correlate best, as a second hypothesis. Owns its scratch.

    Attributes:
        hypotheses: Poses per instance that `propose` writes: the pose as it is, and its best near-symmetry.
    """

    hypotheses = 2

    def __init__(self, models: PoseModels, observer: Observer, scales: LossScales) -> None:
        """
        Args:
            models: The object models.
            observer: Observes the instances.
            scales: Scales of the residuals.
        """
        self.models, self.observer, self.scales, self.device = models, observer, scales, observer.device
        self.capacity = models.symmetries.rotation.shape[1]
        candidates = observer.instances * self.capacity
        self.correlation = allocate_struct(CORRELATION, {"candidate": candidates, "lane": int(CORRELATION_LANES)}, self.device)
        self.candidates = wp.zeros(candidates, dtype=wp.transform, device=self.device)

    def propose(self, best: wp.array, mean: wp.array, gain: float, out: wp.array, *, color: bool) -> None:
        """Write two hypotheses per instance.

        Args:
            best: Poses (instance).
            mean: Running means of the correlations (instance) float32; updated.
            gain: See `choose_symmetry_kernel`.
            out: Hypotheses (pose); written.
            color: Compare colours; without, both hypotheses are the pose as it is.
        """
        observer, symmetries, device, n = self.observer, self.models.symmetries, self.device, self.observer.instances
        targets, capacity = observer.targets, self.capacity
        candidates = n * capacity
        wp.launch(
            symmetric_poses_kernel, dim=candidates, inputs=[symmetries, targets, best, capacity], outputs=[self.candidates], device=device
        )
        if not color:
            gain = float("inf")
        loss = make_loss(self.scales, self.scales.truncation, 1, 1.0)
        inputs = [self.models.models, symmetries, loss, observer.images, targets, observer.observation, self.candidates, capacity]
        dim = (candidates, int(CORRELATION_LANES))
        wp.launch(correlate_symmetries_kernel, dim=dim, inputs=inputs, outputs=[self.correlation], device=device)
        inputs = [symmetries, mean, targets, self.correlation, self.candidates, capacity, gain]
        wp.launch(choose_symmetry_kernel, dim=n, inputs=inputs, outputs=[out], device=device)
