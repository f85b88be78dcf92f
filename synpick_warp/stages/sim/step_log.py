"""Step log: records poses, velocities and forces of every physics step on the device, and the support graph of every tick."""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import newton
import numpy as np
import warp as wp

from synpick_warp.codes import MAX_CUPS
from synpick_warp.configs.schema import Gripper
from synpick_warp.kernels.sim import step_log
from synpick_warp.scenes import build
from synpick_warp.stages.arrays import allocate, array_group, device_array, unpack_words
from synpick_warp.stages.constants import SceneData
from synpick_warp.stages.launch import launch
from synpick_warp.stages.sim.physics import Physics, contact_arrays
from synpick_warp.stages.sim.worlds import AttemptState, SealState, WorldState

_PLACES = dict.fromkeys(("pose", "velocity", "angular_velocity", "contact_force", "contact_load"), ("world", "step", "place"))
_OTHERS = dict.fromkeys(("seal_force", "attached"), ("world", "step", "instance")) | {"cup_force": ("world", "step", "cup")}
_FORCES = dict.fromkeys(("contact_force", "contact_load", "seal_force", "impedance_force", "cup_force"), "N")
_UNITS = _FORCES | {"pose": "m", "velocity": "m/s", "angular_velocity": "rad/s", "setpoint": "m"}


class StepArrays(array_group(step_log.StepLog, "world", "step", units=_UNITS, **_PLACES, **_OTHERS)):
    """Step log of a tick. The dimension "place" holds the instances, then gripper shaft and cup."""


@dataclass(frozen=True, eq=False)
class DropArrays:
    """Drop poses of the objects of each world's arrangement, and progress of settling."""

    drop_pose: wp.array = device_array("world", "instance", dtype=wp.transformf, unit="m")
    """Object to world at its first drop."""
    progress: wp.array = device_array("world", dtype=wp.vec4i)
    """As `WorldState.progress`."""


@dataclass(frozen=True, eq=False)
class SupportArrays:
    """Support of the instances in a tick, as the weighted support graph has it."""

    support: wp.array = device_array("world", "instance", "supporter", dtype=wp.float32, unit="N")
    """Upward force on the instance of each supporter's contacts, mean over the tick; below 0: the supporter lies on the instance.
    The last axis indexes supporters: the instances, then one entry for all static bodies."""


@dataclass(frozen=True, eq=False)
class PhysicsRecord:
    """Step log, drop poses and support of one tick, for the host."""

    steps: StepArrays | None
    drops: DropArrays
    supports: SupportArrays | None = None


def record_sizes(sizes: dict[str, int], steps_per_tick: int) -> dict[str, int]:
    """Extents of the dimensions of the dataclasses here; `sizes` are those of `world_sizes`."""
    return sizes | {"step": steps_per_tick, "place": sizes["instance"] + build.GRIPPER_BODIES, "supporter": sizes["instance"] + 1}


def allocate_record(sizes: dict[str, int], device: wp.Device, *, steps: bool, supports: bool) -> PhysicsRecord:
    """Allocate the record of a tick's physics, with steps and support or without; `sizes`: extents by `record_sizes`."""
    kinds = (StepArrays if steps else None, DropArrays, SupportArrays if supports else None)
    return PhysicsRecord(*(allocate(kind, sizes, device) if kind is not None else None for kind in kinds))


