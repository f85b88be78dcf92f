"""Exactness of states of worlds: a branch continues as its episode does, bit by bit, and nothing is forgotten.

Branches: states are saved at many moments, loaded into other worlds while all others go on, and into a simulation of few worlds, and
continued. After every tick the branch's state must be that of the episode's own continuation.

Arrays: every device array that a simulation reaches is found. What is no state, and ever changes from tick to tick, is overwritten between
ticks, by NaN or by numbers of an earlier tick, and then the state is loaded into its own worlds: nothing may change.
"""

import types
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import Mode, Phase, Task
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.sim.simulate import Simulation

OLDER = 3
"""Age of the values that integers are overwritten by [ticks]."""
CONTACTS = "contacts."
"""Prefix of the arrays of contacts in a state on the host."""

Rows = Mapping[str, np.ndarray]
"""State on the host."""


@dataclass
class Result:
    """States that were continued, by moment; what differed; arrays by kind."""

    moments: Counter[str] = field(default_factory=Counter)
    differences: list[str] = field(default_factory=list)
    compared: int = 0
    """Ticks of branches that were compared."""


# ---- branches ----


def check_branches(simulation: Simulation, few: Simulation, states: int, moments: int, ticks: int, apart: int) -> Result:
    """Save states at several moments, continue each in its own world, and then as a branch in others.

    Args:
        simulation: The worlds.
        few: A simulation of fewer worlds of the same settings, into which as many states are loaded, too.
        states: Number of states.
        moments: Number of moments.
        ticks: Ticks that each is continued.
        apart: Ticks between two moments.
    """
    result, each = Result(), max(1, states // moments)
    few.tick()
    for _ in range(moments):
        for _ in range(apart):
            simulation.tick()
        worlds = choose_worlds(simulation, each, result.moments)
        state = simulation.get_state(worlds)
        begin = simulation.states.to_host(state)
        own = watch(simulation, worlds, ticks)
        on, queue = simulation.get_state(range(simulation.layout.worlds)), simulation.state.next_episode.numpy().copy()
        into = [(world + 1 + index) % simulation.layout.worlds for index, world in enumerate(worlds)]
        into = into if len(set(into)) == len(into) else [simulation.layout.worlds - 1 - world for world in worlds]
        simulation.set_state(state, into)
        compare(begin, own, watch(simulation, into, ticks), "in another world", result)
        chosen = range(min(len(worlds), few.layout.worlds))
        few.set_state(state, chosen, chosen)
        compare(begin, own, watch(few, chosen, ticks), "among few worlds", result)
        simulation.set_state(on, range(simulation.layout.worlds))
        simulation.state.next_episode.assign(queue)
    return result


def choose_worlds(simulation: Simulation, count: int, moments: Counter[str]) -> list[int]:
    """Worlds with an episode, at moments that were chosen least often so far, which are counted."""
    state, task = simulation.state, simulation.attempts.task.numpy()
    phase, progress, removed = state.phase.numpy(), state.progress.numpy(), simulation.attempts.removed.numpy()
    mode, names = state.mode.numpy(), {}
    for world in np.flatnonzero((phase == Phase.SETTLE) | (phase == Phase.ACT)):
        name = "settling" if progress[world][3] else "settling without guide walls"
        if phase[world] == Phase.ACT:
            name = Task(int(task[world])).name.lower() if task[world] else "moving"
            name += " after a removal" if removed[world].any() else ""
        name += ", dropped again" if progress[world][2] else ""
        names[int(world)] = f"{Mode(int(mode[world])).name.lower()}: {name}"
    chosen: list[int] = []
    while len(chosen) < min(count, len(names)):
        world = min((world for world in names if world not in chosen), key=lambda world: moments[names[world]])
        moments[names[world]] += 1
        chosen.append(world)
    return sorted(chosen)


def watch(simulation: Simulation, worlds: Sequence[int], ticks: int) -> list[Rows]:
    """States of worlds after each of some ticks."""
    found = []
    for _ in range(ticks):
        simulation.tick()
        found.append(simulation.states.to_host(simulation.get_state(worlds)))
    return found


def compare(begin: Rows, own: Sequence[Rows], branch: Sequence[Rows], where: str, result: Result) -> None:
    """Add to `result` where states of branches differ from those of their episodes, as long as these run."""
    for row in range(len(branch[0]["worlds.phase"])):
        for tick, (expected, found) in enumerate(zip(own, branch, strict=True)):
            if (expected["worlds.arrangement_id"][row] != begin["worlds.arrangement_id"][row]).any():
                break
            result.compared += 1
            names = list(differing(expected, found, row))
            if names:
                result.differences.append(f"row {row} {where}, {tick + 1} ticks later: {', '.join(names[:8])}")
                break


def differing(expected: Rows, found: Rows, row: int, other: int | None = None) -> Iterator[str]:
    """Names of the arrays in which a row differs from another one, None: the same one, of what was found."""
    other = row if other is None else other
    count = int(expected["contacts.count"][row])
    for name, array in expected.items():
        if array.ndim == 0:
            continue
        pair = [array[row], found[name][other]]
        if name.startswith(CONTACTS) and array.ndim > 1:
            pair = [values[:count] for values in pair]
        if len({np.ascontiguousarray(values).tobytes() for values in pair}) > 1:
            yield name


# ---- arrays ----


def check_arrays(simulation: Simulation, ticks: int, kinds: Counter[str]) -> Iterator[str]:
    """Run ticks twice from one state. The second time, before each tick, all is overwritten that is neither state nor constant, and the
    state loaded into its own worlds. `simulation`: the worlds. `ticks`: number of ticks. `kinds`: receives the numbers of arrays: state,
    constant, overwritten. Yields where the second run differs."""
    simulation.tick()
    worlds = range(simulation.layout.worlds)
    state, queue = simulation.get_state(worlds), simulation.state.next_episode.numpy().copy()
    carried, arrays = [*simulation.states.arrays(), simulation.state.next_episode], find_arrays(simulation)
    others = {name: array for name, array in arrays.items() if not any(overlap(array, other) for other in carried)}
    first = {name: array.numpy().copy() for name, array in others.items()}
    changed: dict[str, np.ndarray] = {}
    own, older = [], deque[dict[str, np.ndarray]](maxlen=OLDER)
    for _ in range(ticks):
        own += watch(simulation, worlds, 1)
        older.append({name: array.numpy().copy() for name, array in others.items()})
        for name, values in older[-1].items():
            if not values.dtype.names and (elements := values != first[name]).any():
                changed[name] = changed.get(name, False) | elements
    kinds.update({"state": len(arrays) - len(others), "constant": len(others) - len(changed), "overwritten": len(changed)})
    simulation.set_state(state, worlds)
    simulation.state.next_episode.assign(queue)
    for tick, expected in enumerate(own):
        state = simulation.get_state(worlds)
        for name, elements in changed.items():
            overwrite(others[name], elements, older[0][name])
        simulation.set_state(state, worlds)
        (found,) = watch(simulation, worlds, 1)
        for world in worlds:
            if names := list(differing(expected, found, world)):
                yield f"world {world}, tick {tick + 1}: {', '.join(names[:8])}"


def find_arrays(root: object) -> dict[str, wp.array]:
    """All device arrays that an object reaches, through attributes, containers and structs, by the path to them, each memory once.

    The renderer's scene is left out: meshes, textures and maps that are uploaded once. So are captured graphs, which hold the same arrays.
    """
    seen: set[int] = set()
    arrays: dict[int, tuple[str, wp.array]] = {}
    waiting: list[tuple[str, Any]] = [("simulation", root)]
    while waiting:
        path, value = waiting.pop()
        if id(value) in seen or isinstance(value, RenderScene | wp.Graph | wp.Kernel | wp.Function | wp.Module | type | types.ModuleType):
            continue
        seen.add(id(value))
        if isinstance(value, wp.array):
            if value.ptr and value.size:
                arrays.setdefault(value.ptr, (path, value))
        elif isinstance(value, Mapping):
            waiting += [(f"{path}[{key}]", item) for key, item in value.items()]
        elif isinstance(value, list | tuple):
            waiting += [(f"{path}[{index}]", item) for index, item in enumerate(value)]
        elif type(value).__module__.partition(".")[0] in ("synpick_warp", "newton", "types") or hasattr(value, "_cls"):
            names = [*getattr(value, "__dict__", {}), *getattr(getattr(value, "_cls", None), "vars", {})]
            names += [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ())]
            waiting += [(f"{path}.{name}", getattr(value, name)) for name in names if hasattr(value, name)]
    return dict(arrays.values())


def overlap(one: wp.array, other: wp.array) -> bool:
    """Whether two arrays share memory."""
    first, second = (int(array.ptr or 0) for array in (one, other))
    sizes = [array.size * wp.types.type_size_in_bytes(array.dtype) for array in (one, other)]
    return first < second + sizes[1] and second < first + sizes[0]


def overwrite(array: wp.array, elements: np.ndarray, older: np.ndarray) -> None:
    """Overwrite elements of an array: floats by NaN, integers by their older values."""
    values = array.numpy()
    values[elements] = np.nan if values.dtype.kind == "f" else older[elements]
    array.assign(values)
