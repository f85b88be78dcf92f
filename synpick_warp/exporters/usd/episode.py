"""One episode as a USD file: what stands where at every tick, seen by which cameras, in which light.

Runs in writer processes, so it imports neither Warp nor Newton, and pxr only when there is an episode to write.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from synpick_warp.codes import Ending
from synpick_warp.errors import OutputError
from synpick_warp.exporters.usd.lights import StageLight
from synpick_warp.exporters.usd.spool import read_ticks
from synpick_warp.exporters.writing.files import sync_file, sync_folder
from synpick_warp.frames import EpisodeEnd
from synpick_warp.scenes.types import Camera


@dataclass(frozen=True)
class EpisodeSettings:
    """What all episodes share."""

    tick_rate: float
    """[1/s]"""
    gravity: float
    """[m/s²]"""
    cameras: tuple[Camera, ...]
    lights: tuple[StageLight, ...]
    names: dict[int, str]
    """Of objects, by obj_id."""


@dataclass(frozen=True)
class EpisodeFacts:
    """What a file says of its episode."""

    episode: int
    redraw: int
    frames: int
    ending: str

    @staticmethod
    def of(end: EpisodeEnd) -> EpisodeFacts:
        """From the episode's end."""
        return EpisodeFacts(end.episode, end.redraw, end.frames, Ending(end.ending).name.lower())


def write_episode(spool: Path, instances: int, place: Path, facts: EpisodeFacts, settings: EpisodeSettings) -> None:
    """Make an episode's file beside its gathered ticks, move it to its place, and remove the ticks.

    Args:
        spool: File of a `TickSpool`.
        instances: Room for instances in it.
        place: The episode's file; its folder also holds `assets/`.
        facts: What the file says of the episode.
        settings: What all episodes share.
    """
    from pxr import Work

    from synpick_warp.exporters.usd.parts import save_layer
    from synpick_warp.exporters.usd.stage import episode_layer

    Work.SetConcurrencyLimit(1)  # type: ignore[attr-defined]  # The processes are the parallelism.
    ticks = read_ticks(spool, instances)
    if ticks["frame"].tolist() != list(range(facts.frames)):
        raise OutputError(f"{place} has {len(ticks)} of {facts.frames} frames; this is an error of synpick-warp, please report it")
    hidden = spool.with_name(f"{spool.name}.usdc")
    save_layer(episode_layer(ticks, facts, settings), hidden)
    sync_file(hidden)
    hidden.rename(place)
    sync_folder(place.parent)
    spool.unlink()


def drop_episode(spool: Path) -> None:
    """Remove what was gathered of an arrangement that will not be delivered."""
    spool.unlink(missing_ok=True)
