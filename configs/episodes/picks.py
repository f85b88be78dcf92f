"""Settings of grasp trials: how many states and candidates are tried, how a trial runs, and how its repeats are perturbed."""

from __future__ import annotations

from dataclasses import dataclass

from synpick_warp.configs.fields import INT32_MAX, setting

PICKS = "picks"
"""Format that has the trials."""


@dataclass(frozen=True)
class Picks:
    """Grasp trials of the format picks: states saved at moments of choice of ordinary episodes, in each of which many grasps are tried."""

    states: int = setting(
        4,
        "",
        "Maximum number of an episode's states: its attempts 0, s, 2 s and so on, where s spreads them evenly over as many attempts as "
        "the episode begins with objects.",
        low=1,
        high=INT32_MAX,
    )
    candidates: int = setting(
        64, "", "Grasp candidates of a state: the episode's own grasp, and samples of the surfaces that perception sees.", low=1, high=65536
    )
    uniform: float = setting(
        0.2,
        "",
        "Share of the samples that are uniform over visible pixels; the others are stratified over instances and analytic scores.",
        low=0.0,
        high=1.0,
    )
    repeats: int = setting(1, "", "Trials of each candidate; all but the first are perturbed.", low=1, high=4096)
    offset: float = setting(1e-3, "m", "Half width of the perturbation of the grasp point along each axis.", low=0.0, high=1.0)
    angle: float = setting(2.0, "°", "Half width of the perturbation of the cup's rotation about each axis.", low=0.0, high=45.0)
    friction: float = setting(0.2, "", "Half width of the perturbation of all friction coefficients, as a fraction.", low=0.0, high=1.0)
    near: float = setting(
        0.02,
        "m",
        "Distance to the grasp point at which the gripper appears, on the surface normal, and descends at pick.near_speed; 0: it takes the "
        "path of an attempt.",
        low=0.0,
        high=10.0,
    )
    lift_height: float = setting(0.15, "m", "Height of the lift, at pick.lift_speed.", above=0.0, high=10.0)
    hold: float = setting(0.3, "s", "Time for which the gripper holds still after the lift before the trial is judged.", low=0.0, high=60.0)
    settle: float = setting(0.0, "s", "Time for which the other objects settle before their displacement is measured.", low=0.0, high=60.0)
    worlds: int = setting(0, "", "Worlds in which trials run, beside those of the episodes; 0: chosen by device.", low=0, high=INT32_MAX)
