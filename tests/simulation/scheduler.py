"""Discrete-event simulation of processes and their threads in virtual time (after FoundationDB's simulator; Zhou et al., 2021).

One thread runs at a time, and hands over at each sleep, wait, lock and request; a seed draws which comes next. So a schedule repeats.
Simulated threads are greenlets, coroutines of one operating-system thread, which switch faster than threads.
"""

from __future__ import annotations

import contextlib
import functools
import math
import random
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pytest
from greenlet import getcurrent, greenlet

from synpick_warp.system import clock

START = 1.8e9
"""Initial virtual time [s since 1970]."""
LONGEST = 1e6
"""Maximum virtual duration of a simulation [s]."""


class Dead(BaseException):
    """Raised in each thread of a killed process at its next scheduling point, and at all later ones."""


class HungError(AssertionError):
    """Deadlock: no thread can continue; or the simulation exceeds LONGEST."""


class Process:
    """Simulated operating system process: it can be killed, with all of its threads, or suspended for a time."""

    def __init__(self, name: str) -> None:
        self.name, self.dead, self.frozen = name, False, 0.0
        """`frozen`: virtual time up to which it is suspended [s]."""


class _Flag:
    """What threads wait for: it is up, or not yet."""

    up = False


class _Task(_Flag):
    """Thread of a process: waits until `flag` is up, or until `wake`. Up when it has ended."""

    def __init__(self, process: Process, body: greenlet, wake: float) -> None:
        self.process, self.body, self.flag, self.wake = process, body, _NEVER, wake


_NEVER = _Flag()


class Simulation:
    """Scheduler: replaces `system.clock` while it is entered, and runs functions as processes."""

    def __init__(self, seed: object) -> None:
        self.draw, self.now = random.Random(repr(seed)), START
        self.points = 0
        """Number of scheduling points so far."""
        self.at_point: Callable[[Process], object] = lambda process: None
        """Called at each scheduling point: it may kill or freeze processes."""
        self.errors: list[tuple[str, BaseException]] = []
        """Errors that ended a thread, with the name of its process."""
        self._main = _Task(Process("main"), getcurrent(), START)
        self._tasks, self._running = [self._main], self._main
        self._awaited, self._ended, self._hung = set[_Task](), _Flag(), False

    def __enter__(self) -> Simulation:
        self._patch = pytest.MonkeyPatch()
        seam = {"time": lambda: self.now, "monotonic": lambda: self.now, "sleep": self.wait}
        seam |= {kind.__name__.removeprefix("_"): functools.partial(kind, self) for kind in (_Event, _Lock, _Thread, _Executor)}
        for name, value in seam.items():
            self._patch.setattr(clock, name, value)
        random.seed(self.draw.random())
        return self

    def __exit__(self, *_: object) -> None:
        for task in self._tasks:
            task.process.dead = task is not self._main
        self._hung = False
        with contextlib.suppress(HungError):
            self._join(self._tasks[1:])
        self._patch.undo()

    def run(self, *processes: tuple[Process, Callable[[], object]]) -> None:
        """Run functions as processes until all of them have ended."""
        self._join([self.start(process, function) for process, function in processes])

    def _join(self, tasks: Iterable[_Task]) -> None:
        self._awaited = set(tasks)
        self._ended.up = not self._awaited
        self.wait(flag=self._ended)

    @property
    def process(self) -> Process:
        """Process of the running thread."""
        return self._running.process

    def start(self, process: Process, function: Callable[[], object]) -> _Task:
        """Start a thread of a process."""
        task = _Task(process, greenlet(lambda *_: self._execute(task, function), self._main.body), self.now)
        self._tasks.append(task)
        return task

    def _execute(self, task: _Task, function: Callable[[], object]) -> None:
        """Run a task, from when it is chosen first."""
        try:
            if not task.process.dead:
                function()
        except Dead:
            pass
        except BaseException as error:
            self.errors.append((task.process.name, error))
        task.up = True
        self._tasks.remove(task)
        self._awaited.discard(task)
        self._ended.up = not self._awaited
        self._running = self._choose()
        task.body.parent = self._running.body

    def wait(self, seconds: float = math.inf, flag: _Flag = _NEVER) -> bool:
        """Scheduling point: block the running thread for a virtual time, or until a flag is up; returns whether it is up."""
        task = self._running
        if task.process.dead:
            raise Dead
        self.points += 1
        self.at_point(task.process)
        task.flag, task.wake = flag, self.now + seconds
        chosen = self._choose()
        if chosen is not task:
            self._running = chosen
            chosen.body.switch()
        if self._hung and task is self._main:
            raise HungError(f"no thread can go on, or none ends: {self.now - START:.1f} s, {len(self._tasks)} threads")
        if task.process.dead:
            raise Dead
        return flag.up

    def _choose(self) -> _Task:
        """Draw the next thread of those that can run first; virtual time goes on to then."""
        now, first, found = self.now, math.inf, [self._main]
        for task in self._tasks:
            process = task.process
            at = now if process.dead or task.flag.up else task.wake
            if at < process.frozen and not process.dead:
                at = process.frozen
            if at < first:
                first, found = at, [task]
            elif at == first:
                found.append(task)
        if first > START + LONGEST:
            self._hung = True
            return self._main
        self.now = first
        return found[int(self.draw.random() * len(found))]


