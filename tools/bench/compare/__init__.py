"""Benchmarks against other simulators and renderers, on the same piles, meshes and cameras."""
