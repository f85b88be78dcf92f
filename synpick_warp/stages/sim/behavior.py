"""What the simulation asks of a kind of gripper: what binds objects to its head, the path of its setpoint, and its choice of grasps."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import newton
import warp as wp

from synpick_warp.configs.cell.gripper import SUCTION1, SUCTION_ARRAY, Suction
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.perception.arrays import Plan
from synpick_warp.stages.perception.plan import GraspPlanner
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.sim.gripper import TWO_SPEEDS, SetpointLaw
from synpick_warp.stages.sim.physics import Physics
from synpick_warp.stages.sim.suction import ArrayHold, SuctionHold
from synpick_warp.stages.sim.worlds import AttemptState, SealState, WorldState
from synpick_warp.system.plugins import load_plugin


class Hold(Protocol):
    """Hold of all worlds' grippers. `SealState.attached` says what is held: tasks and outcomes, snapshots and records read no more."""

    def engage(self, scene: SceneData, state: WorldState, attempts: AttemptState, seals: SealState, physics: Physics) -> None:
        """Attach objects where task PRESS is complete. Runs at the end of a tick."""

    def apply_forces(self, scene: SceneData, state: WorldState, seals: SealState, physics: Physics, current: newton.State) -> None:
        """Add the hold's wrenches to the joint forces of objects and gripper, and release what exceeds its strength. Runs before a step."""

    def ignore_contacts(self, scene: SceneData, state: WorldState, seals: SealState, physics: Physics) -> None:
        """Disable the contacts that the hold replaces. Runs between collision detection and solver."""


@dataclass(frozen=True)
class Behavior:
    """Behaviour of a kind of gripper: class of its hold, law of its setpoint, and its choice among the candidates of a grasp."""

    hold: Callable[[Suction, Catalog, RenderScene, wp.Device], Hold]
    law: SetpointLaw = TWO_SPEEDS
    choose_grasps: Callable[[GraspPlanner, SceneData, Plan], None] | None = None
    """Replaces grasps of `Plan` by others of the target (point, normal, yaw, tilt), after it was framed; None: the frame is taken."""


BEHAVIORS: Mapping[str, Behavior] = {
    SUCTION1: Behavior(SuctionHold),
    SUCTION_ARRAY: Behavior(ArrayHold, choose_grasps=GraspPlanner.align_cups),
}
"""Behaviour, by `gripper.kind`."""


def behavior_of(kind: str) -> Behavior:
    """Behaviour of a kind of gripper, of this package or of a plug-in (`system/plugins.py`)."""
    return BEHAVIORS.get(kind) or load_plugin("grippers", kind, "make_head", "BEHAVIOR").BEHAVIOR
