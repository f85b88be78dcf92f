"""Comparisons: of data sets, world counts, devices, and of two checkouts in all that they write."""
