"""Records what physics does in every step, on the device, for exporters that want more than pictures show."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import newton
import numpy as np
import warp as wp

from synpick_warp.arrays import allocate, device_array
from synpick_warp.configs.schema import Config
from synpick_warp.kernels.sim import step_log
from synpick_warp.scenes import build
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.sim.physics import Physics
from synpick_warp.stages.sim.worlds import AttemptState, SealState, WorldState

PUBLIC_NAMES = {"seal_force": "seal_load", "attached": "held", "setpoint": "goal"}
"""Names that arrays of `StepArrays` have in data sets, where they differ."""


@dataclass(frozen=True, eq=False)
class StepArrays:
    """What each step of a tick left. A place is an instance; finger and cup come after the instances."""

    pose: wp.array = device_array("world", "step", "place", dtype=wp.transformf, unit="m")
    """Body to world, at the step's end."""
    velocity: wp.array = device_array("world", "step", "place", dtype=wp.vec3f, unit="m/s")
    """Of the centre of mass."""
    angular_velocity: wp.array = device_array("world", "step", "place", dtype=wp.vec3f, unit="rad/s")
    """In the world's axes."""
    contact_force: wp.array = device_array("world", "step", "place", dtype=wp.vec3f, unit="N")
    """Sum of the forces of all contacts on the body, mean over the step."""
    contact_load: wp.array = device_array("world", "step", "place", dtype=wp.float32, unit="N")
    """Sum of their sizes."""
    seal_force: wp.array = device_array("world", "step", "instance", dtype=wp.float32, unit="N")
    """Tension and shear that the instance's seal bore; 0: none holds it."""
    attached: wp.array = device_array("world", "step", "instance", dtype=wp.uint8)
    """1: a seal holds the instance at the step's end."""
    setpoint: wp.array = device_array("world", "step", dtype=wp.vec3f, unit="m")
    """Where the finger's tilt axis was drawn to in the step; NaN: nowhere."""
    impedance_force: wp.array = device_array("world", "step", dtype=wp.vec3f, unit="N")
    """The force that drew it, without the gripper's weight, which is borne."""
    task: wp.array = device_array("world", "step", dtype=wp.int8)
    """A `Task`, at the step's end."""


@dataclass(frozen=True, eq=False)
class DropArrays:
    """How the arrangement of each world's episode began."""

    drop_pose: wp.array = device_array("world", "instance", dtype=wp.transformf, unit="m")
    """Object to world where it was first dropped."""
    progress: wp.array = device_array("world", dtype=wp.vec4i, unit="ticks")
    """As `WorldState.progress`."""


@dataclass(frozen=True, eq=False)
class PhysicsRecord:
    """What one tick's physics leaves for the host."""

    steps: StepArrays | None
    """None: steps are not recorded."""
    drops: DropArrays


def record_sizes(config: Config, sizes: dict[str, int]) -> dict[str, int]:
    """Extents of the dimensions that the dataclasses here name; `sizes` are those of `world_sizes`."""
    return sizes | {"step": config.physics.steps_per_tick, "place": config.arrangement.max_objects + build.GRIPPER_BODIES}


def record_kinds(config: Config) -> tuple[type, ...]:
    """The dataclasses here that a bake with these settings allocates."""
    return (StepArrays, DropArrays) if config.trajectory.steps else (DropArrays,)


