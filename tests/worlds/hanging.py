"""Boxes of given masses attached to cups in the real physics, lifted by a scripted gripper."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import newton
import numpy as np

from synpick_warp.scenes import build
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.constants import make_scene_data
from synpick_warp.stages.render.scene import build_meshes
from synpick_warp.stages.sim.behavior import BEHAVIORS
from synpick_warp.stages.sim.physics import Physics, Watcher
from synpick_warp.stages.sim.worlds import AttemptState, SealState, WorldState, world_sizes
from tests.twins.raycast import rotation_of
from tests.worlds.small_worlds import catalog, settings

Size = tuple[float, float, float]
HEIGHT = 1.0
"""Height of the wrist at the start [m]: far above the tote."""
COARSE = {"physics__steps_per_tick": 1, "physics__iterations": 4, "physics__rows_per_world": 96, "physics__contacts_per_world": 48}
"""Overrides: one step per tick, and the small capacities that suffice for bodies in the air."""
ROOM = 0.02
"""Volume for one object [m³]."""


class HookedPhysics(Physics):
    """Physics with one step per tick, whose `before_step` callback may compute on the host: it runs before the captured graph."""

    def tick_parts(
        self, before_step: Callable[[newton.State], None], after_collide: Callable[[], None] | None = None, watcher: Watcher | None = None
    ) -> Iterator[None]:
        assert self.settings.steps_per_tick == 1
        before_step(self.state)
        yield from super().tick_parts(lambda _: None, after_collide, watcher)


class Hanging:
    """Worlds in which every object is attached by a seal from the start; object `instance` of world `world` has its own mass."""

    def __init__(
        self,
        device,
        masses: Sequence[Sequence[float]],
        sizes: Sequence[Sequence[Size]] = (),
        shapes: Sequence[Any] = (),
        **overrides: object,
    ) -> None:
        """Masses [kg] and sizes [m] of boxes, or other objects of a catalog, by world and instance."""
        self.mass = np.asarray(masses, float)
        self.worlds, self.instances = self.mass.shape
        self.size = np.asarray(sizes or np.zeros((*self.mass.shape, 3)), float).reshape(*self.mass.shape, 3)
        room = {"arrangement__max_objects": self.instances, "arrangement__volume": ROOM * self.instances}
        self.config = settings(bake__worlds=self.worlds, **{**COARSE, **room, **overrides})
        boxes = shapes or catalog(*[(tuple(size),) for size in self.size.reshape(-1, 3)]).entries
        entries = tuple(
            replace(box, mass=mass, inertia=box.inertia * mass / box.mass) for box, mass in zip(boxes, self.mass.reshape(-1), strict=True)
        )
        self.inertia = np.stack([entry.inertia for entry in entries]).reshape(self.worlds, self.instances, 3, 3)
        objects = Catalog(entries)
        built = build.build_model(self.config, objects, device)
        self.layout, self.physics = built.layout, HookedPhysics(self.config.physics, built)
        self.scene = make_scene_data(self.config, objects, built, 1, device)
        sizes = (self.worlds, self.instances, self.config.move.rounds, built.layout.bodies_per_world, len(built.head.cups))
        extents = world_sizes(*sizes)
        self.state, self.attempts, self.seals = (allocate(kind, extents, device) for kind in (WorldState, AttemptState, SealState))
        meshes, keep = build_meshes([entry.mesh for entry in entries], len(entries), device)
        scene = SimpleNamespace(meshes=meshes, keep=keep)
        self.suction = BEHAVIORS[self.config.gripper.kind].hold(self.config.suction, objects, scene, device)
        order = np.arange(self.mass.size).reshape(self.mass.shape)
        self.state.catalog_index.assign(order)
        self.state.body_slot.assign(np.tile(np.arange(self.instances), (self.worlds, 1)))
        variant = np.full((self.worlds, built.layout.bodies_per_world), -1)
        variant[:, build.GRIPPER_BODIES : build.GRIPPER_BODIES + self.instances] = built.variant[order]
        self.state.variant.assign(variant.reshape(-1))
        self.state.restarted.fill_(True)
        self.gripper_mass = self.config.gripper.finger_mass + self.config.gripper.cup_mass
        self.carried, self.ignoring = True, True
        self.setpoint, self.speed = np.zeros((self.worlds, 3)), np.zeros(3)

    def start(self, place: np.ndarray, break_force: float = 40.0, quaternion: Sequence[float] = (0.0, 0.0, 0.0, 1.0)) -> None:
        """Reset to rest with upright cups; attach the objects with centres at `place` (world, instance, 3) relative to the TCP [m]."""
        tcp = np.array([0.0, 0.0, HEIGHT - self.config.gripper.cup_length])
        turn = np.broadcast_to(quaternion, (self.worlds, self.instances, 4))
        first = build.GRIPPER_DOFS
        coordinates = self.physics.state.joint_q.numpy().reshape(self.worlds, -1)
        coordinates[:, :first] = (0.0, 0.0, HEIGHT, 0.0)
        coordinates[:, first : first + 7 * self.instances] = np.concatenate([tcp + place, turn], axis=2).reshape(self.worlds, -1)
        self.physics.state.joint_q.assign(coordinates.reshape(-1))
        self.physics.state.joint_qd.zero_()
        self.physics.control.joint_f.zero_()
        self.physics.load(self.state.variant, self.state.restarted)
        self.physics.clear_graphs()
        self.seals.object_in_tcp.assign(np.concatenate([place, turn], axis=2))
        self.seals.attached.fill_((1 << self.scene.cups.count) - 1)
        self.seals.break_force.fill_(break_force)
        self.seals.peak.zero_()
        self.setpoint[:], self.speed[:] = (0.0, 0.0, HEIGHT), 0.0

    def run(self, steps: int) -> np.ndarray:
        """Run steps; return the seal forces (step, world, instance) [N]."""
        forces = []
        for _ in range(steps):
            self.physics.tick(self.drive, self.ignore)
            forces.append(self.seals.seal_force.numpy().copy())
        return np.array(forces)

    def drive(self, current) -> None:
        """Apply the impedance control of picking, or nothing, and the seal forces."""
        pick, step = self.config.pick, self.config.physics.step
        self.setpoint += step * self.speed
        offset = self.setpoint - current.joint_q.numpy().reshape(self.worlds, -1)[:, :3]
        velocity = current.joint_qd.numpy().reshape(self.worlds, -1)[:, :3]
        gain = 1.0 + (pick.damping * step + pick.stiffness * step**2) / self.gripper_mass
        force = self.physics.control.joint_f.numpy().reshape(self.worlds, -1)
        force[:, : build.GRIPPER_DOFS] = 0.0
        if self.carried:
            force[:, :3] = (pick.stiffness * (offset - step * velocity) - pick.damping * velocity) / gain
            force[:, 2] += self.gripper_mass * self.config.physics.gravity
        self.physics.control.joint_f.assign(force.reshape(-1))
        self.suction.apply_forces(self.scene, self.state, self.seals, self.physics, current)

    def ignore(self) -> None:
        """Disable contacts of cups with their attached objects."""
        if self.ignoring:
            self.suction.ignore_contacts(self.scene, self.state, self.seals, self.physics)

    def bodies(self) -> tuple[np.ndarray, np.ndarray]:
        """Poses (world, body, 7) and velocities (world, body, 6): gripper shaft, cup, objects."""
        count = build.GRIPPER_BODIES + self.instances
        state = self.physics.state
        return tuple(
            array.numpy().reshape(self.worlds, -1, width)[:, :count].astype(float)
            for array, width in ((state.body_q, 7), (state.body_qd, 6))
        )  # type: ignore[return-value]

    def swing(self) -> np.ndarray:
        """Angle between each cup's axis and that of its first object, which was upright when it was attached (world) [°]."""
        poses, _ = self.bodies()
        axes = [np.stack([rotation_of(pose[3:])[:, 2] for pose in poses[:, body]]) for body in (1, 2)]
        return np.degrees(np.arccos(np.clip((axes[0] * axes[1]).sum(axis=1), -1.0, 1.0)))

    def momentum(self) -> np.ndarray:
        """Linear momentum of gripper and objects together (world, 3) [N·s]."""
        _, velocity = self.bodies()
        gripper = self.config.gripper.finger_mass * velocity[:, 0, :3] + self.config.gripper.cup_mass * velocity[:, 1, :3]
        return gripper + np.einsum("wi,wic->wc", self.mass, velocity[:, 2:, :3])

    def energy(self) -> np.ndarray:
        """Kinetic energy of gripper and objects together (world) [J], without the cup's rotation."""
        poses, velocity = self.bodies()
        gripper = np.tile([self.config.gripper.finger_mass, self.config.gripper.cup_mass], (self.worlds, 1))
        masses = np.concatenate([gripper, self.mass], axis=1)
        total = 0.5 * np.einsum("wb,wbc,wbc->w", masses, velocity[:, :, :3], velocity[:, :, :3])
        for world in range(self.worlds):
            for instance in range(self.instances):
                spin = rotation_of(poses[world, 2 + instance, 3:]).T @ velocity[world, 2 + instance, 3:]
                total[world] += 0.5 * spin @ self.inertia[world, instance] @ spin
        return total
