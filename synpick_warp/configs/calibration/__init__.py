"""Calibrated cameras: lens models, and files of intrinsics that other programs write. NumPy is imported by what reads or checks one."""
