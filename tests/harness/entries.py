"""Content of manifest entries of episodes, as a bake gives it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from synpick_warp.codes import Ending
from synpick_warp.factory.episodes import EpisodeOutcome


def episode_content(episode: int, frames: int = 3, attempts: Sequence[dict[str, Any]] = ()) -> dict[str, Any]:
    """Entry of a finished episode, without its files."""
    row = EpisodeOutcome(episode, 0, Ending.FINISHED, frames, 0.1, "pick" if attempts else "move", 3, len(attempts), 1, 0, 2)
    return {"episode": episode, "row": row.as_json(), "attempts": [attempt | {"episode": episode} for attempt in attempts]}
