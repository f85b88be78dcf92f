"""Benchmarks of simulation, perception, rendering and writing: `python -m tools.bench`."""
