"""Check a data set's trajectories against themselves and the laws of motion.

Uses nothing of the project but the store: Newton's law, the law of the gripper's controller and what ties steps to frames are
evaluated here, in float64. Prints a table; exits with 1 if a bound is violated, with 2 if the folder cannot be checked.

    python -m tools.checks.trajectory DIR --episodes 8
"""

from __future__ import annotations

import argparse
import json
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr

STORE = "trajectory.zarr"
FASTEST = 0.95
"""Objects whose speed comes this near to the solver's limit are not checked: the limit acts on them as well."""


class UnusableError(Exception):
    """The folder has no trajectories."""


@dataclass
class Measure:
    """Something whose size is to be at most `allowed`: the largest of all values seen."""

    name: str
    unit: str
    allowed: float
    worst: float = 0.0
    total: int = 0
    where: str = ""

    def see(self, values: np.ndarray, where: str) -> None:
        if not values.size:
            return
        self.total += values.size
        worst = float(np.abs(values).max())
        if not worst <= self.worst:  # NaN is worst of all.
            self.worst, self.where = worst, where

    @property
    def holds(self) -> bool:
        return self.worst <= self.allowed


def measures() -> dict[str, Measure]:
    """All that is measured, at its beginning."""
    return {
        "pose": Measure("objects: last step against frame", "m", 0.0),
        "labels": Measure("arrays without unit, meaning or names of dimensions", "", 0.0),
        "momentum": Measure("objects: change of momentum against contacts and weight", "share", 1e-3),
        "rest": Measure("first frame: contacts of all objects against their weight", "share", 0.1),
        "shift": Measure("objects: way in a step against speed", "m", 1e-4),
        "force": Measure("gripper: force against its law", "N", 1e-2),
        "load": Measure("seals: largest load of a tick against the tick's", "N", 0.0),
        "attempts": Measure("seals: the same against attempts", "N", 1e-4),
    }


def check_labels(episode: zarr.Group, found: dict[str, Measure], where: str) -> None:
    """Every array says what it is."""
    arrays = [member for _, member in episode.members(max_depth=None) if isinstance(member, zarr.Array)]
    lacking = sum(
        not (array.attrs.get("unit") and array.attrs.get("description") and all(array.metadata.dimension_names or [None]))  # type: ignore[union-attr]
        for array in arrays
    )
    found["labels"].see(np.array([lacking]), where)


def check_objects(
    steps: dict[str, np.ndarray],
    ticks: dict[str, np.ndarray],
    mass: np.ndarray,
    root: Any,
    settings: Any,
    found: dict[str, Measure],
    where: str,
) -> None:
    """Poses, velocities and contact forces."""
    count, step, gravity = root["steps_per_tick"], root["step"], root["gravity"]
    there = ticks["object_id"] >= 0
    found["pose"].see((steps["pose"][count - 1 :: count] - ticks["pose"])[there], where)
    velocity, force = steps["velocity"].astype(float), steps["contact_force"].astype(float)
    change = mass[:, None] * np.diff(velocity, axis=0) / step
    residual = np.linalg.norm(change + mass[:, None] * np.array([0.0, 0.0, gravity]) - force[1:], axis=2)
    size = np.maximum(1.0, np.maximum(np.linalg.norm(change, axis=2), np.linalg.norm(force[1:], axis=2)))
    speed = np.linalg.norm(velocity, axis=2)
    free = ~(steps["held"][1:] | steps["held"][:-1]) & (np.maximum(speed[1:], speed[:-1]) < FASTEST * settings["physics"]["max_speed"])
    found["momentum"].see((residual / size)[free & np.isfinite(residual)], where)
    weight = mass[there[0]].sum() * gravity
    found["rest"].see(np.array([force[:count, there[0], 2].sum(axis=1).mean() / weight - 1.0]) if weight else np.zeros(0), where)
    # The origin moves as the centre of mass does, and turns about it: bounded by where it can be, and by what an impact changes.
    way = np.linalg.norm(np.diff(steps["pose"][:, :, :3].astype(float), axis=0), axis=2)
    spin = np.linalg.norm(steps["angular_velocity"].astype(float), axis=2)
    reach = steps["reach"]
    most = step * (np.maximum(speed[1:], speed[:-1]) + reach * np.maximum(spin[1:], spin[:-1])) + step * step * gravity
    found["shift"].see(np.maximum(0.0, way - most)[np.isfinite(way)], where)


