"""Scheduling: which device simulates which episodes, in which order, in how many worlds, batches and writer processes."""
