"""Data sets on disk: BOP folders, trajectories, tracks, and doors to PyTorch and webdataset; what a bake commits is in `commit`."""
