"""Tracking over time: association of estimates, the filter of the SynPick paper, and the sweep of its weight."""
