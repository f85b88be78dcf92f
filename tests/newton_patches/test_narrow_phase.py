"""Compilation of Newton's kernels: what a bake does not launch is not compiled."""

from __future__ import annotations

import subprocess
import sys

import pytest

SHARED_MODULES = """
from warp._src import context
from synpick_warp.factory import assembly
from newton.solvers import SolverSteel
for name, module in context.user_modules.items():
    if name.startswith(("newton._src.geometry.", "newton._src.sim.", "newton._src.solvers.steel.")) and len(module._get_live_kernels()) > 1:
        print(name)
"""


@pytest.mark.slow
def test_no_two_kernels_of_newton_share_a_module():
    """In a process of its own: what others have imported before decides nothing."""
    assert subprocess.run([sys.executable, "-c", SHARED_MODULES], check=True, capture_output=True, text=True).stdout == ""
