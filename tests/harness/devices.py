"""Default device of the settings that tests simulate and bake with."""

from __future__ import annotations

import os

VARIABLE = "SYNPICK_TEST_DEVICE"
"""Environment variable that holds it, so that worker processes of a test run inherit it."""


def default_device() -> str:
    """The first device of `pytest --device`; cpu outside of pytest."""
    return os.environ.get(VARIABLE, "cpu")
