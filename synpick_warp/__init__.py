"""synpick-warp: a GPU-parallel data factory for dynamic bin picking."""

__version__ = "0.1.0"
