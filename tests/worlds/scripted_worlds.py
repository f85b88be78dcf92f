"""Scripted worlds: tick reports written by hand."""

from collections.abc import Iterator
from dataclasses import fields
from types import SimpleNamespace
from typing import Any

import numpy as np

from synpick_warp.codes import Ending, Measure, Mode, Outcome, Phase, Status, Task, column_names
from synpick_warp.configs.schema import Config
from synpick_warp.factory.attempts import AttemptLog, EpisodeRecord
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.perception.images import Observation, Plan
from synpick_warp.stages.sim import worlds
from synpick_warp.stages.stream import TickReport
from tests.worlds.small_worlds import settings

Ticks = Iterator[None]
"""A script: each yield is a tick."""

ROOM = 4
OBJECT_IDS = np.array([3, 8, 21], np.int32)
CONFIG = settings(bake__mode="mixed", arrangement__max_objects=ROOM, perception__resolution=[64, 48], suction__tolerated_misses=1)
SETS = ("engaged", "attached")
RAYS = CONFIG.suction.rays


class World:
    """One world's rows of the reports. Observation and plan stay until the next perception, as on the device."""

    def __init__(self, config: Config, device: Any, room: int = ROOM) -> None:
        sizes = worlds.world_sizes(1, room, config.move.rounds, 1, 1)
        self.room = sizes["instance"]
        self.observation, self.plan = (_host(allocate(kind, sizes, device)) for kind in (Observation, Plan))
        self.status = np.zeros((1, len(Status)), np.int32)
        self.measures = np.zeros((1, len(Measure)), np.float32)
        self.engaged, self.attached = np.zeros((2, 1, sizes["word"]), np.uint32)
        self.catalog_index = np.full((1, self.room), -1, np.int32)

    def now(self, *, load: float | None = None, catalog_index: list[int] | None = None, **columns: int) -> None:
        """Change columns and sets of instances; the rest stays, but a cup seals well if as many rays hit as CONFIG demands."""
        if "hits" in columns:
            columns = {"sealed": int(RAYS - columns["hits"] <= CONFIG.suction.tolerated_misses)} | columns
        for name, value in columns.items():
            if name in SETS:
                getattr(self, name)[0] = words(value, self.engaged.shape[1])
            else:
                self.status[0, column_names(Status)[name]] = value
        if load is not None:
            self.measures[0, Measure.PEAK_FORCE] = load
        if catalog_index is not None:
            self.catalog_index[0] = catalog_index

    def frame(self, **columns: object) -> None:
        """As `now`, in the next frame, in which no attempt has ended unless `columns` say so."""
        following = int(self.status[0, Status.FRAME]) + 1
        self.now(**{"frame": following, "outcome": 0, **columns})

    def settle(self, episode: int, arrangement: int, mode: int, catalog_index: list[int]) -> None:
        """An arrangement falls."""
        self.now(
            phase=Phase.SETTLE,
            episode=episode,
            arrangement=arrangement,
            mode=mode,
            frame=-1,
            live=0,
            task=Task.NONE,
            outcome=0,
            attempt=-1,
            ending=0,
            catalog_index=catalog_index,
        )

    def first_frame(self) -> None:
        """The gripper begins to act."""
        move = self.status[0, Status.MODE] == Mode.MOVE
        self.frame(phase=Phase.ACT, live=1, task=Task.NONE if move else Task.LOOK, attempt=-1)

    def look(self, target: int) -> None:
        """Perception chooses a target; arrays that the test does not set change to arbitrary values."""
        self.plan.target[0] = target
        for arrays in (self.plan, self.observation):
            for name, array in vars(arrays).items():
                if name not in ("target", "overflow", "votes", "above", "ancestors"):
                    array += 1

    def begin(self, episode: int, arrangement: int, mode: int, catalog_index: list[int], target: int) -> Ticks:
        """An arrangement falls for a tick; perception chooses a target in the first frame."""
        self.settle(episode, arrangement, mode, catalog_index)
        yield
        self.first_frame()
        self.look(target)
        yield

    def attempt(self, number: int, loads: list[float], **columns: object) -> Ticks:
        """All ticks from the one after the look to the one before the end; then sets what tells of the end."""
        for task in (Task.APPROACH, Task.DESCEND, Task.PRESS):
            self.frame(task=task, attempt=number, load=0.0)
            yield
        for load in loads[:-1]:
            self.frame(task=Task.LIFT, load=load)
            yield
        self.frame(task=Task.LOOK, load=loads[-1], **columns)

    def nothing_seen(self, number: int) -> None:
        """The tick after a look that found nothing."""
        self.frame(task=Task.LOOK, attempt=number, outcome=Outcome.NOTHING_SEEN, attached=0)

    def over(self, ending: Ending) -> None:
        """The current tick is the episode's last."""
        self.now(phase=Phase.OVER, ending=ending, live=int(ending.delivers))


def _host(arrays: Observation | Plan) -> SimpleNamespace:
    return SimpleNamespace(**{item.name: getattr(arrays, item.name).numpy().copy() for item in fields(arrays)})


def play(script: dict[World, Ticks], log: AttemptLog) -> dict[tuple[int, int], EpisodeRecord]:
    """Run worlds side by side, one tick a yield, until all scripts end; (tick, episode) -> the record handed over."""
    found = {}
    for tick in range(1000):
        running = [next(ticks, "end") != "end" for ticks in script.values()]
        if not any(running):
            return found
        for world, runs in zip(script, running, strict=True):
            if not runs:
                world.now(phase=Phase.IDLE, live=0, outcome=0)
        found |= {(tick, episode): record for episode, record in log.update(report(list(script))).items()}
    raise AssertionError("a script does not end")


def report(side_by_side: list[World]) -> TickReport:
    """The report of one tick."""

    def stacked(part: str) -> SimpleNamespace:
        parts = [vars(getattr(world, part)) for world in side_by_side]
        return SimpleNamespace(**{name: np.concatenate([arrays[name] for arrays in parts]) for name in parts[0]})

    parts = [np.concatenate([getattr(world, name) for world in side_by_side]) for name in ("status", "measures", *SETS, "catalog_index")]
    pose = np.zeros((*parts[-1].shape, 7), np.float32)
    return TickReport(*parts, pose, stacked("observation"), stacked("plan"), SimpleNamespace())


def bits(*instances: int) -> int:
    """One bit an instance."""
    return sum(1 << instance for instance in instances)


def words(members: int, count: int) -> list[int]:
    """Words of a bit set from one integer."""
    return [members >> 32 * word & 0xFFFFFFFF for word in range(count)]


def new_world(device: Any) -> World:
    """A world with the settings `CONFIG`."""
    return World(CONFIG, device)


def run(*scripts: tuple[World, Ticks]) -> dict[tuple[int, int], EpisodeRecord]:
    """Play scripts side by side into a new log; see `play`."""
    return play(dict(scripts), AttemptLog(CONFIG.suction, CONFIG.perception.resolution, OBJECT_IDS))
