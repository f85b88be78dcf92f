"""Table of the kinds of gripper. To add one, see "Add a gripper" in scenes/README.md."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from synpick_warp.configs.cell.gripper import SUCTION1, SUCTION_ARRAY, Gripper
from synpick_warp.scenes.grippers import suction1, suction_array
from synpick_warp.scenes.grippers.head import Head

HEADS: Mapping[str, Callable[[Gripper], Head]] = {SUCTION1: suction1.make_head, SUCTION_ARRAY: suction_array.make_head}
"""Builder of the head, by `gripper.kind`."""


def make_head(gripper: Gripper) -> Head:
    """Build the head of the gripper that the settings name."""
    return HEADS[gripper.kind](gripper)