def check_gripper(steps: dict[str, np.ndarray], root: Any, settings: Any, mode: str, found: dict[str, Measure], where: str) -> None:
    """F = (k (goal - x - h v) - d v) / (1 + (d h + k h²) / m), no longer than its limit; x and v at the step's beginning."""
    step, section = root["step"], settings["move" if mode == "move" else "pick"]
    mass = settings["gripper"]["finger_mass"] + settings["gripper"]["cup_mass"]
    place, velocity = steps["gripper_pose"][:-1, 0, :3].astype(float), steps["gripper_velocity"][:-1, 0].astype(float)
    stiffness, damping = section["stiffness"], section["damping"]
    force = stiffness * (steps["goal"][1:] - place - step * velocity) - damping * velocity
    force /= 1.0 + (damping * step + stiffness * step * step) / mass
    size = np.linalg.norm(force, axis=1, keepdims=True)
    force *= np.minimum(1.0, section["force"] / np.maximum(size, 1e-12))
    # Before the first step of a tick, the gripper may have been put elsewhere.
    inside = (np.arange(1, len(place) + 1) % root["steps_per_tick"] != 0) & np.isfinite(force).all(axis=1)
    found["force"].see((force - steps["impedance_force"][1:])[inside], where)


def check_seals(steps: dict[str, np.ndarray], ticks: dict[str, np.ndarray], attempts: list[dict], found: dict[str, Measure], where: str):
    """Loads of steps, ticks and attempts."""
    loads = np.nan_to_num(steps["seal_load"]).reshape(len(ticks["load"]), -1)
    peak = loads.max(axis=1, initial=0.0)
    found["load"].see(peak - ticks["load"], where)
    for attempt in attempts:
        last, count = attempt["end_frame"] + 1, len(attempt["load"])
        found["attempts"].see(peak[last - count : last] - np.array(attempt["load"]), where)


def check(dataset: Path, count: int) -> dict[str, Measure]:
    """Check episodes spread evenly over a data set."""
    try:
        store = zarr.open_group(dataset / STORE, mode="r")
        settings = tomllib.loads((dataset / "config.toml").read_text())
        names = sorted(store["episodes"].group_keys())  # type: ignore[union-attr]
    except (OSError, KeyError, ValueError) as error:
        raise UnusableError(f"{dataset} has no trajectories and settings: {error}") from error
    found, root = measures(), dict(store.attrs)
    # An origin is no farther from the centre of mass than any two points from each other.
    reach = dict(zip(store["objects/object_id"][:].tolist(), store["objects/diameter"][:].tolist(), strict=True))  # type: ignore[index,union-attr]
    for place in np.unique(np.linspace(0, len(names) - 1, count).round().astype(int)) if names else ():
        where = f"episode {names[place]}"
        episode = store[f"episodes/{names[place]}"]
        assert isinstance(episode, zarr.Group)
        check_labels(episode, found, where)
        if "steps" not in episode:
            continue
        steps, ticks, arrangement = (
            {name: np.asarray(array[...]) for name, array in episode[group].arrays()}  # type: ignore[union-attr]
            for group in ("steps", "ticks", "arrangement")
        )
        steps["reach"] = np.array([reach.get(int(number), 0.0) for number in arrangement["object_id"]])
        attempts = [json.loads(line) for line in np.asarray(episode["attempts/record"][...]).tobytes().splitlines()]  # type: ignore[index]
        check_objects(steps, ticks, arrangement["mass"], root, settings, found, where)
        check_gripper(steps, root, settings, str(episode.attrs["mode"]), found, where)
        check_seals(steps, ticks, attempts, found, where)
    return found


def print_table(found: dict[str, Measure]) -> bool:
    """Print the table; returns whether every bound holds and steps were measured at all."""
    print(f"{'what':<60} {'found':>12} {'allowed':>9} {'unit':<6} {'of':>10}  where")
    for measure in found.values():
        worst = f"{measure.worst:.3g}" if measure.total else "-"
        verdict = "" if measure.holds else "  VIOLATED"
        print(f"{measure.name:<60} {worst:>12} {measure.allowed:>9g} {measure.unit:<6} {measure.total:>10}  {measure.where}{verdict}")
    if not found["momentum"].total:
        print("nothing was checked: no episode has steps")
        return False
    return all(measure.holds for measure in found.values())


def main() -> int:
    parser = argparse.ArgumentParser(description="Check a data set's trajectories against the laws of motion.")
    parser.add_argument("dataset", type=Path, metavar="DIR", help="folder of the data set")
    parser.add_argument("--episodes", type=int, default=8, help="episodes to check, spread over the data set (default %(default)s)")
    arguments = parser.parse_args()
    if arguments.episodes < 1:
        parser.error(f"--episodes is {arguments.episodes}; allowed: at least 1")
    try:
        return 0 if print_table(check(arguments.dataset, arguments.episodes)) else 1
    except UnusableError as error:
        print(f"check_trajectory: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
