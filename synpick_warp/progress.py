"""What a long run tells whoever watches it."""

from __future__ import annotations

from types import TracebackType
from typing import Protocol, Self


class Progress(Protocol):
    """A watcher of a bake. Whoever makes it enters it before the bake and leaves it afterwards; the bake only reports."""

    def __enter__(self) -> Self: ...

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None: ...

    def stage(self, text: str) -> None:
        """A new stage begins, such as "building 512 worlds"."""
        ...

    def update(
        self, *, episodes_done: int, episodes: int, worlds_active: int, views: int, views_per_s: float, seconds_left: float | None
    ) -> None:
        """How far it is. May be called at any rate. `seconds_left` is None while nothing can be said."""
        ...

    def note(self, text: str) -> None:
        """Something worth a line of its own, such as a drawn-again arrangement."""
        ...


class SilentProgress:
    """Watches and says nothing: for tests and tools."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        return None

    def stage(self, text: str) -> None:
        """Ignored."""

    def update(
        self, *, episodes_done: int, episodes: int, worlds_active: int, views: int, views_per_s: float, seconds_left: float | None
    ) -> None:
        """Ignored."""

    def note(self, text: str) -> None:
        """Ignored."""
