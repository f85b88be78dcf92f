"""Stand-ins for the processes of devices: they speak the protocol of `factory.worker`, and simulate nothing."""

import os
import signal
import sys
import time
from collections.abc import Sequence
from types import SimpleNamespace

from synpick_warp.errors import OutputError
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.factory.worker import BakeLink
from synpick_warp.system.processes.pool import WorkerProcess, start_process
from tests.harness.processes import wait_for

FOREVER = 60.0
"""Longer than any test waits [s]."""
_SLEEPER = f"import time; time.sleep({FOREVER})"


def program(behaviour: str) -> str:
    """Program of a process that behaves as the function of this module with that name."""
    return f"from synpick_warp.factory.worker import main; main({__name__!r}, {behaviour!r})"


def finish(share: SimpleNamespace, _: Sequence[int], link: BakeLink) -> BakeSummary:
    """Report each episode, and end."""
    link.stage("compiling")
    link.note("an object is never drawn")
    for done, episode in enumerate(share.episodes, start=1):
        counts = {"episodes": len(share.episodes), "worlds_active": 1, "views_per_s": 2.0, "seconds_left": 10.0 * episode}
        link.update(episodes_done=done, views=3 * done, **counts)
    return BakeSummary(episodes=share.episodes)


def _start_writer(handles: Sequence[int], link: BakeLink) -> WorkerProcess:
    """Start a writer that never ends by itself, and report its process id."""
    writer = start_process(_SLEEPER, (), handles)
    link.writers = (writer.process.pid,)
    link.note(f"{os.getpid()} {writer.process.pid}")
    return writer


def wait_for_stop(share: SimpleNamespace, handles: Sequence[int], link: BakeLink) -> BakeSummary:
    """Start a writer, and wait for a stop; the first device is ended by SIGTERM."""
    writer = _start_writer(handles, link)
    if share.episodes == [0]:
        os.kill(os.getpid(), signal.SIGTERM)
    wait_for(lambda: bool(link.number), FOREVER)
    writer.kill()
    return BakeSummary(stopped=link.number)


def ignore_stop(_: SimpleNamespace, handles: Sequence[int], link: BakeLink) -> None:
    """Start a writer, and hear of no stop."""
    _start_writer(handles, link)
    time.sleep(FOREVER)


def die(share: SimpleNamespace, handles: Sequence[int], link: BakeLink) -> BakeSummary:
    """The first device is killed, the others finish."""
    if share.episodes == [0]:
        os.kill(os.getpid(), signal.SIGKILL)
    return finish(share, handles, link)


def fail(share: SimpleNamespace, handles: Sequence[int], link: BakeLink) -> BakeSummary:
    """The first device has an error of the program, the others finish."""
    if share.episodes == [0]:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115 (for the rest of the process)
        raise RuntimeError("CUDA error 700:\nan illegal memory access")
    return finish(share, handles, link)


def refuse(share: SimpleNamespace, handles: Sequence[int], link: BakeLink) -> None:
    """The first device has an error that the user can correct as soon as both others have a writer; they wait."""
    if share.episodes == [0]:
        wait_for(lambda: len(os.listdir(handles[0])) == 2, FOREVER)
        raise OutputError("cannot write here")
    _start_writer(handles, link)
    os.mkdir(str(os.getpid()), dir_fd=handles[0])
    time.sleep(FOREVER)


def lose_one(share: SimpleNamespace, handles: Sequence[int], link: BakeLink) -> BakeSummary:
    """Generate a share of a bake of boxes; of two episodes at least one is lost: the process is killed as it commits the first."""
    from synpick_warp.factory import assembly, pipeline  # The others need no simulator.
    from tests.worlds.small_worlds import catalog

    assembly.load_catalog, commit = lambda config, report: catalog(), pipeline.commit_episode

    def commit_and_die(*arguments: object) -> None:
        commit(*arguments)
        os.kill(os.getpid(), signal.SIGKILL)

    if len(share.episodes) == 2:
        pipeline.commit_episode = commit_and_die
    return pipeline.generate_share(share, handles, link)
