"""The force that draws the gripper to its goal."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def impedance_force(offset: wp.vec3, velocity: wp.vec3, stiffness: float, damping: float, limit: float, mass: float, dt: float) -> wp.vec3:
    """Force of a spring-damper, implicit in the velocity, at most `limit` in size.

    F = (k (x_goal - x - dt v) - d v) / (1 + (d dt + k dt²) / m): the force that k (x_goal - x') - d v' gives with the
    velocity v' = v + dt F / m and position x' = x + dt v' at the end of the step. Stable for every mass.
    """
    force = (stiffness * (offset - dt * velocity) - damping * velocity) / (1.0 + (damping * dt + stiffness * dt * dt) / mass)
    size = wp.length(force)
    if size > limit:
        force = force * (limit / size)
    return force
