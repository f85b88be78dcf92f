"""Gripper with three suction cups at the corners of a triangle."""

import dataclasses

from synpick_warp.configs.cell.gripper import SUCTION_ARRAY, Gripper
from synpick_warp.scenes.grippers import Head, make_cup_array
from synpick_warp.stages.sim.behavior import BEHAVIORS

BEHAVIOR = BEHAVIORS[SUCTION_ARRAY]


def make_head(gripper: Gripper) -> Head:
    return make_cup_array(dataclasses.replace(gripper, cups=((0.03, 0.0), (-0.02, 0.03), (-0.02, -0.03))))
