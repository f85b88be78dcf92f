"""USD scenes: one layer an episode over a shared asset library."""
