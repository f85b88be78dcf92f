"""Pose estimation on a data set, host side: reading views, protocols (single frame, refinement, tracking), BOP result files."""
