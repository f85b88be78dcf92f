"""Builders that tests share: settings of quick bakes, boxes in place of models, what is baked once for all, commands in this process."""

import fcntl
import io
import json
import os
import pickle
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from synpick_warp.cli.main import main
from synpick_warp.errors import OutputError, SynpickError
from synpick_warp.factory import assembly, pipeline
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.scenes.types import Catalog
from synpick_warp.system.progress import SilentProgress
from tests.worlds import small_worlds
from tests.worlds.small_worlds import SHORT, catalog, settings

COARSE = small_worlds.COARSE | {"render.coarse_pixel": 2, "render.coarse_paths": 1}
"""Settings under which physics takes few steps, and light few paths."""
STIRRING = COARSE | {"move.speed": 4.0}
"""Episodes of some ten frames."""
PICKING = COARSE | SHORT | {"arrangement.max_objects": 2, "pick.failures": 1, "perception.resolution": [160, 90]}
"""Two objects, picked or not."""
PICKED = PICKING | {
    "bake.worlds": 2,
    "bake.episodes": 2,
    "bake.formats": ["bop", "shards", "usd", "zarr"],
    "cameras.resolution": [96, 54],
    "render.layers": ["flow", "classes"],
    "bop.graph": True,
}
"""Settings of the fixture `picked_set`."""
ONE_OBJECT = {
    "arrangement.volume": 1e-3,
    "arrangement.max_objects": 1,
    "physics.substeps": 1,
    "physics.steps_per_tick": 10,
    "settle.min_time": 0.1,
    "settle.rest_ticks": 2,
}
"""One object per world, and as few steps as bring it to rest."""


def assignments(given: Mapping[str, object]) -> tuple[str, ...]:
    """Settings as options of a command line."""
    return tuple(part for key, value in given.items() for part in ("--set", f"{key}={json.dumps(value)}"))


FEW_STEPS = ("--device", "cpu", *assignments(ONE_OBJECT))


@contextmanager
def boxes(objects: Callable[[], Catalog] = catalog) -> Iterator[pytest.MonkeyPatch]:
    """Bakes, streams and tools take boxes in place of models; gives the patches, to add others."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(assembly, "load_catalog", lambda config, report: objects())
        yield patch


@contextmanager
def failing_after(episodes: int) -> Iterator[None]:
    """Bakes within fail when they are to commit one episode more."""
    ended, end = [], pipeline._Run._end

    def fail(*arguments) -> None:
        ended.append(arguments)
        if len(ended) > episodes:
            raise OutputError("no space left")
        end(*arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline._Run, "_end", fail)
        with pytest.raises(OutputError, match="no space left"):
            yield


def bake_boxes(
    out: Path, given: Mapping[str, object], progress: SilentProgress | None = None, objects: Callable[[], Catalog] = catalog
) -> BakeSummary:
    """Bake boxes with these settings on top of QUICK."""
    with boxes(objects):
        return run_bake(settings(**given), out, progress or SilentProgress())


def once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], Any]) -> tuple[Path, Any]:
    """A folder that all processes of a test run share, and what its maker returned: the first that asks makes it, the others wait."""
    base = factory.getbasetemp()
    place = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / f"once-{name}"
    place.mkdir(exist_ok=True)
    with (place / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (place / "made").exists():
            made = make(place / "set")
            (place / "made").write_bytes(pickle.dumps(made))
    return place / "set", pickle.loads((place / "made").read_bytes())


def refusal(call: Callable[..., object], *arguments: Any, **named: Any) -> str:
    """Message of the error, in one line, with which a call refuses its arguments."""
    with pytest.raises(SynpickError) as caught:
        call(*arguments, **named)
    assert "\n" not in str(caught.value)
    return str(caught.value)


class Ran(NamedTuple):
    """Exit code and output of a command."""

    code: int
    out: str
    err: str


def run(*arguments: object) -> Ran:
    """Run a command in this process."""
    with redirect_stdout(io.StringIO()) as out, redirect_stderr(io.StringIO()) as err:
        code = main([str(argument) for argument in arguments])
    return Ran(code, out.getvalue(), err.getvalue())


def mistake(*arguments: object) -> str:
    """Run a command that ends with exit code 2 and one line; returns what it says."""
    code, _, err = run(*arguments)
    assert code == 2, err
    (line,) = err.splitlines()
    assert line.startswith("synpick-warp: error: ")
    return line.removeprefix("synpick-warp: error: ")
