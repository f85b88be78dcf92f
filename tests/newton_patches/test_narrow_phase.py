"""Compilation of Newton's kernels: what a bake does not launch is not compiled."""

from __future__ import annotations

import subprocess
import sys

import pytest
from newton._src.sim import collide

from synpick_warp.scenes.build import build_model
from synpick_warp.stages.sim.physics import make_pipeline
from tests.worlds.small_worlds import CUBE, catalog, settings

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


def test_one_small_world_has_the_kernels_of_many(device):
    """On a GPU, Newton chooses by the number of pairs in all worlds; the thresholds must still be where they are replaced."""
    for count in (1, 64):
        config = settings(bake__worlds=count, arrangement__max_objects=2)
        pipeline = make_pipeline(config.physics, build_model(config, catalog(CUBE), device).model)
        assert pipeline.narrow_phase.split_gjk_mpr == device.is_cuda
    assert {collide._SPLIT_GJK_MPR_LEAN_PAIR_COUNT_THRESHOLD, collide._SPLIT_GJK_MPR_FULL_PAIR_COUNT_THRESHOLD} == {0}
