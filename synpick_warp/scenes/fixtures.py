"""Fixtures: the visible parts of a scene that are not objects, bins and gripper."""

from __future__ import annotations

from collections.abc import Sequence

from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.scenes.bins import Bin
from synpick_warp.scenes.grippers.mechanism import finger_fixture
from synpick_warp.scenes.grippers.registry import make_head
from synpick_warp.scenes.types import Fixture


def make_fixtures(bins: Sequence[Bin], gripper: Gripper) -> tuple[Fixture, ...]:
    """Create the visual meshes and materials of all bins, the gripper shaft and the gripper head, in this order."""
    return (*(one.fixture for one in bins), finger_fixture(gripper), make_head(gripper).fixture)
