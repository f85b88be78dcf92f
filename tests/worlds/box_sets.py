"""Finished data sets of boxes, written by the exporters without a bake: two episodes of three frames and cameras, three instances; and
the content of manifest entries of episodes, as a bake gives it."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from synpick_warp.codes import Ending
from synpick_warp.configs.files.load import config_to_toml
from synpick_warp.dataset.commit.manifest import CONFIG_FILE, ENTRIES, MANIFEST_FILE, episode_entry
from synpick_warp.exporters.bop.scene_exporter import BopExporter
from synpick_warp.exporters.picks import PicksExporter
from synpick_warp.factory.episodes import EpisodeOutcome
from synpick_warp.testing.box_views import config, pick_batch
from synpick_warp.testing.exporters import FRAMES, export
from synpick_warp.views.frames import EpisodeEnd
from tests.worlds import trajectories

EPISODES = (0, 2)
LAYERS = ("classes", "flow")
ATTEMPT = trajectories.ATTEMPT | {"episode": 2, "outcome": "dropped"}


def write_set(folder: Path, exporter: type, **bop: object) -> Path:
    """A finished data set of boxes, with settings and manifest."""
    settings = config(LAYERS, **({"split": "train", "color_format": "png"} | bop))
    export(exporter, folder, settings, EPISODES)
    (folder / CONFIG_FILE).write_text(config_to_toml(settings))
    (folder / MANIFEST_FILE).write_text("{}")
    (folder / ENTRIES).mkdir()
    for episode in EPISODES:
        content = episode_content(episode, FRAMES, [ATTEMPT] if episode == 2 else [])
        (folder / f"{episode_entry(episode)}.json").write_text(json.dumps(content | {"files": 0, "bytes": 0, "checksum": 64 * "0"}))
    return folder


class _BopWithPicks(BopExporter):
    """Scenes of boxes with scene_picks.json."""

    def end_episode(self, end: EpisodeEnd, on_committed: Callable[[], None]) -> None:
        self.write_picks(pick_batch(end.episode))
        super().end_episode(end, on_committed)


def write_pick_set(folder: Path) -> Path:
    """A finished data set of boxes with picks, in the formats bop and picks."""
    write_set(folder, _BopWithPicks)
    export(PicksExporter, folder, config(), EPISODES)
    settings = (folder / CONFIG_FILE).read_text()
    (folder / CONFIG_FILE).write_text(settings.replace('formats = ["bop"]', 'formats = ["bop", "picks"]'))
    return folder


def episode_content(episode: int, frames: int = 3, attempts: Sequence[dict[str, Any]] = ()) -> dict[str, Any]:
    """Entry of a finished episode, without its files."""
    row = EpisodeOutcome(episode, 0, Ending.FINISHED, frames, 0.1, "pick" if attempts else "move", 3, len(attempts), 1, 0, 2)
    return {"episode": episode, "row": row.as_json(), "attempts": [attempt | {"episode": episode} for attempt in attempts]}
