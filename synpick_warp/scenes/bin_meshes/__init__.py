"""Bins from meshes: their inside, and collision shapes behind its faces."""
