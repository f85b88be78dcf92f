"""Data set: modes, splits, and the settings that all writers share."""
