"""Schema of the zarr store: names, dimensions, types, units and descriptions of all arrays. Imports quickly.

Descriptions are written into the store.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from synpick_warp.codes import MAX_CUPS, Outcome, Phase, Task, names

STORE = Path("trajectory.zarr")
"""Path in the data set."""
EPISODES = "episodes"
"""Group of the store that holds one group per episode, named by its index."""
FORMAT = 1
"""Version of the store's layout."""

LABELS = {
    "component": ("x", "y", "z", "qx", "qy", "qz", "qw"),
    "axis": ("x", "y", "z"),
    "fixture": ("tote", "finger", "cup"),
    "link": ("finger", "cup"),
    "cup": tuple(str(cup) for cup in range(MAX_CUPS)),
}
"""Dimensions with named indices. No dimension has the name of an array: xarray takes such an array for the dimension's coordinate."""


@dataclass(frozen=True)
class TrajectoryArray:
    """Schema of one array of the store."""

    dims: tuple[str, ...]
    dtype: str
    unit: str
    """1: dimensionless."""
    description: str
    codes: tuple[str, ...] = ()
    """Names of the values 0, 1, ... of an enumeration."""

    def shape(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """Shape of the array, from the sizes of dimensions by name; those in LABELS have as many elements as labels."""
        return tuple(len(LABELS[name]) if name in LABELS else sizes[name] for name in self.dims)


@dataclass(frozen=True)
class GroupSpec:
    """Schema of a group of arrays: description, arrays by name, and which of them are coordinates (CF conventions)."""

    description: str
    arrays: Mapping[str, TrajectoryArray] = field(default_factory=dict)
    coordinates: tuple[str, ...] = ()
    """Names of the group's coordinate variables, as in the attribute `coordinates` of the CF conventions, which xarray reads."""


_GONE = " NaN: the instance is not in the scene."
_POSE = "x, y, z [m], then the quaternion x, y, z, w."
_COM = "Linear velocity of the centre of mass, in the world's axes."
_SPIN = "Angular velocity, in the world's axes."
_CONTACT = "Vector sum of the forces of all contacts on the body, in the world's axes, mean over the step; a seal's force is no contact."
_SUPPORT = "Upward force of the second instance's contacts on the first, mean over the tick; below 0: it lies on it. With bop.graph only."
_LOAD = "Sum of the magnitudes of all contact forces on the body, mean over the step: how much it is squeezed."

TICKS = GroupSpec(
    "One row per frame. An instance keeps its index through the episode. Time, poses and states are those that the frame's pictures show.",
    {
        "time": TrajectoryArray(("tick",), "<f8", "s", "Simulated time since the episode's first frame."),
        "object_id": TrajectoryArray(("tick", "instance"), "<i4", "1", "obj_id of the instance; -1: it is not in the scene."),
        "pose": TrajectoryArray(("tick", "instance", "component"), "<f4", "m", f"Object to world: {_POSE}{_GONE}"),
        "fixture_pose": TrajectoryArray(("tick", "fixture", "component"), "<f4", "m", f"Tote, finger and cup to world: {_POSE}"),
        "fixture_visible": TrajectoryArray(("tick", "fixture"), "|b1", "1", "Whether it is in the pictures."),
        "phase": TrajectoryArray(("tick",), "<i4", "1", "Phase of the episode.", names(Phase)),
        "task": TrajectoryArray(("tick",), "<i4", "1", "Task of the gripper at the frame.", names(Task)),
        "attempt": TrajectoryArray(
            ("tick",), "<i4", "1", "Number of the running attempt, or of the one that ended in this tick; -1: none yet."
        ),
        "outcome": TrajectoryArray(("tick",), "<i4", "1", "Outcome of the attempt that ended in this tick.", names(Outcome)),
        "target": TrajectoryArray(("tick",), "<i4", "1", "Instance that the attempt was to pick; -1: none."),
        "hits": TrajectoryArray(
            ("tick",), "<i4", "1", "Rays of the cup that hit an object when the suction of the attempt was switched on."
        ),
        "engaged": TrajectoryArray(("tick", "instance"), "|b1", "1", "Whether one of them hit the instance."),
        "attached": TrajectoryArray(("tick", "instance"), "|b1", "1", "Whether the instance hangs on the cup, or was picked in this tick."),
        "peak_force": TrajectoryArray(("tick",), "<f4", "N", "Largest force of any seal in any step of the tick."),
        "support": TrajectoryArray(("tick", "instance", "instance"), "<f4", "N", _SUPPORT),
        "static_support": TrajectoryArray(
            ("tick", "instance"), "<f4", "N", "Upward force of bin or table on the instance, mean over the tick; with bop.graph only."
        ),
    },
    ("time",),
)
STEPS = GroupSpec(
    "One row per step of physics. With S steps per tick, rows f S to f S + S - 1 are the steps that led to frame f; the last one is the "
    "state that the frame shows, but for what is put elsewhere after it: a gripper that appears or goes home, objects that leave.",
    {
        "time": TrajectoryArray(("step",), "<f8", "s", "Simulated time at the step's end since the episode's first frame."),
        "pose": TrajectoryArray(("step", "instance", "component"), "<f4", "m", f"Object to world at the step's end: {_POSE}{_GONE}"),
        "velocity": TrajectoryArray(("step", "instance", "axis"), "<f4", "m/s", f"{_COM}{_GONE}"),
        "angular_velocity": TrajectoryArray(("step", "instance", "axis"), "<f4", "rad/s", f"{_SPIN}{_GONE}"),
        "contact_force": TrajectoryArray(("step", "instance", "axis"), "<f4", "N", f"{_CONTACT}{_GONE}"),
        "contact_load": TrajectoryArray(("step", "instance"), "<f4", "N", f"{_LOAD}{_GONE}"),
        "seal_force": TrajectoryArray(
            ("step", "instance"), "<f4", "N", f"Tension and shear that the instance's seal bore; 0: none holds it.{_GONE}"
        ),
        "attached": TrajectoryArray(("step", "instance"), "|b1", "1", "Whether a seal holds the instance at the step's end."),
        "gripper_pose": TrajectoryArray(("step", "link", "component"), "<f4", "m", f"Finger and cup to world at the step's end: {_POSE}"),
        "gripper_velocity": TrajectoryArray(("step", "link", "axis"), "<f4", "m/s", _COM),
        "gripper_angular_velocity": TrajectoryArray(("step", "link", "axis"), "<f4", "rad/s", _SPIN),
        "gripper_contact_force": TrajectoryArray(("step", "link", "axis"), "<f4", "N", _CONTACT),
        "gripper_contact_load": TrajectoryArray(("step", "link"), "<f4", "N", _LOAD),
        "setpoint": TrajectoryArray(
            ("step", "axis"), "<f4", "m", "Setpoint of the wrist (the cup's tilt axis, origin of finger and cup) in the step. NaN: none."
        ),
        "impedance_force": TrajectoryArray(
            ("step", "axis"),
            "<f4",
            "N",
            "Impedance force on the gripper towards the setpoint, held for the step; without gravity compensation.",
        ),
        "task": TrajectoryArray(("step",), "|i1", "1", "Task of the gripper in the step.", names(Task)),
        "cup_force": TrajectoryArray(
            ("step", "cup"), "<f4", "N", "Tension and shear that each cup's seals bore; only of a gripper of several cups. 0: no seal."
        ),
    },
    ("time",),
)
ARRANGEMENT = GroupSpec(
    "Which objects the episode has, and how they were first dropped.",
    {
        "object_id": TrajectoryArray(("instance",), "<i4", "1", "obj_id of the instance; -1: there is none with this index."),
        "mass": TrajectoryArray(("instance",), "<f8", "kg", "Its mass."),
        "drop_pose": TrajectoryArray(("instance", "component"), "<f4", "m", f"Object to world where it began to fall: {_POSE}"),
    },
)
_UNSEEN = "nothing was seen"
ATTEMPTS = GroupSpec(
    "One row per attempt to pick, as in attempts.jsonl.",
    {
        "frame": TrajectoryArray(("attempt",), "<i4", "1", "Frame from which the target was chosen."),
        "end_frame": TrajectoryArray(("attempt",), "<i4", "1", "Frame at which it was judged."),
        "outcome": TrajectoryArray(("attempt",), "<i4", "1", "Outcome of the attempt.", names(Outcome)),
        "target": TrajectoryArray(("attempt",), "<i4", "1", f"Instance that was chosen; -1: {_UNSEEN}."),
        "object_id": TrajectoryArray(("attempt",), "<i4", "1", f"Its obj_id; -1: {_UNSEEN}."),
        "point": TrajectoryArray(("attempt", "axis"), "<f8", "m", f"Where the cup's tip was to touch. NaN: {_UNSEEN}."),
        "normal": TrajectoryArray(("attempt", "axis"), "<f8", "1", f"Unit normal there, out of the object. NaN: {_UNSEEN}."),
        "yaw": TrajectoryArray(("attempt",), "<f8", "rad", f"Yaw of the finger about the vertical. NaN: {_UNSEEN}."),
        "tilt": TrajectoryArray(("attempt",), "<f8", "rad", f"Tilt of the cup about the finger's y axis. NaN: {_UNSEEN}."),
        "rays": TrajectoryArray(("attempt",), "<i4", "1", "Rays of the cup."),
        "hits": TrajectoryArray(("attempt",), "<i4", "1", "Rays that hit an object when the suction was switched on."),
        "good_seal": TrajectoryArray(("attempt",), "|b1", "1", "Whether the seals were of full strength."),
        "engaged": TrajectoryArray(("attempt", "instance"), "|b1", "1", "Whether a ray hit the instance."),
        "picked": TrajectoryArray(("attempt", "instance"), "|b1", "1", "Whether the instance left the scene on the cup."),
        "peak_force": TrajectoryArray(
            ("attempt", "lift_tick"), "<f8", "N", "Largest force of any seal in each tick since the suction came on. NaN: it is over."
        ),
        "record": TrajectoryArray(("byte",), "|u1", "1", "The lines of attempts.jsonl, with what was seen of every object; JSON in UTF-8."),
    },
)
EPISODE_GROUPS = {"ticks": TICKS, "steps": STEPS, "arrangement": ARRANGEMENT, "attempts": ATTEMPTS}
"""Groups of an episode. `steps` exists if steps were recorded."""

OBJECTS = GroupSpec(
    "The objects of the bake, in the order of their obj_id; `names` in the group's attributes has their names.",
    {
        "object_id": TrajectoryArray(("object",), "<i4", "1", "obj_id."),
        "mass": TrajectoryArray(("object",), "<f8", "kg", "Mass."),
        "center_of_mass": TrajectoryArray(("object", "axis"), "<f8", "m", "Centre of mass in the object's frame."),
        "inertia": TrajectoryArray(("object", "axis", "axis"), "<f8", "kg·m²", "Inertia about the centre of mass, in the object's axes."),
        "diameter": TrajectoryArray(("object",), "<f8", "m", "Largest distance between two points of the surface."),
        "volume": TrajectoryArray(("object",), "<f8", "m³", "Volume of the collision shape."),
    },
)
CAMERAS = GroupSpec(
    "The cameras, which do not move: x right, y down, z forward; the centre of pixel (row, column) is (column + 0.5, row + 0.5).",
    {
        "resolution": TrajectoryArray(("camera", "width_height"), "<i4", "px", "Width and height."),
        "matrix": TrajectoryArray(("camera", "row", "column"), "<f8", "px", "K: camera to image."),
        "rotation": TrajectoryArray(("camera", "row", "column"), "<f8", "1", "World to camera."),
        "translation": TrajectoryArray(("camera", "axis"), "<f8", "m", "World to camera."),
    },
)
CONSTANT_GROUPS = {"objects": OBJECTS, "cameras": CAMERAS}
"""Groups of the store that all episodes share."""
CONSTANT_FILES = (STORE / "zarr.json", *(STORE / name for name in CONSTANT_GROUPS), STORE / EPISODES / "zarr.json")
"""Files and folders of the store that all episodes share, relative to the data set."""
