"""The embedded object set and light maps, made in code."""
