"""Worker process of a validation: runs tasks until the parent ends it."""

from __future__ import annotations

import sys
from multiprocessing.connection import Connection
from pathlib import Path

from synpick_warp.system.processes import serve
from synpick_warp.validation.tasks import State, run_task


def main() -> None:
    """Serve tasks from the socket with handle argv[1]; the first message is the data set's folder."""
    link = Connection(int(sys.argv[1]))
    states: list[State] = []

    def answer(message: object) -> object:
        if isinstance(message, Path):
            states.append(State(message))
            return None
        return run_task(message, states[0])  # pyright: ignore[reportArgumentType]

    serve(link, answer)