class StepRecorder:
    """Watcher that records the steps of a tick, or its support graph, or both. Its launches never change, because `Physics.tick` captures
    them in a graph. `record`: physics of the last tick, once `end_tick` was called; the next tick overwrites it."""

    def __init__(
        self,
        gripper: Gripper,
        scene: SceneData,
        state: WorldState,
        attempts: AttemptState,
        seals: SealState,
        physics: Physics,
        sizes: dict[str, int],
        *,
        steps: bool,
        supports: bool,
    ) -> None:
        """Allocate the record and scratch: `steps` and `supports`: whether steps and support are recorded, with extents by `world_sizes`.
        Poses, contact forces and joint forces are those of `physics`; the gripper's weight is subtracted from joint forces."""
        self._scene, self._state, self._attempts, self._seals, self._physics = scene, state, attempts, seals, physics
        self._device = state.phase.device
        self._sizes = record_sizes(sizes, physics.settings.steps_per_tick)
        self._steps = steps
        self.record = allocate_record(self._sizes, self._device, steps=steps, supports=supports)
        self._substep_fraction = 1.0 / physics.settings.substeps
        self._weight = (gripper.finger_mass + gripper.cup_mass) * physics.settings.gravity
        self._total = wp.zeros((sizes["body"], int(step_log.MAGNITUDE) + 1), dtype=wp.int64, device=self._device)
        self._force = wp.zeros(sizes["world"], dtype=wp.vec3, device=self._device)
        others = self._scene.layout.bodies + 1 if supports else 0
        self._supports = wp.zeros((sizes["body"], others), dtype=wp.int64, device=self._device)

    @property
    def watches(self) -> bool:
        """Whether it must see the steps of a tick."""
        return self._steps or self.record.supports is not None

    def begin_tick(self) -> None:
        """Begin the record of a tick: clear sums of support, and save the drop poses of objects that have just been dropped."""
        self._supports.zero_()
        state, drop = self._state, self.record.drops.drop_pose
        launch(step_log.save_drop_poses_kernel, state.catalog_index.shape, self._scene, state, self._physics.state, drop_out=drop)

    def begin_step(self) -> None:
        """Clear the sums of contact forces, before a step."""
        self._total.zero_()

    def save_impedance_force(self) -> None:
        """Save the impedance forces of a step, before seal forces are added to the joint forces."""
        if self._steps:
            given = {"weight": self._weight, "force_out": self._force}
            launch(step_log.save_impedance_force_kernel, self._force.shape, self._scene, self._physics.control, **given)

    def after_solve(self, contact_f: wp.array) -> None:
        """Add the contact forces of a solver substep: the force of each contact on its first shape (contact) spatial vector [N]."""
        physics, given = self._physics, {"contact_force": contact_f, "total_inout": self._total, "contacts": contact_arrays(self._physics)}
        if self._steps:
            launch(step_log.sum_contacts_kernel, physics.contacts.rigid_contact_max, **given)
        if self.record.supports is not None:
            given["total_inout"] = self._supports
            launch(step_log.sum_supports_kernel, physics.contacts.rigid_contact_max, self._scene, **given)

    def end_step(self, step: int, current: newton.State) -> None:
        """Record step `step` of the tick from the state at its end."""
        log, worlds = self.record.steps, self._sizes["world"]
        if log is None:
            return
        places, sources = (worlds, self._sizes["place"]), (self._scene, self._state)
        launch(step_log.record_motion_kernel, places, *sources, current, step=step, log=log.bundle)
        given = {"substep_fraction": self._substep_fraction, "total": self._total}
        launch(step_log.record_forces_kernel, places, *sources, self._seals, step=step, out=log, **given)
        launch(step_log.record_gripper_kernel, worlds, *sources, self._attempts, self._seals, step=step, out=log, force=self._force)

    def end_tick(self) -> None:
        """Complete the record at the end of a tick."""
        supports = self.record.supports
        if supports is not None:
            scale = self._substep_fraction / (self._physics.settings.steps_per_tick * float(step_log.COUNTS_PER_NEWTON))
            given = {"scale": scale, "total": self._supports, "out": supports}
            launch(step_log.record_supports_kernel, supports.support.shape, self._scene, self._state, **given)
        wp.copy(self.record.drops.progress, self._state.progress)


def record_arrays(record: PhysicsRecord) -> list[wp.array]:
    """List the arrays of a record, in the order that `host_record` expects."""
    parts = (record.steps, record.drops, record.supports)
    return [getattr(part, item.name) for part in parts if part is not None for item in fields(part)]


def host_record(record: PhysicsRecord, arrays: list[np.ndarray], instances: int) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Convert a record, by its `record_arrays`, copied to the host, to the arrays of `TickBatch.tick` and `TickBatch.steps`, by their names
    in data sets; `instances`: capacity of a world.

    Forces of cups are left out for a gripper of one cup, whose forces are those of the instances' seals."""
    parts = (record.steps, record.drops, record.supports)
    values = dict(zip((item.name for part in parts if part is not None for item in fields(part)), arrays, strict=True))
    tick = {"drop_pose": values["drop_pose"], "redrops": values["progress"][:, 2]}
    if "support" in values:
        tick |= {"support": values["support"][..., :instances], "static_support": values["support"][..., instances]}
    steps = _split_places(values, instances)
    cups = steps.pop("cup_force", None)
    if cups is not None and cups.shape[2] > 1:
        steps["cup_force"] = np.pad(cups, ((0, 0), (0, 0), (0, MAX_CUPS - cups.shape[2])))
    return tick, steps


def _split_places(arrays: Mapping[str, np.ndarray], instances: int) -> dict[str, np.ndarray]:
    """Split arrays by place into those of objects and those of the gripper, named `gripper_*`."""
    steps = {}
    for item in fields(StepArrays):
        if item.name not in arrays:
            continue
        values = arrays[item.name]
        if "place" in item.metadata["array"].shape:
            steps[item.name] = values[:, :, :instances]
            steps[f"gripper_{item.name}"] = values[:, :, instances:]
        else:
            steps[item.name] = values
    return steps


def tick_measures(columns: Mapping[str, np.ndarray], sets: Mapping[str, np.ndarray], instances: int) -> dict[str, np.ndarray]:
    """Select the columns of physics and attempts for `TickBatch.tick` from those (world) of status and measures, by `codes.column_names`;
    bit sets of instances (world, word) uint32 are unpacked to (world, instance) uint8, for `instances` instances of a world."""
    result = {name: columns[name] for name in ("phase", "mode", "task", "attempt", "outcome", "target", "hits", "peak_force")}
    return result | {name: unpack_words(words, instances) for name, words in sets.items()}
