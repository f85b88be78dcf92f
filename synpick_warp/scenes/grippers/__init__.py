"""Grippers: the mechanism that all share, and a file for the head of each kind."""
