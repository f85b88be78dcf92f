"""Trajectories of a source: attributes and arrays that a format needs, checked before any of it is converted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
import numpy as np

from synpick_warp.codes import Outcome, names
from synpick_warp.dataset.annotations import ADVICE, Index, check_content
from synpick_warp.dataset.reading import Episode
from synpick_warp.dataset.trajectory import GROUP_FILE, Arrays, read_array
from synpick_warp.errors import DatasetError
from synpick_warp.views.frames import EpisodeEnd, TickBatch

POSES = ("time", "object_id", "pose", "fixture_pose", "fixture_visible")
"""Arrays of `ticks` that every format needs."""
GRIPPER = ("task", "attached")
"""Arrays of `ticks` that a format with states and commands of the gripper needs, too."""
SETPOINT = "setpoint"
"""Array of `steps` that such a format needs."""
_OUTCOMES = tuple(name.lower() for name in names(Outcome))


class _Light(msgspec.Struct):
    """Schema of an episode's light: index of the environment map, yaw [rad], exposure compensation [EV]."""

    map: Index
    yaw: float
    exposure: float


class _Bin(msgspec.Struct):
    """Schema of an episode's bin: its name."""

    name: str


class _Attributes(msgspec.Struct):
    """Schema of the attributes of an episode's group, as far as they are converted."""

    light: _Light
    bin: _Bin | None = None


class _Attempt(msgspec.Struct):
    """Schema of a line of attempts.jsonl, as far as tasks and rewards are made of it; object None: nothing was seen."""

    frame: Index
    end_frame: Index
    outcome: str
    object_id: Index | None

    def __post_init__(self) -> None:
        if self.outcome not in _OUTCOMES:
            raise ValueError(f"its outcome is none of {', '.join(_OUTCOMES)}")


def check_trajectory(data: Episode, end: EpisodeEnd, lights: int, *, gripper: bool) -> None:
    """Check that an episode's trajectory has what a format needs.

    Args:
        data: The episode.
        end: Its manifest entry.
        lights: Number of environment maps.
        gripper: Whether states, commands and attempts of the gripper are needed.

    Raises:
        DatasetError: An attribute, array or key is missing or damaged.
    """
    light = _read_light(data)
    if light.map >= lights:
        raise DatasetError(f"{data.group / GROUP_FILE} is damaged: light.map is {light.map}, the store has {lights} maps; {ADVICE}")
    _require(data, data.ticks, "ticks", (*POSES, *(GRIPPER if gripper else ())))
    shapes = {name: data.ticks[name].shape[1] for name in ("object_id", "pose", *(GRIPPER[1:] if gripper else ()))}
    if len(set(shapes.values())) > 1:
        counts = ", ".join(f"{name} {count}" for name, count in shapes.items())
        raise DatasetError(f"{data.group / 'ticks'} is damaged: its arrays differ in the number of instances ({counts}); {ADVICE}")
    if gripper:
        if not len(data.steps):
            raise DatasetError(
                f"{data.group} has no steps, whose setpoints are the actions of lerobot; bake zarr with trajectory.steps = true"
            )
        _require(data, data.steps, "steps", (SETPOINT,))
        _check_attempts(end)


def _check_attempts(end: EpisodeEnd) -> None:
    """Validate the attempt records of an episode, as its manifest entry has them, against their schema. Raises DatasetError."""
    source = f"the manifest entry of episode {end.episode}"
    for line in end.attempts:
        check_content(msgspec.json.decode(line), _Attempt, source)


def _require(data: Episode, arrays: Arrays, group: str, wanted: tuple[str, ...]) -> None:
    """Check that a group has these arrays, of the schema's types and shapes."""
    for name in wanted:
        if name not in arrays:
            raise DatasetError(f"{data.group / group} has no array {name}; {ADVICE}")


def _read_light(data: Episode) -> _Light:
    """Light of an episode, from the attributes of its group in the store; raises DatasetError for a schema that does not fit."""
    return check_content(data.attributes, _Attributes, data.group / GROUP_FILE).light


def read_ticks(data: Episode, steps_per_tick: int, bins: Sequence[str]) -> Iterator[TickBatch]:
    """Yield the frames of an episode, as they came from the simulation, with gripper state and setpoints if there are any; poses of absent
    instances are NaN. `bins`: as `Cell.recorded`.

    Raises:
        DatasetError: The episode's bin is none of them.
    """
    arrays = {name: read_array(data.ticks[name]) for name in POSES}
    state = {name: read_array(data.ticks[name]) for name in GRIPPER if name in data.ticks}
    setpoint = read_array(data.steps[SETPOINT]).reshape(len(data), steps_per_tick, 3) if SETPOINT in data.steps else None
    attributes = check_content(data.attributes, _Attributes, data.group / GROUP_FILE)
    light, own = attributes.light, attributes.bin.name if attributes.bin else ""
    if bins and own not in bins:
        raise DatasetError(f"{data.group / GROUP_FILE} is damaged: its bin is {own!r}, the settings have {', '.join(bins)}; {ADVICE}")
    columns: dict[str, Any] = {
        "bin": np.array([bins.index(own) if bins else 0], np.int32),
        "light": np.array([light.map], np.int32),
        "light_yaw": np.array([light.yaw], np.float32),
        "light_exposure": np.array([light.exposure], np.float32),
    }
    for frame in range(len(data)):
        row = slice(frame, frame + 1)
        yield TickBatch(
            episode=np.array([data.index], np.int32),
            frame=np.array([frame], np.int32),
            **{name: values[row] for name, values in arrays.items()},
            **columns,
            tick={name: values[row] for name, values in state.items()},
            steps={} if setpoint is None else {SETPOINT: setpoint[row]},
        )
