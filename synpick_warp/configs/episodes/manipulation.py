"""Settings of the gripper's tasks: stirring, picking, targeted picking, perception, and grasp trials."""

from dataclasses import dataclass
from typing import Annotated

from synpick_warp.configs.fields import INT32_MAX, Fraction, setting

SAME, ANOTHER = "same", "another"
"""Targets after a failed attempt."""
MASK, FLAT = "mask", "flat"
"""Rules of the grasp point."""


@dataclass(frozen=True)
class Move:
    """Mode move: the gripper, with locked wrist, visits the corners of the tote and stirs the pile."""

    stiffness: Annotated[float, "(0, 1e6] N/m"] = setting(1000.0, "Stiffness of the impedance controller (paper).")
    damping: Annotated[float, "[0, 1e5] N·s/m"] = setting(
        60.0, "Damping of the impedance controller; not in the paper, released: 1, with which objects penetrate by 7 mm."
    )
    force: Annotated[float, "(0, 1e5] N"] = setting(30.0, "Force limit of the impedance controller (paper).")
    speed: Annotated[float, "[1e-3, 100] m/s"] = setting(0.1, "Speed of the setpoint (paper).")
    corner: Annotated[float, "(0, 1]"] = setting(0.75, "Visited corners, as a fraction of half the inner floor's size (released).")
    height: Annotated[float, "[0, 10] m"] = setting(0.02, "Height of the TCP above the floor at a corner (released).")
    start_height: Annotated[float, "(0, 10] m"] = setting(
        0.35, "Height of the TCP above the floor in the first frame, over the first corner."
    )
    rounds: Annotated[int, f"[1, {INT32_MAX // 4}]"] = setting(
        2, "Rounds over all four corners (released: eight corners, drawn with replacement)."
    )
    repeats: bool = setting(True, "Whether an episode may contain several instances of an object (paper: yes).")


@dataclass(frozen=True)
class Pick:
    """Modes pick and target: look, approach, grasp, lift, until the tote is empty or too many attempts have failed."""

    stiffness: Annotated[float, "(0, 1e6] N/m"] = setting(2500.0, "Stiffness of the impedance controller (paper).")
    damping: Annotated[float, "[0, 1e5] N·s/m"] = setting(200.0, "Damping of the impedance controller (paper).")
    force: Annotated[float, "(0, 1e5] N"] = setting(200.0, "Force limit of the impedance controller (paper).")
    appear_height: Annotated[float, "(0, 10] m"] = setting(1.0, "Height above the grasp point at which the gripper appears (released).")
    speed: Annotated[float, "[1e-3, 100] m/s"] = setting(1.0, "Speed of the setpoint in the approach (released).")
    near: Annotated[float, "[0, 10] m"] = setting(
        0.05, "Distance to the grasp point below which the setpoint is slow, along the surface normal (released)."
    )
    near_speed: Annotated[float, "[1e-3, 100] m/s"] = setting(0.1, "Speed of the setpoint within that distance (released).")
    press_time: Annotated[float, "[0, 60] s"] = setting(
        0.1, "Time for which the setpoint rests at the grasp point, until the lagging cup makes contact."
    )
    lift_height: Annotated[float, "(0, 10] m"] = setting(1.0, "Height by which the setpoint is lifted (released).")
    lift_speed: Annotated[float, "[1e-3, 100] m/s"] = setting(0.5, "Speed of the setpoint while lifting (released).")
    failures: Annotated[int, f"[1, {INT32_MAX}]"] = setting(3, "Failed attempts that end the episode (paper: 3; released: 4).")
    forgive: bool = setting(False, "A successful pick resets the count of failed attempts.")
    retry: str = setting(
        SAME,
        "Target after a failed attempt: same (as if none had failed) or another (one that has not failed since the last success; one that "
        "has failed is grasped at a random point, flat if possible).",
        choices=(SAME, ANOTHER),
    )
    floor: Annotated[float, "[-10, 0] m"] = setting(-0.1, "Objects below this height are removed from the scene (released).")
    repeats: bool = setting(False, "Whether an episode may contain several instances of an object (paper: no).")


@dataclass(frozen=True)
class Target:
    """Mode target: as mode pick, but for the most occluded object. The released generator has these two rules; the paper's 687 frames per
    sequence need them.
    """

    forgive: bool = setting(True, "A successful pick resets the count of failed attempts (released).")
    random_after_failure: bool = setting(True, "After a failed attempt, draw the next target at random (released).")


