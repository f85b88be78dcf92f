"""Settings of the gripper's tasks: stirring, picking, targeted picking, and perception."""

from __future__ import annotations

from dataclasses import dataclass

from synpick_warp.configs.fields import INT32_MAX, setting

SAME, ANOTHER = "same", "another"
"""Targets after a failed attempt."""
MASK, FLAT = "mask", "flat"
"""Rules of the grasp point."""


@dataclass(frozen=True)
class Move:
    """Mode move: the gripper, with locked wrist, visits the corners of the tote and stirs the pile."""

    stiffness: float = setting(1000.0, "N/m", "Stiffness of the impedance controller (paper).", above=0.0, high=1e6)
    damping: float = setting(
        60.0,
        "N·s/m",
        "Damping of the impedance controller; the paper names none, and with the released value of 1 objects penetrate each other by 7 mm.",
        low=0.0,
        high=1e5,
    )
    force: float = setting(30.0, "N", "Force limit of the impedance controller (paper).", above=0.0, high=1e5)
    speed: float = setting(0.1, "m/s", "Speed of the setpoint (paper).", low=1e-3, high=100.0)
    corner: float = setting(
        0.75, "", "Position of the visited corners, as a fraction of half the inner floor's size (released).", above=0.0, high=1.0
    )
    height: float = setting(0.02, "m", "Height of the TCP above the floor at a corner (released).", low=0.0, high=10.0)
    start_height: float = setting(
        0.35, "m", "Height of the TCP above the floor in the first frame, over the first corner.", above=0.0, high=10.0
    )
    rounds: int = setting(
        2, "", "Rounds over all four corners (released: eight corners, drawn with replacement).", low=1, high=INT32_MAX // 4
    )
    repeats: bool = setting(True, "", "Whether an episode may contain several instances of an object (paper: yes).")


@dataclass(frozen=True)
class Pick:
    """Modes pick and target: look, approach, grasp, lift, until the tote is empty or too many attempts have failed."""

    stiffness: float = setting(2500.0, "N/m", "Stiffness of the impedance controller (paper).", above=0.0, high=1e6)
    damping: float = setting(200.0, "N·s/m", "Damping of the impedance controller (paper).", low=0.0, high=1e5)
    force: float = setting(200.0, "N", "Force limit of the impedance controller (paper).", above=0.0, high=1e5)
    appear_height: float = setting(1.0, "m", "Height above the grasp point at which the gripper appears (released).", above=0.0, high=10.0)
    speed: float = setting(1.0, "m/s", "Speed of the setpoint in the approach (released).", low=1e-3, high=100.0)
    near: float = setting(
        0.05,
        "m",
        "Distance to the grasp point below which the setpoint is slow and moves along the surface normal (released).",
        low=0.0,
        high=10.0,
    )
    near_speed: float = setting(0.1, "m/s", "Speed of the setpoint within that distance (released).", low=1e-3, high=100.0)
    press_time: float = setting(
        0.1, "s", "Time for which the setpoint rests at the grasp point, so that the cup, which lags, makes contact.", low=0.0, high=60.0
    )
    lift_height: float = setting(1.0, "m", "Height by which the setpoint is lifted (released).", above=0.0, high=10.0)
    lift_speed: float = setting(0.5, "m/s", "Speed of the setpoint while lifting (released).", low=1e-3, high=100.0)
    failures: int = setting(3, "", "Failed attempts that end the episode (paper: 3; released: 4).", low=1, high=INT32_MAX)
    forgive: bool = setting(False, "", "A successful pick resets the count of failed attempts: those in a row end the episode.")
    retry: str = setting(
        SAME,
        "",
        "Target after a failed attempt: same (the rule chooses as if none had failed) or another (one that has not failed since the last "
        "success; earlier failures count as objects above it, and one that has failed is grasped at a random point, flat if one is found).",
        choices=(SAME, ANOTHER),
    )
    floor: float = setting(-0.1, "m", "Objects below this height are removed from the scene (released).", low=-10.0, high=0.0)
    repeats: bool = setting(False, "", "Whether an episode may contain several instances of an object (paper: no).")


@dataclass(frozen=True)
class Target:
    """Mode target: as mode pick, but for the most occluded object.

    The paper does not name these two rules of the released generator, but its 687 frames per sequence need them: with both the mean is
    611, without the second 449, with neither 389.
    """

    forgive: bool = setting(True, "", "A successful pick resets the count of failed attempts (released).")
    random_after_failure: bool = setting(True, "", "After a failed attempt, draw the next target at random (released).")


@dataclass(frozen=True)
class Perception:
    """Perception of the gripper: suction points and clutter graph from the segmentation that a camera sees without the gripper."""

    resolution: tuple[int, int] = setting(
        (1920, 1080),
        "px",
        "Image width and height for perception; the horizontal field of view is the camera's, so a wider aspect ratio covers less height.",
        low=16,
        high=8192,
    )
    camera: str = setting("", "", "Name of the camera that perception uses; empty: the first.")
    views: int = setting(0, "", "Images processed in one batch; 0: chosen by device and resolution.", low=0, high=INT32_MAX)
    contour_points: int = setting(
        8192, "", "Capacity for the points of one contour; a longer contour ends the episode.", low=16, high=INT32_MAX
    )
    center_fraction: float = setting(
        0.8,
        "",
        "Centroid, or midpoint to the pole of inaccessibility, is used if its distance to the contour exceeds this fraction of the pole's.",
        low=0.0,
        high=10.0,
    )
    grasp_point: str = setting(
        MASK,
        "",
        "Rule of the grasp point: mask (pole, centroid or midpoint of the mask, as in the paper) or flat (that point if the surface around "
        "it is flat and as wide as the tool, else a random one where it is).",
        choices=(MASK, FLAT),
    )
    heavy_mass: float = setting(0.8, "kg", "Mass above which objects are grasped nearer to their centroid.", low=0.0, high=1e6)
    heavy_center_fraction: float = setting(0.4, "", "Same as center_fraction, for heavy objects.", low=0.0, high=10.0)
    contour_offset: float = setting(
        3.0, "px", "Distance from the contour, inside and outside, at which the depths of neighbours are compared.", above=0.0, high=256.0
    )
    deep_distance: float = setting(
        0.02, "m", "A neighbour lower than the suction point by more than this casts down-weighted occlusion votes.", low=0.0, high=10.0
    )
    deep_weight: float = setting(0.1, "", "Weight of those votes.", low=0.0, high=1.0)
    min_votes: float = setting(5.0, "", "Minimum occlusion votes for an edge of the clutter graph.", above=0.0, high=1e6)
    reach: float = setting(
        1.2,
        "",
        "A neighbour casts no vote if its contour extends farther from the compared pixel than this many bounding box diagonals.",
        above=0.0,
        high=1e3,
    )
    exact_cycle: int = setting(
        10,
        "",
        "Maximum size of a cycle in the clutter graph that is broken at minimum cost; larger cycles are broken greedily.",
        low=2,
        high=12,
    )
    normal_window: int = setting(
        10, "px", "Half width of the window around the suction point over which the surface normal is averaged.", low=0, high=256
    )
