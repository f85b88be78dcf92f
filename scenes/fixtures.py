"""Fixtures: the visible parts of a scene that are not objects, tote and gripper."""

from __future__ import annotations

from synpick_warp.configs.schema import Gripper, Tote
from synpick_warp.scenes.gripper import cup_fixture, finger_fixture
from synpick_warp.scenes.tote import tote_fixture
from synpick_warp.scenes.types import Fixture


def make_fixtures(tote: Tote, gripper: Gripper) -> tuple[Fixture, Fixture, Fixture]:
    """Visual meshes and materials of tote, gripper shaft and suction cup, in the order of the renderer's segmentation ids.

    Raises:
        ConfigError: The tote's sizes do not fit each other.
    """
    return tote_fixture(tote), finger_fixture(gripper), cup_fixture(gripper)
