"""Collision shapes: convex hulls, convex decomposition, half-spaces."""
