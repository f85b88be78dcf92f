"""What the simulation asks of a gripper's hold, that is, of what binds objects to its head; and the table of holds."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import newton
import warp as wp

from synpick_warp.configs.cell.gripper import SUCTION1, SUCTION_ARRAY, Gripper, Suction
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.sim.physics import Physics
from synpick_warp.stages.sim.suction import ArrayHold, SuctionHold
from synpick_warp.stages.sim.worlds import AttemptState, SealState, WorldState


class Hold(Protocol):
    """Hold of all worlds' grippers. `SealState.attached` says what is held: tasks and outcomes, snapshots and records read no more."""

    def engage(self, scene: SceneData, state: WorldState, attempts: AttemptState, seals: SealState, physics: Physics) -> None:
        """Attach objects where task PRESS is complete. Runs at the end of a tick."""
        ...

    def apply_forces(self, scene: SceneData, state: WorldState, seals: SealState, physics: Physics, current: newton.State) -> None:
        """Add the hold's wrenches to the joint forces of objects and gripper, and release what exceeds its strength. Runs before a step."""
        ...

    def ignore_contacts(self, scene: SceneData, state: WorldState, seals: SealState, physics: Physics) -> None:
        """Disable the contacts that the hold replaces. Runs between collision detection and solver."""
        ...


HOLDS: Mapping[str, Callable[[Suction, Catalog, RenderScene, wp.Device], Hold]] = {
    SUCTION1: SuctionHold,
    SUCTION_ARRAY: ArrayHold,
}
"""Class of the hold, by `gripper.kind`."""


def make_hold(gripper: Gripper, suction: Suction, catalog: Catalog, render_scene: RenderScene, device: wp.Device) -> Hold:
    """Create the hold of the gripper that the settings name."""
    return HOLDS[gripper.kind](suction, catalog, render_scene, device)
