"""Checks: data sets, trajectories, determinism, device code."""
