"""Consistency check of a data set's trajectories: against themselves and the laws of motion.

Independent of the project's code, reading the zarr store alone: Newton's second law, the law of the gripper's impedance controller, and
the relations between steps, ticks and attempts are evaluated here, in float64. Prints a table; exits with 1 if a bound is violated,
with 2 if the folder cannot be checked.

    python -m tools.checks.trajectory DIR --episodes 8
"""

import json
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from synpick_warp.errors import DatasetError
from tools.checks.dataset import MeasuredValue, run_check

STORE = "trajectory.zarr"
MAX_SPEED = 5.0
"""Bound of the speed of any object, by its displacement over a tick [m/s]."""
MAX_SPEED_FRACTION = 0.95
"""Objects above this fraction of the solver's speed limit are not checked: the limit changes their momentum, too."""


def make_measures() -> dict[str, MeasuredValue]:
    """Make the measures of all bounded quantities, without values."""
    return {
        "pose": MeasuredValue("objects: last step against frame, which holds poses", "m", 1.01e-5),
        "turn": MeasuredValue("the same, quaternions", "", 1e-3),
        "labels": MeasuredValue("arrays without unit, description or dimension names", "", 0.0),
        "finite": MeasuredValue("objects: poses that are not finite", "", 0.0),
        "speed": MeasuredValue("objects: speed, by displacement over a tick", "m/s", MAX_SPEED),
        "momentum": MeasuredValue("objects: change of momentum against contacts and weight", "ratio", 2e-4),
        "rest": MeasuredValue("first frame: contacts of all objects against their weight", "ratio", 0.1),
        "displacement": MeasuredValue("objects: displacement in a step against speed", "m", 1e-4),
        "force": MeasuredValue("gripper: force against its law", "N", 2e-3),
        "peak_force": MeasuredValue("seals: peak force of a tick's steps against the tick's", "N", 0.0),
        "attempts": MeasuredValue("seals: peak force of a tick's steps against the attempt's", "N", 1e-4),
    }


def check_labels(episode: zarr.Group, measures: dict[str, MeasuredValue], where: str) -> None:
    """Check that every array has a unit, a description and dimension names."""
    arrays = [member for _, member in episode.members(max_depth=None) if isinstance(member, zarr.Array)]
    unlabelled = sum(
        not (array.attrs.get("units") and array.attrs.get("description") and all(array.metadata.dimension_names or [None]))  # type: ignore[union-attr]
        for array in arrays
    )
    measures["labels"].update_max(unlabelled, where)


def check_frames(ticks: dict[str, np.ndarray], tick: float, measures: dict[str, MeasuredValue], where: str) -> None:
    """Check that objects have finite poses in all frames, `tick` [s] apart, and that none is flung."""
    present, pose = ticks["object_id"] >= 0, ticks["pose"].astype(float)
    measures["finite"].update_max((~np.isfinite(pose[present]).all(axis=1)).sum(), where)
    displacement = np.linalg.norm(np.diff(pose[:, :, :3], axis=0), axis=2)[present[1:] & present[:-1]]
    measures["speed"].update_max(displacement[np.isfinite(displacement)] / tick, where)


def check_objects(
    steps: dict[str, np.ndarray],
    ticks: dict[str, np.ndarray],
    mass: np.ndarray,
    root: Any,
    settings: Any,
    measures: dict[str, MeasuredValue],
    where: str,
) -> None:
    """Check poses, velocities and contact forces of objects; `mass` (instance) [kg]."""
    count, step, gravity = root["steps_per_tick"], root["step"], root["gravity"]
    present = ticks["object_id"] >= 0
    held = (steps["pose"][count - 1 :: count] - ticks["pose"])[present]
    measures["pose"].update_max(held[:, :3], where)
    measures["turn"].update_max(held[:, 3:], where)
    velocity, force = steps["velocity"].astype(float), steps["contact_force"].astype(float)
    inertial_force = mass[:, None] * np.diff(velocity, axis=0) / step
    residual = np.linalg.norm(inertial_force + mass[:, None] * np.array([0.0, 0.0, gravity]) - force[1:], axis=2)
    scale = np.maximum(1.0, np.maximum(np.linalg.norm(inertial_force, axis=2), np.linalg.norm(force[1:], axis=2)))
    speed = np.linalg.norm(velocity, axis=2)
    max_speed = np.maximum(speed[1:], speed[:-1])
    free = ~(steps["attached"][1:] | steps["attached"][:-1]) & (max_speed < MAX_SPEED_FRACTION * settings["physics"]["max_speed"])
    measures["momentum"].update_max((residual / scale)[free & np.isfinite(residual)], where)
    weight = mass[present[0]].sum() * gravity
    support = force[:count, present[0], 2].sum(axis=1).mean()
    measures["rest"].update_max([support / weight - 1.0] if weight else [], where)
    # The origin moves with the centre of mass and rotates about it: bounded by the speeds before and after, which an impact may change.
    displacement = np.linalg.norm(np.diff(steps["pose"][:, :, :3].astype(float), axis=0), axis=2)
    angular_speed = np.linalg.norm(steps["angular_velocity"].astype(float), axis=2)
    max_angular_speed = np.maximum(angular_speed[1:], angular_speed[:-1])
    max_displacement = step * (max_speed + steps["origin_radius"] * max_angular_speed) + step * step * gravity
    measures["displacement"].update_max(np.maximum(0.0, displacement - max_displacement)[np.isfinite(displacement)], where)


