"""Launchers of the pose estimation kernels: observation, refinement, template search, tracking;
and of the nearest-vertex search for ADD-S."""
