"""Settings of the gripper's tasks: stirring, picking, targeted picking, perception, and grasp trials."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from synpick_warp.configs.fields import INT32_MAX, Fraction, Within, above, setting

SAME, ANOTHER = "same", "another"
"""Targets after a failed attempt."""
MASK, FLAT = "mask", "flat"
"""Rules of the grasp point."""


@dataclass(frozen=True)
class Move:
    """Mode move: the gripper, with locked wrist, visits the corners of the tote and stirs the pile."""

    stiffness: Annotated[float, above(0.0, 1e6, "N/m")] = setting(1000.0, "Stiffness of the impedance controller (paper).")
    damping: Annotated[float, Within(0.0, 1e5, "N·s/m")] = setting(
        60.0,
        "Damping of the impedance controller; the paper names none, and with the released value of 1 objects penetrate each other by 7 mm.",
    )
    force: Annotated[float, above(0.0, 1e5, "N")] = setting(30.0, "Force limit of the impedance controller (paper).")
    speed: Annotated[float, Within(1e-3, 100.0, "m/s")] = setting(0.1, "Speed of the setpoint (paper).")
    corner: Annotated[float, above(0.0, 1.0)] = setting(
        0.75, "Position of the visited corners, as a fraction of half the inner floor's size (released)."
    )
    height: Annotated[float, Within(0.0, 10.0, "m")] = setting(0.02, "Height of the TCP above the floor at a corner (released).")
    start_height: Annotated[float, above(0.0, 10.0, "m")] = setting(
        0.35, "Height of the TCP above the floor in the first frame, over the first corner."
    )
    rounds: Annotated[int, Within(1, INT32_MAX // 4)] = setting(
        2, "Rounds over all four corners (released: eight corners, drawn with replacement)."
    )
    repeats: bool = setting(True, "Whether an episode may contain several instances of an object (paper: yes).")


@dataclass(frozen=True)
class Pick:
    """Modes pick and target: look, approach, grasp, lift, until the tote is empty or too many attempts have failed."""

    stiffness: Annotated[float, above(0.0, 1e6, "N/m")] = setting(2500.0, "Stiffness of the impedance controller (paper).")
    damping: Annotated[float, Within(0.0, 1e5, "N·s/m")] = setting(200.0, "Damping of the impedance controller (paper).")
    force: Annotated[float, above(0.0, 1e5, "N")] = setting(200.0, "Force limit of the impedance controller (paper).")
    appear_height: Annotated[float, above(0.0, 10.0, "m")] = setting(
        1.0, "Height above the grasp point at which the gripper appears (released)."
    )
    speed: Annotated[float, Within(1e-3, 100.0, "m/s")] = setting(1.0, "Speed of the setpoint in the approach (released).")
    near: Annotated[float, Within(0.0, 10.0, "m")] = setting(
        0.05, "Distance to the grasp point below which the setpoint is slow and moves along the surface normal (released)."
    )
    near_speed: Annotated[float, Within(1e-3, 100.0, "m/s")] = setting(0.1, "Speed of the setpoint within that distance (released).")
    press_time: Annotated[float, Within(0.0, 60.0, "s")] = setting(
        0.1, "Time for which the setpoint rests at the grasp point, so that the cup, which lags, makes contact."
    )
    lift_height: Annotated[float, above(0.0, 10.0, "m")] = setting(1.0, "Height by which the setpoint is lifted (released).")
    lift_speed: Annotated[float, Within(1e-3, 100.0, "m/s")] = setting(0.5, "Speed of the setpoint while lifting (released).")
    failures: Annotated[int, Within(1, INT32_MAX)] = setting(3, "Failed attempts that end the episode (paper: 3; released: 4).")
    forgive: bool = setting(False, "A successful pick resets the count of failed attempts: those in a row end the episode.")
    retry: str = setting(
        SAME,
        "Target after a failed attempt: same (the rule chooses as if none had failed) or another (one that has not failed since the last "
        "success; earlier failures count as objects above it, and one that has failed is grasped at a random point, flat if one is found).",
        choices=(SAME, ANOTHER),
    )
    floor: Annotated[float, Within(-10.0, 0.0, "m")] = setting(-0.1, "Objects below this height are removed from the scene (released).")
    repeats: bool = setting(False, "Whether an episode may contain several instances of an object (paper: no).")


@dataclass(frozen=True)
class Target:
    """Mode target: as mode pick, but for the most occluded object.

    The paper does not name these two rules of the released generator, but its 687 frames per sequence need them: with both the mean is
    611, without the second 449, with neither 389.
    """

    forgive: bool = setting(True, "A successful pick resets the count of failed attempts (released).")
    random_after_failure: bool = setting(True, "After a failed attempt, draw the next target at random (released).")


@dataclass(frozen=True)
class Perception:
    """Perception of the gripper: suction points and clutter graph from the segmentation that a camera sees without the gripper."""

    resolution: Annotated[tuple[int, int], Within(16, 8192, "px")] = setting(
        (1920, 1080),
        "Image width and height for perception; the horizontal field of view is the camera's, so a wider aspect ratio covers less height.",
    )
    camera: str = setting("", "Name of the camera that perception uses; empty: the first.")
    views: Annotated[int, Within(0, INT32_MAX)] = setting(0, "Images processed in one batch; 0: chosen by device and resolution.")
    contour_points: Annotated[int, Within(16, INT32_MAX)] = setting(
        8192, "Capacity for the points of one contour; a longer contour ends the episode."
    )
    center_fraction: Annotated[float, Within(0.0, 10.0)] = setting(
        0.8,
        "Centroid, or midpoint to the pole of inaccessibility, is used if its distance to the contour exceeds this fraction of the pole's.",
    )
    grasp_point: str = setting(
        MASK,
        "Rule of the grasp point: mask (pole, centroid or midpoint of the mask, as in the paper) or flat (that point if the surface around "
        "it is flat and as wide as the tool, else a random one where it is).",
        choices=(MASK, FLAT),
    )
    heavy_mass: Annotated[float, Within(0.0, 1e6, "kg")] = setting(0.8, "Mass above which objects are grasped nearer to their centroid.")
    heavy_center_fraction: Annotated[float, Within(0.0, 10.0)] = setting(0.4, "Same as center_fraction, for heavy objects.")
    contour_offset: Annotated[float, above(0.0, 256.0, "px")] = setting(
        3.0, "Distance from the contour, inside and outside, at which the depths of neighbours are compared."
    )
    deep_distance: Annotated[float, Within(0.0, 10.0, "m")] = setting(
        0.02, "A neighbour lower than the suction point by more than this casts down-weighted occlusion votes."
    )
    deep_weight: Fraction = setting(0.1, "Weight of those votes.")
    min_votes: Annotated[float, above(0.0, 1e6)] = setting(5.0, "Minimum occlusion votes for an edge of the clutter graph.")
    reach: Annotated[float, above(0.0, 1e3)] = setting(
        1.2, "A neighbour casts no vote if its contour extends farther from the compared pixel than this many bounding box diagonals."
    )
    exact_cycle: Annotated[int, Within(2, 12)] = setting(
        10, "Maximum size of a cycle in the clutter graph that is broken at minimum cost; larger cycles are broken greedily."
    )
    normal_window: Annotated[int, Within(0, 256, "px")] = setting(
        10, "Half width of the window around the suction point over which the surface normal is averaged."
    )


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
