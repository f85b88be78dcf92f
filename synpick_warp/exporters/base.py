"""The contract of all exporters: views in, whole episodes on disk out."""

from __future__ import annotations

from typing import Protocol

from synpick_warp.frames import EpisodeEnd, FrameBatch


class Exporter(Protocol):
    """Takes every view of a bake. Calls come from one thread; each may raise `OutputError` for what failed since the last."""

    def write(self, batch: FrameBatch) -> None:
        """Take a batch; copies what it needs. Waits while the writers are behind.

        The frames of an episode come in order, all before its end.
        """
        ...

    def end(self, end: EpisodeEnd) -> None:
        """Finish the episode's files, or drop them if its ending delivers nothing: it then comes again from frame 0."""
        ...

    def close(self) -> None:
        """Wait until all episodes that ended are whole, and complete the data set."""
        ...

    def abort(self) -> None:
        """Stop at once; whole episodes stay, everything else goes. Never raises."""
        ...
