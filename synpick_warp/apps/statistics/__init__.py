"""Statistics of a data set: the paper's table and bar chart, visibility, attempts, seal forces, pose coverage, depth, light."""

from synpick_warp.apps.statistics.compute import compute_statistics
from synpick_warp.apps.statistics.figures import GroupStatistics, ObjectStatistics, Statistics

__all__ = ["GroupStatistics", "ObjectStatistics", "Statistics", "compute_statistics"]
