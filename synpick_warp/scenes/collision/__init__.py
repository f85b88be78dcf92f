"""Collision shapes: hulls, decompositions, their half-spaces, and the cache."""
