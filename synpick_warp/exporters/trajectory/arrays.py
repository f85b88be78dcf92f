"""What a data set's zarr store holds: names, dimensions, types, units and meaning of all arrays. Imports nothing that takes long."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from synpick_warp.codes import Outcome, Phase, Task, names

STORE = Path("trajectory.zarr")
"""In the data set."""
EPISODES = "episodes"
"""Group of the store with one group an episode, named by its number."""
FORMAT = 1
"""Of the store."""

LABELS = {
    "pose": ("x", "y", "z", "qx", "qy", "qz", "qw"),
    "axis": ("x", "y", "z"),
    "fixture": ("tote", "finger", "cup"),
    "link": ("finger", "cup"),
}
"""Dimensions whose places have names."""


@dataclass(frozen=True)
class Quantity:
    """One array."""

    dims: tuple[str, ...]
    dtype: str
    unit: str
    """1: a number, a code or a name without unit."""
    description: str
    codes: tuple[str, ...] = ()
    """Names of the values 0, 1, ..."""

    def shape(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """Its extents, those of dimensions with labels known."""
        return tuple(len(LABELS[name]) if name in LABELS else sizes[name] for name in self.dims)


@dataclass(frozen=True)
class GroupDoc:
    """One group of arrays."""

    description: str
    arrays: Mapping[str, Quantity] = field(default_factory=dict)


_GONE = " NaN: the instance is not in the scene."
_POSE = "x, y, z [m], then the quaternion x, y, z, w."
_COM = "Linear velocity of the centre of mass, in the world's axes."
_SPIN = "Angular velocity, in the world's axes."
_CONTACT = "Vector sum of the forces of all contacts on the body, in the world's axes, mean over the step; a seal's force is no contact."
_SIZES = "Sum of the sizes of the forces of all contacts on the body, mean over the step: how much it is squeezed."

TICKS = GroupDoc(
    "One row a frame. An instance keeps its index through the episode. Time, poses and states are those that the frame's pictures show.",
    {
        "time": Quantity(("tick",), "<f8", "s", "Simulated time since the episode's first frame."),
        "object_id": Quantity(("tick", "instance"), "<i4", "1", "obj_id of the instance; -1: it is not in the scene."),
        "pose": Quantity(("tick", "instance", "pose"), "<f4", "m", f"Object to world: {_POSE}{_GONE}"),
        "fixture_pose": Quantity(("tick", "fixture", "pose"), "<f4", "m", f"Tote, finger and cup to world: {_POSE}"),
        "fixture_visible": Quantity(("tick", "fixture"), "|b1", "1", "Whether it is in the pictures."),
        "phase": Quantity(("tick",), "<i4", "1", "What the episode is at.", names(Phase)),
        "task": Quantity(("tick",), "<i4", "1", "What the gripper is at when the frame is taken.", names(Task)),
        "attempt": Quantity(("tick",), "<i4", "1", "Number of the running attempt, or of the one that ended in this tick; -1: none yet."),
        "outcome": Quantity(("tick",), "<i4", "1", "What came of the attempt that ended in this tick.", names(Outcome)),
        "target": Quantity(("tick",), "<i4", "1", "Instance that the attempt was to pick; -1: none."),
        "hits": Quantity(("tick",), "<i4", "1", "Rays of the cup that hit an object when the suction of the attempt was switched on."),
        "caught": Quantity(("tick", "instance"), "|b1", "1", "Whether one of them hit the instance."),
        "held": Quantity(("tick", "instance"), "|b1", "1", "Whether the instance hangs on the cup, or was picked in this tick."),
        "load": Quantity(("tick",), "<f4", "N", "Largest load of any seal in any step of the tick."),
    },
)
STEPS = GroupDoc(
    "One row a step of physics. With S steps a tick, rows f S to f S + S - 1 are the steps that led to frame f; the last of them is the "
    "state that the frame shows, but for what is put elsewhere after it: a gripper that appears or goes home, objects that leave.",
    {
        "time": Quantity(("step",), "<f8", "s", "Simulated time at the step's end since the episode's first frame."),
        "pose": Quantity(("step", "instance", "pose"), "<f4", "m", f"Object to world at the step's end: {_POSE}{_GONE}"),
        "velocity": Quantity(("step", "instance", "axis"), "<f4", "m/s", f"{_COM}{_GONE}"),
        "angular_velocity": Quantity(("step", "instance", "axis"), "<f4", "rad/s", f"{_SPIN}{_GONE}"),
        "contact_force": Quantity(("step", "instance", "axis"), "<f4", "N", f"{_CONTACT}{_GONE}"),
        "contact_load": Quantity(("step", "instance"), "<f4", "N", f"{_SIZES}{_GONE}"),
        "seal_load": Quantity(
            ("step", "instance"), "<f4", "N", f"Tension and shear that the instance's seal bore; 0: none holds it.{_GONE}"
        ),
        "held": Quantity(("step", "instance"), "|b1", "1", "Whether a seal holds the instance at the step's end."),
        "gripper_pose": Quantity(("step", "link", "pose"), "<f4", "m", f"Finger and cup to world at the step's end: {_POSE}"),
        "gripper_velocity": Quantity(("step", "link", "axis"), "<f4", "m/s", _COM),
        "gripper_angular_velocity": Quantity(("step", "link", "axis"), "<f4", "rad/s", _SPIN),
        "gripper_contact_force": Quantity(("step", "link", "axis"), "<f4", "N", _CONTACT),
        "gripper_contact_load": Quantity(("step", "link"), "<f4", "N", _SIZES),
        "goal": Quantity(
            ("step", "axis"), "<f4", "m", "Where the cup's tilt axis, the origin of finger and cup, was drawn to in the step. NaN: nowhere."
        ),
        "impedance_force": Quantity(
            ("step", "axis"), "<f4", "N", "Force on the gripper towards the goal, held for the step; its weight is borne besides."
        ),
        "task": Quantity(("step",), "|i1", "1", "What the gripper was at.", names(Task)),
    },
)
ARRANGEMENT = GroupDoc(
    "Which objects the episode has, and how they were first dropped.",
    {
        "object_id": Quantity(("instance",), "<i4", "1", "obj_id of the instance; -1: there is none with this index."),
        "mass": Quantity(("instance",), "<f8", "kg", "Its mass."),
        "drop_pose": Quantity(("instance", "pose"), "<f4", "m", f"Object to world where it began to fall: {_POSE}"),
    },
)
_UNSEEN = "nothing was seen"
ATTEMPTS = GroupDoc(
    "One row an attempt to pick, as in attempts.jsonl.",
    {
        "frame": Quantity(("attempt",), "<i4", "1", "Frame from which was chosen."),
        "end_frame": Quantity(("attempt",), "<i4", "1", "Frame at which it was judged."),
        "outcome": Quantity(("attempt",), "<i4", "1", "What came of it.", names(Outcome)),
        "target": Quantity(("attempt",), "<i4", "1", f"Instance that was chosen; -1: {_UNSEEN}."),
        "object_id": Quantity(("attempt",), "<i4", "1", f"Its obj_id; -1: {_UNSEEN}."),
        "point": Quantity(("attempt", "axis"), "<f8", "m", f"Where the cup's tip was to touch. NaN: {_UNSEEN}."),
        "normal": Quantity(("attempt", "axis"), "<f8", "1", f"Unit normal there, out of the object. NaN: {_UNSEEN}."),
        "yaw": Quantity(("attempt",), "<f8", "rad", f"Turn of the finger about the vertical. NaN: {_UNSEEN}."),
        "tilt": Quantity(("attempt",), "<f8", "rad", f"Tilt of the cup about the finger's y axis. NaN: {_UNSEEN}."),
        "rays": Quantity(("attempt",), "<i4", "1", "Rays of the cup."),
        "hits": Quantity(("attempt",), "<i4", "1", "Rays that hit an object when the suction was switched on."),
        "good_seal": Quantity(("attempt",), "|b1", "1", "Whether the seals were of full strength."),
        "caught": Quantity(("attempt", "instance"), "|b1", "1", "Whether a ray hit the instance."),
        "picked": Quantity(("attempt", "instance"), "|b1", "1", "Whether the instance left the scene on the cup."),
        "load": Quantity(
            ("attempt", "lift_tick"), "<f8", "N", "Largest load of any seal in each tick since the suction came on. NaN: it is over."
        ),
        "record": Quantity(("byte",), "|u1", "1", "The lines of attempts.jsonl, with what was seen of every object; JSON in UTF-8."),
    },
)
EPISODE = {"ticks": TICKS, "steps": STEPS, "arrangement": ARRANGEMENT, "attempts": ATTEMPTS}
"""Groups of an episode. `steps` is there if steps were recorded."""

OBJECTS = GroupDoc(
    "The objects of the bake, in the order of their obj_id; `names` in the group's attributes has their names.",
    {
        "object_id": Quantity(("object",), "<i4", "1", "obj_id."),
        "mass": Quantity(("object",), "<f8", "kg", "Mass."),
        "center_of_mass": Quantity(("object", "axis"), "<f8", "m", "Centre of mass in the object's frame."),
        "inertia": Quantity(("object", "axis", "axis"), "<f8", "kg·m²", "Inertia about the centre of mass, in the object's axes."),
        "diameter": Quantity(("object",), "<f8", "m", "Largest distance of two points."),
        "volume": Quantity(("object",), "<f8", "m³", "Volume of the collision shape."),
    },
)
CAMERAS = GroupDoc(
    "The cameras, which do not move: x right, y down, z forward; the centre of pixel (row, column) is (column + 0.5, row + 0.5).",
    {
        "resolution": Quantity(("camera", "width_height"), "<i4", "px", "Width and height."),
        "matrix": Quantity(("camera", "row", "column"), "<f8", "px", "K: camera to picture."),
        "rotation": Quantity(("camera", "row", "column"), "<f8", "1", "World to camera."),
        "translation": Quantity(("camera", "axis"), "<f8", "m", "World to camera."),
    },
)
CONSTANTS = {"objects": OBJECTS, "cameras": CAMERAS}
"""Groups of the store besides EPISODES."""
