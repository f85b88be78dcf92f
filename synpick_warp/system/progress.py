"""Progress reporting: the observer interface of a bake, observers that are silent or log, and the callback of a pass over a data set."""

import logging
from collections.abc import Callable
from types import TracebackType
from typing import Any, Protocol, Self

Report = Callable[[str, int, int], None]
"""Progress of a pass over a data set: receives the unit ("views"), the number done and the total."""


def ignore_progress(unit: str, done: int, total: int) -> None:
    """A `Report` that does nothing."""


class Progress(Protocol):
    """Observer of a bake. The caller enters and exits it as a context manager; the bake only reports to it."""

    def __enter__(self) -> Self: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /) -> None: ...

    def stage(self, text: str) -> None:
        """A new stage starts, such as "building worlds"."""

    def update(
        self, *, episodes_done: int, episodes: int, worlds_active: int, views: int, views_per_s: float, seconds_left: float | None
    ) -> None:
        """Report counts, at any rate. `seconds_left` is None while there is no estimate."""

    def note(self, text: str) -> None:
        """Report an event in one line, such as a resampled arrangement."""


class SilentProgress:
    """Observer that ignores all reports."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def stage(self, text: str) -> None: ...

    def update(self, **counts: Any) -> None: ...

    def note(self, text: str) -> None: ...


class LoggedProgress(SilentProgress):
    """Observer that logs to `synpick_warp`: stages as INFO, notes as WARNING, which Python prints by default."""

    def stage(self, text: str) -> None:
        logging.getLogger("synpick_warp").info(text)

    def note(self, text: str) -> None:
        logging.getLogger("synpick_warp").warning(text)


class ForwardingProgress(SilentProgress):
    """Decorator of an observer that passes all reports on: base of decorators that change some. It does not enter or exit the observer."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def stage(self, text: str) -> None:
        self._progress.stage(text)

    def update(self, **counts: Any) -> None:
        self._progress.update(**counts)

    def note(self, text: str) -> None:
        self._progress.note(text)