class _Event(_Flag):
    """`threading.Event` in a simulation."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation

    def set(self) -> None:
        self.up = True

    def is_set(self) -> bool:
        return self.up

    def wait(self, timeout: float = math.inf) -> bool:
        return self._simulation.wait(timeout, self)


class _Lock(_Flag):
    """`threading.Lock` in a simulation: up while nobody holds it."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation, self.up = simulation, True

    def __enter__(self) -> None:
        while not self._simulation.wait(flag=self):
            pass
        self.up = False

    def __exit__(self, *_: object) -> None:
        self.up = True


class _Thread:
    """`threading.Thread` in a simulation, of the process that makes it."""

    def __init__(self, simulation: Simulation, target: Callable[[], object], name: str = "", daemon: bool = False) -> None:
        self._simulation, self._target, self._process = simulation, target, simulation.process
        self.name, self._task = name, _Flag()

    def start(self) -> None:
        self._task = self._simulation.start(self._process, self._target)

    def join(self) -> None:
        self._simulation.wait(flag=self._task)


class _Future(_Flag):
    """Result of a task of `_Executor`: up when that has ended."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation, self._result, self._error = simulation, None, None

    def run(self, function: Callable[[], object]) -> None:
        """Run a function, whose result or error this has then."""
        try:
            self._result = function()
        except Dead:
            raise
        except BaseException as error:
            self._error = error
        self.up = True

    def done(self) -> bool:
        return self.up

    def result(self) -> Any:
        self._simulation.wait(flag=self)
        if self._error is not None:
            raise self._error
        return self._result


class _Executor(_Flag):
    """`ThreadPoolExecutor` in a simulation: up while it has nothing to do."""

    def __init__(self, simulation: Simulation, workers: int, name: str = "") -> None:
        self._simulation, self._free, self._waiting, self._open = simulation, workers, [], 0

    @property
    def up(self) -> bool:
        return not (self._waiting or self._open)

    def __enter__(self) -> _Executor:
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()

    def submit(self, function: Callable[..., object], *arguments: object) -> _Future:
        future = _Future(self._simulation)
        self._waiting.append((future, functools.partial(function, *arguments)))
        if self._free:
            self._free -= 1
            self._simulation.start(self._simulation.process, self._work)
        return future

    def _work(self) -> None:
        """Run waiting tasks until there is none."""
        self._open += 1
        while self._waiting:
            future, function = self._waiting.pop(0)
            future.run(function)
        self._open -= 1
        self._free += 1

    def map(self, function: Callable[..., Any], *arguments: Iterable[Any]) -> Iterator[Any]:
        futures = [self.submit(function, *each) for each in zip(*arguments, strict=True)]
        return (future.result() for future in futures)

    def shutdown(self, wait: bool = True, cancel_futures: bool = False) -> None:
        if cancel_futures:
            self._waiting.clear()
        if wait:
            self._simulation.wait(flag=self)
