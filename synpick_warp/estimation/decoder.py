"""Decoder process: reads scenes, and decodes their images into memory shared with the estimation."""

from __future__ import annotations

import mmap
import os
import sys
import traceback
from dataclasses import dataclass
from functools import cache
from multiprocessing.connection import Connection
from multiprocessing.reduction import recv_handle
from pathlib import Path
from typing import Any, Protocol

from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import SynpickError
from synpick_warp.estimation.decoding import DecodeJob
from synpick_warp.estimation.scenes import Scene, ScenePlan, read_scene
from synpick_warp.stages.pose.batch import RgbdBatch
from synpick_warp.system.processes import serve


class Decoder:
    """State of the process: the current job and its batches."""

    def __init__(self, link: Connection) -> None:
        self.link = link
        self.job: DecodeJob | None = None
        self.batches: list[RgbdBatch] = []


class Message(Protocol):
    """Message to a decoder process; it is pickled, and answered by what `run` returns."""

    def run(self, decoder: Decoder) -> Any:
        """Execute the message in the decoder process."""
        ...


@dataclass(frozen=True)
class OpenJob:
    """Message: open a job. The file descriptor of its shared memory follows on the link."""

    job: DecodeJob

    def run(self, decoder: Decoder) -> None:
        """See `Message`."""
        handle = recv_handle(decoder.link)
        decoder.batches = []  # The last job's memory is given back first.
        try:
            decoder.job, decoder.batches = self.job, self.job.map_batches(mmap.mmap(handle, self.job.memory_bytes()))
        finally:
            os.close(handle)


@dataclass(frozen=True)
class DecodeViews:
    """Message: decode the views `first` to `stop - 1` of a step into the batch of that index."""

    batch: int
    step: int
    first: int
    stop: int

    def run(self, decoder: Decoder) -> None:
        """See `Message`."""
        assert decoder.job is not None
        for view in range(self.first, self.stop):
            decoder.job.fill_view(decoder.batches[self.batch], view, self.step)


@dataclass(frozen=True)
class ReadScene:
    """Message: read the ground truth of a scene of the data set in a folder."""

    folder: Path
    plan: ScenePlan

    def run(self, decoder: Decoder) -> Scene:
        """See `Message`."""
        return read_scene(_open(self.folder), self.plan)


@dataclass(frozen=True)
class Answer:
    """Answer to a message."""

    value: Any
    error: Exception | None = None
    trace: str = ""
    """Traceback of the error, for developers."""


def answer(message: Message, decoder: Decoder) -> Answer:
    """Execute a message and catch its errors. User errors are returned as they are, unexpected ones as a RuntimeError of one line."""
    try:
        return Answer(message.run(decoder))
    except SynpickError as error:
        return Answer(None, error, traceback.format_exc())
    except Exception as error:
        line = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return Answer(None, RuntimeError(line), traceback.format_exc())


@cache
def _open(folder: Path) -> DataSet:
    return DataSet(folder)


def main() -> None:
    """Serve messages from the socket with handle argv[1] until the parent ends the process or exits."""
    link = Connection(int(sys.argv[1]))
    decoder = Decoder(link)
    serve(link, lambda message: answer(message, decoder))
