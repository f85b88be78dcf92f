"""What child processes that import the checkout need from any working directory, and the default device of the settings that tests use."""

import os
from pathlib import Path

VARIABLE = "SYNPICK_TEST_DEVICE"
"""Environment variable that holds it, so that worker processes of a test run inherit it."""


def default_device() -> str:
    """The first device of `pytest --device`; cpu outside of pytest."""
    return os.environ.get(VARIABLE, "cpu")


ROOT = Path(__file__).resolve().parents[2]


def checkout_environment(**variables: str) -> dict[str, str]:
    """This process's environment with the checkout first on PYTHONPATH, and `variables`."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths)} | variables
