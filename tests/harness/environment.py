"""Environment of child processes that import the checkout from any working directory."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def checkout_environment(**variables: str) -> dict[str, str]:
    """This process's environment with the checkout first on PYTHONPATH, and `variables`."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths)} | variables
