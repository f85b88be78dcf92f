"""Trajectories: zarr arrays of physics, one group an episode."""
