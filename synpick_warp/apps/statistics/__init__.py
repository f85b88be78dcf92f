"""Statistics of a data set: the paper's table and bar chart, visibility, attempts, seal forces, pose coverage, depth, light."""

from synpick_warp.apps.statistics.compute import GroupStatistics, ObjectStatistics, Statistics, compute_statistics

__all__ = ["GroupStatistics", "ObjectStatistics", "Statistics", "compute_statistics"]
