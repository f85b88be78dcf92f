"""Grippers alone in their worlds under impedance control, with the contact forces that the solver computes."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from synpick_warp.configs.schema import Config
from synpick_warp.kernels.sim.gripper import impedance_force
from synpick_warp.scenes import build
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.sim.physics import Physics

wp.set_module_options({"enable_backward": False})


@wp.kernel
def pull_kernel(
    dofs: int,
    coords: int,
    weight: float,
    step: float,
    law: wp.array2d[float],
    setpoint_velocity: wp.array[wp.vec3],
    joint_q: wp.array[float],
    joint_qd: wp.array[float],
    setpoint_inout: wp.array[wp.vec3],
    joint_f_out: wp.array[float],
    force_out: wp.array[wp.vec3],
):
    """Advance each setpoint by a step and apply impedance force and gravity compensation. law: stiffness, damping, limit, mass, step."""
    world = wp.tid()
    setpoint_inout[world] = setpoint_inout[world] + step * setpoint_velocity[world]
    q = world * coords
    qd = world * dofs
    offset = setpoint_inout[world] - wp.vec3(joint_q[q], joint_q[q + 1], joint_q[q + 2])
    velocity = wp.vec3(joint_qd[qd], joint_qd[qd + 1], joint_qd[qd + 2])
    force = impedance_force(offset, velocity, law[world, 0], law[world, 1], law[world, 2], law[world, 3], law[world, 4])
    force_out[world] = force
    for axis in range(3):
        joint_f_out[qd + axis] = force[axis]
    joint_f_out[qd + 2] = force[2] + weight


@dataclass(frozen=True, eq=False)
class Pulled:
    """Recorded motion and forces. The first axis of arrays is the step."""

    position: np.ndarray
    """Wrist (step, world, 3) [m]."""
    tilt: np.ndarray
    """Tilt of the cup (step, world) [rad]."""
    velocity: np.ndarray
    """Velocity of the gripper shaft (step, world, 3) [m/s]."""
    force: np.ndarray
    """Force of the impedance law (step, world, 3) [N]."""
    contact: np.ndarray
    """Sum of the forces of all contacts on the cup in each solver step (step, substep, world, 3) [N]."""


def pull(
    config: Config,
    catalog: Catalog,
    device: wp.Device,
    law: np.ndarray,
    start: np.ndarray,
    setpoint: np.ndarray,
    setpoint_velocity: np.ndarray,
    steps: int,
) -> Pulled:
    """Simulate grippers in `bake.worlds` worlds without objects, at rest at `start`, each with its own law and setpoint.

    Args:
        config: Settings; time step, substeps and gripper are used.
        catalog: Objects; none of them is in a world.
        device: Device of the simulation.
        law: Stiffness [N/m], damping [N·s/m], force limit [N] (world, 3).
        start: Wrist (world, 3) [m].
        setpoint: First setpoints (world, 3) [m].
        setpoint_velocity: Their velocities (world, 3) [m/s].
        steps: Duration in steps.
    """
    built = build.build_model(config, catalog, device)
    physics, layout = Physics(config.physics, built), built.layout
    mass = config.gripper.finger_mass + config.gripper.cup_mass
    laws = np.column_stack([law, np.full(layout.worlds, mass), np.full(layout.worlds, config.physics.step)])
    inputs = [layout.dofs_per_world, layout.coords_per_world, mass * config.physics.gravity, config.physics.step]
    inputs += [wp.array(laws.astype(np.float32), dtype=float, device=device)]
    velocity_array, setpoint_array = (
        wp.array(values.astype(np.float32), dtype=wp.vec3, device=device) for values in (setpoint_velocity, setpoint)
    )
    force = wp.zeros(layout.worlds, dtype=wp.vec3, device=device)
    _place(physics, start)
    current, following = physics.state, physics.model.state()
    observables = physics.solver.observables({physics.solver.ObservableKind.CONTACT_F}, contacts=physics.contacts)
    substep = config.physics.step / config.physics.substeps
    rows = []
    for _ in range(steps):
        arrays = [velocity_array, current.joint_q, current.joint_qd, setpoint_array]
        wp.launch(pull_kernel, dim=layout.worlds, inputs=inputs + arrays, outputs=[physics.control.joint_f, force], device=device)
        contact = []
        for _ in range(config.physics.substeps):
            physics.pipeline.collide(current, physics.contacts)
            physics.solver.step(current, following, physics.control, physics.contacts, substep, observables=observables)
            current, following = following, current
            contact.append(_on_cups(physics, observables.contact_f))
        coordinates = current.joint_q.numpy().reshape(layout.worlds, -1)
        speeds = current.joint_qd.numpy().reshape(layout.worlds, -1)
        rows.append((coordinates[:, :3].copy(), coordinates[:, 3].copy(), speeds[:, :3].copy(), force.numpy().copy(), np.array(contact)))
    return Pulled(*(np.stack(column).astype(float) for column in zip(*rows, strict=True)))


def _place(physics: Physics, start: np.ndarray) -> None:
    """Place the wrists at `start` (world, 3) [m], cups upright."""
    coordinates = physics.state.joint_q.numpy().reshape(physics.layout.worlds, -1)
    coordinates[:, : build.GRIPPER_DOFS] = np.pad(start, ((0, 0), (0, 1)))
    physics.state.joint_q.assign(coordinates.reshape(-1).astype(np.float32))
    physics.refresh_poses()


def _on_cups(physics: Physics, contact_f: wp.array) -> np.ndarray:
    """Sum of contact forces on every world's cup (world, 3) [N]; the solver tells of the force on shape 0."""
    layout, contacts = physics.layout, physics.contacts
    count = int(contacts.rigid_contact_count.numpy()[0])
    forces = contact_f.numpy()[:count, :3]
    shapes = [array.numpy()[:count] for array in (contacts.rigid_contact_shape0, contacts.rigid_contact_shape1)]
    total = np.zeros((layout.worlds, 3))
    for shape, sign in zip(shapes, (1.0, -1.0), strict=True):
        cup = np.isin(shape % layout.shapes_per_world, layout.head_shapes)
        np.add.at(total, shape[cup] // layout.shapes_per_world, sign * forces[cup])
    return total
