"""Tasks by which tests look into decoder processes, or end them. Imports nothing that a process would not import itself."""

from __future__ import annotations

import os
import signal
import sys
import time
from dataclasses import dataclass

from synpick_warp.apps.estimation.decoder_pool import Decoder


@dataclass(frozen=True)
class ListModules:
    """Task: send SIGINT to the process, and return the names of its imported modules if it survives."""

    def __call__(self, decoder: Decoder) -> set[str]:
        os.kill(os.getpid(), signal.SIGINT)
        return set(sys.modules)


@dataclass(frozen=True)
class Stop:
    """Task: end the process by a signal."""

    number: int

    def __call__(self, decoder: Decoder) -> None:
        os.kill(os.getpid(), self.number)


@dataclass(frozen=True)
class Sleep:
    """Task: take a while; the answer has some size."""

    seconds: float
    size: int = 0

    def __call__(self, decoder: Decoder) -> bytes:
        time.sleep(self.seconds)
        return bytes(self.size)


@dataclass(frozen=True)
class Divide:
    """Task: fail as a programming error does."""

    def __call__(self, decoder: Decoder) -> float:
        return 1 / 0