@dataclass(frozen=True)
class Perception:
    """Perception of the gripper: suction points and clutter graph from a camera's segmentation, without the gripper."""

    resolution: Annotated[tuple[int, int], "[16, 8192] px"] = setting(
        (1920, 1080), "Image width and height; the horizontal field of view is the camera's."
    )
    camera: str = setting("", "Name of the camera; empty: the first.")
    views: Annotated[int, f"[0, {INT32_MAX}]"] = setting(0, "Images processed in one batch; 0: chosen by device and resolution.")
    contour_points: Annotated[int, f"[16, {INT32_MAX}]"] = setting(
        8192, "Capacity for the points of a contour; a longer one ends the episode."
    )
    center_fraction: Annotated[float, "[0, 10]"] = setting(
        0.8, "Centroid, or midpoint, is used if its distance to the contour exceeds this fraction of the pole's."
    )
    grasp_point: str = setting(
        MASK,
        "Grasp point: mask (pole, centroid or midpoint; paper) or flat (that point if the surface there is flat and as wide as the tool, "
        "else a random one where it is).",
        choices=(MASK, FLAT),
    )
    heavy_mass: Annotated[float, "[0, 1e6] kg"] = setting(0.8, "Mass above which objects are grasped nearer to their centroid.")
    heavy_center_fraction: Annotated[float, "[0, 10]"] = setting(0.4, "Same as center_fraction, for heavy objects.")
    contour_offset: Annotated[float, "(0, 256] px"] = setting(
        3.0, "Distance from the contour, inside and outside, at which depths are compared."
    )
    deep_distance: Annotated[float, "[0, 10] m"] = setting(
        0.02, "A neighbour lower than the suction point by more casts down-weighted occlusion votes."
    )
    deep_weight: Fraction = setting(0.1, "Weight of those votes.")
    min_votes: Annotated[float, "(0, 1e6]"] = setting(5.0, "Minimum occlusion votes for an edge of the clutter graph.")
    reach: Annotated[float, "(0, 1e3]"] = setting(
        1.2, "A neighbour casts no vote if its contour extends farther than this many bounding box diagonals."
    )
    exact_cycle: Annotated[int, "[2, 12]"] = setting(
        10, "Maximum size of a cycle in the clutter graph that is broken at minimum cost; larger ones greedily."
    )
    normal_window: Annotated[int, "[0, 256] px"] = setting(10, "Half width of the window over which the surface normal is averaged.")


PICKS = "picks"
"""Output format of grasp trials."""


@dataclass(frozen=True)
class Picks:
    """Grasp trials (format picks): states are saved when an attempt is planned, and many grasps are tried from each."""

    states: Annotated[int, f"[1, {INT32_MAX}]"] = setting(
        4, "Maximum saved states of an episode, spread evenly over as many attempts as it begins with objects."
    )
    candidates: Annotated[int, "[1, 65536]"] = setting(64, "Grasp candidates per state: the episode's own grasp, and sampled pixels.")
    uniform: Fraction = setting(
        0.2, "Fraction of samples that are uniform over visible pixels; others are stratified by instance and score."
    )
    repeats: Annotated[int, "[1, 4096]"] = setting(1, "Trials per candidate; all but the first are perturbed.")
    offset: Annotated[float, "[0, 1] m"] = setting(1e-3, "Half width of the perturbation of the grasp point along each axis.")
    angle: Annotated[float, "[0, 45] °"] = setting(2.0, "Half width of the perturbation of the cup's rotation about each axis.")
    friction: Fraction = setting(0.2, "Half width of a uniform factor about 1 on all friction coefficients.")
    near: Annotated[float, "[0, 10] m"] = setting(
        0.02,
        "Distance along the surface normal at which the gripper appears, to descend at pick.near_speed; 0: it approaches as in an attempt.",
    )
    lift_height: Annotated[float, "(0, 10] m"] = setting(0.15, "Height of the lift, at pick.lift_speed.")
    hold: Annotated[float, "[0, 60] s"] = setting(0.3, "Time for which the gripper holds still after the lift, to the nearest tick.")
    settle: Annotated[float, "[0, 60] s"] = setting(0.0, "Time from the outcome to the measurement of other objects' displacements.")
    worlds: Annotated[int, f"[0, {INT32_MAX}]"] = setting(
        0, "Worlds for trials, in addition to those of the episodes; 0: chosen by device."
    )
