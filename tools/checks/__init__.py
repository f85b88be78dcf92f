"""Checks of data sets, trajectories, determinism, rendering across devices, and device code."""
