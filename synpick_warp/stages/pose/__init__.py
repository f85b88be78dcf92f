"""Launchers of the pose estimation kernels: observation, refinement, template search, tracking."""
