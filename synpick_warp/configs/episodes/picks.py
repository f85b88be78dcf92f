"""Settings of grasp trials: numbers of states and candidates, course of a trial, and perturbation of its repeats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from synpick_warp.configs.fields import INT32_MAX, Fraction, Within, above, setting

PICKS = "picks"
"""Output format of grasp trials."""


@dataclass(frozen=True)
class Picks:
    """Grasp trials (format picks): states of episodes are saved when an attempt is planned, and many grasps are tried from each state."""

    states: Annotated[int, Within(1, INT32_MAX)] = setting(
        4,
        "Maximum number of saved states of an episode, before its attempts 0, s, 2 s and so on. The stride s spreads them evenly over as "
        "many attempts as the episode begins with objects.",
    )
    candidates: Annotated[int, Within(1, 65536)] = setting(
        64, "Grasp candidates per state: the episode's own grasp, and sampled pixels of the perception image."
    )
    uniform: Fraction = setting(
        0.2, "Fraction of the samples that are uniform over visible pixels; the others are stratified by instance and analytic score."
    )
    repeats: Annotated[int, Within(1, 4096)] = setting(1, "Trials per candidate; all but the first are perturbed.")
    offset: Annotated[float, Within(0.0, 1.0, "m")] = setting(
        1e-3, "Half width of the uniform perturbation of the grasp point along each axis."
    )
    angle: Annotated[float, Within(0.0, 45.0, "°")] = setting(
        2.0, "Half width of the uniform perturbation of the cup's rotation about each axis."
    )
    friction: Fraction = setting(0.2, "Half width of a uniform factor about 1 on all friction coefficients.")
    near: Annotated[float, Within(0.0, 10.0, "m")] = setting(
        0.02,
        "Distance from the grasp point along the surface normal at which the gripper appears; it descends at pick.near_speed. 0: it "
        "approaches as in an attempt.",
    )
    lift_height: Annotated[float, above(0.0, 10.0, "m")] = setting(0.15, "Height of the lift, at pick.lift_speed.")
    hold: Annotated[float, Within(0.0, 60.0, "s")] = setting(
        0.3, "Time for which the gripper holds still between the lift and the outcome, to the nearest tick."
    )
    settle: Annotated[float, Within(0.0, 60.0, "s")] = setting(
        0.0, "Time between the outcome and the measurement of the other objects' displacements."
    )
    worlds: Annotated[int, Within(0, INT32_MAX)] = setting(
        0, "Number of worlds for trials, in addition to those of the episodes; 0: chosen by device."
    )
