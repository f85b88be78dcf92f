"""Commits of episodes: manifest, staging folder to place, resume, merge, verification by checksums."""