def check_gripper(
    steps: dict[str, np.ndarray], root: Any, settings: Any, mode: str, measures: dict[str, MeasuredValue], where: str
) -> None:
    """Check the gripper's impedance law: F = (k (goal - x - h v) - d v) / (1 + (d h + k h²) / m), clamped to its limit.

    x and v are of the step's beginning, h is the time step, m the mass of shaft and cup.
    """
    step, section = root["step"], settings["move" if mode == "move" else "pick"]
    mass = settings["gripper"]["finger_mass"] + settings["gripper"]["cup_mass"]
    position, velocity = steps["gripper_pose"][:-1, 0, :3].astype(float), steps["gripper_velocity"][:-1, 0].astype(float)
    stiffness, damping = section["stiffness"], section["damping"]
    force = stiffness * (steps["setpoint"][1:] - position - step * velocity) - damping * velocity
    force /= 1.0 + (damping * step + stiffness * step * step) / mass
    magnitude = np.linalg.norm(force, axis=1, keepdims=True)
    force *= np.minimum(1.0, section["force"] / np.maximum(magnitude, 1e-12))
    # Before the first step of a tick, the gripper may have been placed elsewhere.
    unmoved = (np.arange(1, len(position) + 1) % root["steps_per_tick"] != 0) & np.isfinite(force).all(axis=1)
    measures["force"].update_max((force - steps["impedance_force"][1:])[unmoved], where)


def check_seals(
    steps: dict[str, np.ndarray], ticks: dict[str, np.ndarray], attempts: list[dict], measures: dict[str, MeasuredValue], where: str
):
    """Check peak seal forces of ticks and attempts against those of steps."""
    forces = np.nan_to_num(steps["seal_force"]).reshape(len(ticks["peak_force"]), -1)
    peak = forces.max(axis=1, initial=0.0)
    measures["peak_force"].update_max(peak - ticks["peak_force"], where)
    for attempt in attempts:
        last, count = attempt["end_frame"] + 1, len(attempt["peak_force"])
        measures["attempts"].update_max(peak[last - count : last] - np.array(attempt["peak_force"]), where)


def check(dataset: Path, count: int) -> dict[str, MeasuredValue]:
    """Check `count` episodes spread evenly over a data set; returns all quantities by name."""
    try:
        store = zarr.open_group(dataset / STORE, mode="r")
        settings = tomllib.loads((dataset / "config.toml").read_text())
        names = sorted(store["episodes"].group_keys())  # type: ignore[union-attr]
    except (OSError, KeyError, ValueError) as error:
        raise DatasetError(f"{dataset} has no trajectories and settings: {error}") from error
    measures: dict[str, MeasuredValue] = make_measures()
    root: dict[str, Any] = dict(store.attrs)
    # The diameter bounds the distance of an object's origin from its centre of mass.
    radius = dict(zip(store["objects/object_id"][:].tolist(), store["objects/diameter"][:].tolist(), strict=True))  # type: ignore[index,union-attr]
    for index in np.unique(np.linspace(0, len(names) - 1, count).round().astype(int)) if names else ():
        where = f"episode {names[index]}"
        episode = store[f"episodes/{names[index]}"]
        assert isinstance(episode, zarr.Group)
        check_labels(episode, measures, where)
        ticks = read_arrays(episode, "ticks")
        check_frames(ticks, root["step"] * root["steps_per_tick"], measures, where)
        if "steps" not in episode:
            continue
        steps, arrangement = read_arrays(episode, "steps"), read_arrays(episode, "arrangement")
        steps["origin_radius"] = np.array([radius.get(int(object_id), 0.0) for object_id in arrangement["object_id"]])
        attempts = [json.loads(line) for line in np.asarray(episode["attempts/record"][...]).tobytes().splitlines()]  # type: ignore[index]
        check_objects(steps, ticks, arrangement["mass"], root, settings, measures, where)
        check_gripper(steps, root, settings, str(episode.attrs["mode"]), measures, where)
        check_seals(steps, ticks, attempts, measures, where)
    return measures


def read_arrays(episode: zarr.Group, group: str) -> dict[str, np.ndarray]:
    """Read all arrays of a group of an episode, by name."""
    return {name: np.asarray(array[...]) for name, array in episode[group].arrays()}  # type: ignore[union-attr]


def main() -> int:
    """Run the command line; returns the exit code."""
    return run_check(__doc__, "episodes", 8, check, ("momentum",))


if __name__ == "__main__":
    sys.exit(main())
