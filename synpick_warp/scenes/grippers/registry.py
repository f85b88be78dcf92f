"""Table of the kinds of gripper. To add one, see "Add a gripper" in scenes/README.md."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from synpick_warp.configs.cell.gripper import SUCTION1, SUCTION_ARRAY, Gripper, Suction
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.grippers import suction1, suction_array
from synpick_warp.scenes.grippers.head import Head
from synpick_warp.scenes.types import Catalog
from synpick_warp.system.plugins import load_plugin

HEADS: Mapping[str, Callable[[Gripper], Head]] = {SUCTION1: suction1.make_head, SUCTION_ARRAY: suction_array.make_head}
"""Builder of the head, by `gripper.kind`; other kinds are plug-ins (`system/plugins.py`)."""


def make_head(gripper: Gripper) -> Head:
    """Build the head of the gripper that the settings name."""
    build = HEADS.get(gripper.kind) or load_plugin("grippers", gripper.kind, "make_head", "BEHAVIOR").make_head
    return build(gripper)


def check_reach(gripper: Gripper, suction: Suction, catalog: Catalog) -> None:
    """Refuse cups of which none can lie on an object that is gripped at the tool centre point.

    Raises:
        ConfigError: The nearest cup is farther from it than the largest diameter of the catalog.
    """
    nearest = min(math.hypot(*place) for place in make_head(gripper).cups)
    largest = max(entry.diameter for entry in catalog.entries)
    if nearest - suction.radius > largest:
        raise ConfigError(
            f"no cup of gripper.cups reaches an object: the nearest is {nearest:g} m from the tool centre point, where objects are "
            f"gripped, and the largest object has a diameter of {largest:.3g} m; move the cups nearer"
        )
