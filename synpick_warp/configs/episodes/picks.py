"""Settings of grasp trials: numbers of states and candidates, course of a trial, and perturbation of its repeats."""

from __future__ import annotations

from dataclasses import dataclass

from synpick_warp.configs.fields import INT32_MAX, setting

PICKS = "picks"
"""Output format of grasp trials."""


@dataclass(frozen=True)
class Picks:
    """Grasp trials (format picks): states of episodes are saved when an attempt is planned, and many grasps are tried from each state."""

    states: int = setting(
        4,
        "",
        "Maximum number of saved states of an episode, before its attempts 0, s, 2 s and so on. The stride s spreads them evenly over as "
        "many attempts as the episode begins with objects.",
        low=1,
        high=INT32_MAX,
    )
    candidates: int = setting(
        64, "", "Grasp candidates per state: the episode's own grasp, and sampled pixels of the perception image.", low=1, high=65536
    )
    uniform: float = setting(
        0.2,
        "",
        "Fraction of the samples that are uniform over visible pixels; the others are stratified by instance and analytic score.",
        low=0.0,
        high=1.0,
    )
    repeats: int = setting(1, "", "Trials per candidate; all but the first are perturbed.", low=1, high=4096)
    offset: float = setting(1e-3, "m", "Half width of the uniform perturbation of the grasp point along each axis.", low=0.0, high=1.0)
    angle: float = setting(2.0, "°", "Half width of the uniform perturbation of the cup's rotation about each axis.", low=0.0, high=45.0)
    friction: float = setting(0.2, "", "Half width of a uniform factor about 1 on all friction coefficients.", low=0.0, high=1.0)
    near: float = setting(
        0.02,
        "m",
        "Distance from the grasp point along the surface normal at which the gripper appears; it descends at pick.near_speed. 0: it "
        "approaches as in an attempt.",
        low=0.0,
        high=10.0,
    )
    lift_height: float = setting(0.15, "m", "Height of the lift, at pick.lift_speed.", above=0.0, high=10.0)
    hold: float = setting(
        0.3, "s", "Time for which the gripper holds still between the lift and the outcome, to the nearest tick.", low=0.0, high=60.0
    )
    settle: float = setting(
        0.0, "s", "Time between the outcome and the measurement of the other objects' displacements.", low=0.0, high=60.0
    )
    worlds: int = setting(
        0, "", "Number of worlds for trials, in addition to those of the episodes; 0: chosen by device.", low=0, high=INT32_MAX
    )
