"""Task that writes an episode's USD file.

It runs in writer processes, so this module imports neither Warp nor Newton, and pxr only when there is an episode to write.
"""

from __future__ import annotations

from pathlib import Path

from synpick_warp.errors import OutputError
from synpick_warp.exporters.usd.spool import read_ticks
from synpick_warp.exporters.usd.types import EpisodeMetadata, EpisodeSettings
from synpick_warp.exporters.writing.files import sync_file, sync_folder


def write_episode(spool: Path, instances: int, place: Path, metadata: EpisodeMetadata, settings: EpisodeSettings) -> None:
    """Task: write an episode's file beside its spool, and rename it to its place.

    Args:
        spool: File of a `TickSpool`.
        instances: Instance capacity of its rows.
        place: Final path of the episode's file; its folder also holds `assets/`.
        metadata: Properties of the episode.
        settings: Settings common to all episodes.
    """
    from synpick_warp.exporters.usd.parts import save_layer
    from synpick_warp.exporters.usd.stage import make_episode_layer

    ticks = read_ticks(spool, instances)
    if ticks["frame"].tolist() != list(range(metadata.frames)):
        raise OutputError(f"{place} has {len(ticks)} of {metadata.frames} frames; this is an error of synpick-warp, please report it")
    staged = spool.with_name(f"{spool.name}.usdc")
    save_layer(make_episode_layer(ticks, metadata, settings), staged)
    sync_file(staged)
    staged.rename(place)
    sync_folder(place.parent)
