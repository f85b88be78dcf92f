"""Head of a gripper: what a kind of gripper has of its own, beyond the mechanism that all share."""

from __future__ import annotations

from dataclasses import dataclass

from synpick_warp.scenes.types import ConvexPiece, Fixture

SIDES = 40
"""Points per ring of the visual meshes."""
COLLIDER_SIDES = 12
"""Points per ring of the collision shapes."""


@dataclass(frozen=True, eq=False)
class Head:
    """Body on the wrist with its suction cups, in a frame whose origin lies on the wrist axis, which is y; z up."""

    fixture: Fixture
    """Visual mesh and material."""
    pieces: tuple[ConvexPiece, ...]
    """Collision shapes."""
    inertia: tuple[float, float, float]
    """Principal moments about the centre of mass, in the axes of the frame [kg·m²]."""
    cups: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    """(x, y) of the centre of each cup's lip, in the plane of the tool centre point [m]."""
    has_common_valve: bool = False
    """Whether a leak at one cup spoils the vacuum of all."""


def rod_inertia(mass: float, length: float) -> tuple[float, float, float]:
    """Principal moments of inertia [kg·m²] of a cylinder along z whose diameter is a quarter of its length, as for shaft and cup."""
    radius = length / 8
    across = mass * (length**2 + 3 * radius**2) / 12
    return across, across, mass * radius**2 / 2