class Recorder:
    """Watches the steps of a tick. It launches the same kernels on the same arrays every time, as they are captured in a graph."""

    def __init__(
        self,
        config: Config,
        scene: SceneData,
        state: WorldState,
        attempts: AttemptState,
        seals: SealState,
        physics: Physics,
        sizes: dict[str, int],
    ) -> None:
        """Allocate what a tick's steps are written into.

        Args:
            config: Settings; those of `trajectory` say what is recorded.
            scene: Constants.
            state: Of the worlds.
            attempts: Of their grippers.
            seals: Of their cups.
            physics: Tells of contact forces, if steps are recorded.
            sizes: Those of `world_sizes`.
        """
        self._scene, self._state, self._attempts, self._seals, self._physics = scene, state, attempts, seals, physics
        self._device = state.phase.device
        self._sizes = record_sizes(config, sizes)
        self._steps = config.trajectory.steps
        self._current = self.new_record()
        self._share = 1.0 / config.physics.substeps
        self._weight = (config.gripper.finger_mass + config.gripper.cup_mass) * config.physics.gravity
        self._total = wp.zeros((sizes["body"], int(step_log.MAGNITUDE) + 1), dtype=wp.int64, device=self._device)
        self._force = wp.zeros(sizes["world"], dtype=wp.vec3, device=self._device)

    def new_record(self) -> PhysicsRecord:
        """Room for a tick."""
        steps = allocate(StepArrays, self._sizes, self._device) if self._steps else None
        return PhysicsRecord(steps, allocate(DropArrays, self._sizes, self._device))

    def save_drop_poses(self) -> None:
        """Where objects that have just been dropped begin to fall."""
        state = self._state
        wp.launch(
            step_log.save_drop_poses_kernel,
            dim=state.catalog_index.shape,
            inputs=[self._scene.layout, state.phase, state.progress, state.catalog_index, state.body_slot, self._physics.state.body_q],
            outputs=[self._current.drops.drop_pose],
            device=self._device,
        )

    def begin_step(self) -> None:
        """Before a step."""
        self._total.zero_()

    def save_impedance_force(self) -> None:
        """After the impedance force of a step was set, and before the seals add theirs."""
        if self._steps:
            wp.launch(
                step_log.save_impedance_force_kernel,
                dim=self._force.shape,
                inputs=[self._scene.layout, self._weight, self._physics.control.joint_f],
                outputs=[self._force],
                device=self._device,
            )

    def after_solve(self, contact_f: wp.array) -> None:
        """After a solver step; `contact_f` is each contact's force on its first shape (contact) spatial vector [N]."""
        contacts = self._physics.contacts
        wp.launch(
            step_log.sum_contacts_kernel,
            dim=contacts.rigid_contact_max,
            inputs=[
                self._physics.model.shape_body,
                contacts.rigid_contact_count,
                contacts.rigid_contact_shape0,
                contacts.rigid_contact_shape1,
                contact_f,
            ],
            outputs=[self._total],
            device=self._device,
        )

    def end_step(self, step: int, current: newton.State) -> None:
        """Write down a step, by its number in the tick, from the state at its end."""
        scene, state, seals, made = self._scene, self._state, self._seals, self._current.steps
        if made is None:
            return
        places = (self._sizes["world"], self._sizes["place"])
        wp.launch(
            step_log.record_motion_kernel,
            dim=places,
            inputs=[scene.layout, step, state.catalog_index, state.body_slot, current.body_q, current.body_qd],
            outputs=[made.pose, made.velocity, made.angular_velocity],
            device=self._device,
        )
        wp.launch(
            step_log.record_forces_kernel,
            dim=places,
            inputs=[scene.layout, step, self._share, state.catalog_index, state.body_slot, seals.attached, seals.seal_force, self._total],
            outputs=[made.contact_force, made.contact_load, made.seal_force, made.attached],
            device=self._device,
        )
        wp.launch(
            step_log.record_gripper_kernel,
            dim=self._sizes["world"],
            inputs=[step, state.phase, state.mode, self._attempts.task, state.setpoint, self._force],
            outputs=[made.setpoint, made.impedance_force, made.task],
            device=self._device,
        )

    def take(self, target: PhysicsRecord) -> None:
        """Copy what the tick left, on the device."""
        wp.copy(self._current.drops.progress, self._state.progress)
        for ours, theirs in ((self._current.steps, target.steps), (self._current.drops, target.drops)):
            if ours is not None:
                for item in fields(ours):
                    wp.copy(getattr(theirs, item.name), getattr(ours, item.name))


def record_arrays(made: PhysicsRecord) -> list[wp.array]:
    """The arrays of a record, in the order in which `host_record` takes them."""
    return [getattr(part, item.name) for part in (made.steps, made.drops) if part is not None for item in fields(part)]


def host_record(arrays: list[np.ndarray], instances: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Arrays by name for `TickBatch.tick` and `TickBatch.steps`.

    Args:
        arrays: What `record_arrays` names, on the host.
        instances: Room for instances of a world.
    """
    drops = [item.name for item in fields(DropArrays)]
    names = [item.name for item in fields(StepArrays)] if len(arrays) > len(drops) else []
    found = dict(zip([*names, *drops], arrays, strict=True))
    tick = {"drop_pose": found["drop_pose"], "redrops": found["progress"][:, 2]}
    return tick, _split(found, names, instances)


def _split(found: Mapping[str, np.ndarray], names: list[str], instances: int) -> dict[str, np.ndarray]:
    """Objects and gripper apart."""
    steps = {}
    for item in fields(StepArrays):
        if item.name not in names:
            continue
        values = found[item.name]
        if "place" in item.metadata["array"].shape:
            steps[item.name] = values[:, :, :instances]
            steps[f"gripper_{item.name}"] = values[:, :, instances:]
        else:
            steps[PUBLIC_NAMES.get(item.name, item.name)] = values
    return steps


def tick_measures(columns: Mapping[str, np.ndarray], instances: int) -> dict[str, np.ndarray]:
    """More arrays by name for `TickBatch.tick`: of the table of states what tells of physics and attempts, bits as (world, instance).

    Args:
        columns: Name -> column (world) of the tables of states and measures; see `stages.sim.worlds`.
        instances: Room for instances of a world.
    """
    made = {name: columns[name] for name in ("phase", "mode", "task", "attempt", "outcome", "target", "hits", "load")}
    bits = np.arange(instances, dtype=np.int32)
    return made | {name: (columns[name][:, None] >> bits & 1).astype(np.uint8) for name in ("caught", "held")}
