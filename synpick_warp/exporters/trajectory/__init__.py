"""Physics trajectories in a zarr store: one group per episode."""
