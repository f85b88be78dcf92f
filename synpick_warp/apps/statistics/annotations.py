"""Annotations: views, instances, visible fraction and objects by split and mode, as in the paper's table and bar chart."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from synpick_warp.apps.statistics.counting import Counts, Group, add_bins, histogram
from synpick_warp.apps.statistics.scenes import SceneTruth

VISIBILITY_BINS = 20
"""Bins of the visible fraction, of equal width from 0 to 1; the last one includes 1."""
_UNIT = 10**9
"""Visible fractions are summed as integers in units of 1 / _UNIT, so that sums do not depend on their order."""


@dataclass(frozen=True)
class Annotations:
    """Statistics of a group's annotations: views, instances, mean visible fraction (None: not known), invisible instances, histogram of the
    visible fraction, instances by obj_id.
    """

    views: int
    instances: int
    """Annotated instances, the invisible ones included."""
    visibility: float | None
    """Mean visible fraction of all instances of which it is known; None: there is none."""
    invisible: int
    """Instances without a visible pixel."""
    histogram: tuple[int, ...]
    """Instances by visible fraction, in VISIBILITY_BINS bins."""
    objects: dict[int, int]
    """Instances by obj_id."""

    @property
    def instances_per_view(self) -> float | None:
        """Mean number of instances in a view; None: no view."""
        return self.instances / self.views if self.views else None


@dataclass
class AnnotationCounts(Counts):
    """Accumulator of `Annotations`: integer counts by group (split, mode), so that counters of processes add up exactly."""

    views: Counter[Group] = field(default_factory=Counter)
    known: Counter[Group] = field(default_factory=Counter)
    """Instances whose visible fraction is known: in a data set of a bake, all."""
    visibility: Counter[Group] = field(default_factory=Counter)
    """Sum of the visible fractions [1e-9]."""
    invisible: Counter[Group] = field(default_factory=Counter)
    bins: Counter[tuple[Group, int]] = field(default_factory=Counter)
    """Instances by bin of the visible fraction."""
    objects: Counter[tuple[Group, int]] = field(default_factory=Counter)
    """Instances by obj_id."""

    def add_scene(self, group: Group, scene: SceneTruth) -> None:
        """Count the views and instances of a scene for its group."""
        self.views[group] += scene.frames
        visibility = scene.visibility[~np.isnan(scene.visibility)]
        self.known[group] += len(visibility)
        self.visibility[group] += int(np.rint(visibility * _UNIT).astype(np.int64).sum())
        self.invisible[group] += int((visibility == 0.0).sum())
        add_bins(self.bins, group, np.minimum((visibility * VISIBILITY_BINS).astype(np.int64), VISIBILITY_BINS - 1))
        add_bins(self.objects, group, scene.object_id)

    def result(self, groups: Iterable[Group]) -> Annotations:
        """Statistics of the annotations of these groups together."""
        groups = tuple(groups)
        bins = np.sum([histogram(self.bins, group, VISIBILITY_BINS) for group in groups], axis=0, dtype=object).tolist() if groups else []
        objects: Counter[int] = Counter()
        for (group, object_id), count in self.objects.items():
            if group in groups:
                objects[object_id] += count
        instances = objects.total()
        known = sum(self.known[group] for group in groups)
        visibility = sum(self.visibility[group] for group in groups) / (_UNIT * known) if known else None
        return Annotations(
            views=sum(self.views[group] for group in groups),
            instances=instances,
            visibility=visibility,
            invisible=sum(self.invisible[group] for group in groups),
            histogram=tuple(map(int, bins)),
            objects=dict(sorted(objects.items())),
        )
