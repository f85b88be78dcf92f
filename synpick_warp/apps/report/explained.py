"""Attempts explained on a page: what was perceived, chosen and engaged, and why; drawing and sentences are those of `explain`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from synpick_warp.apps.report.album import Album, Section, encode_photo
from synpick_warp.apps.report.sampling import Content, SampledEpisodes, spread
from synpick_warp.apps.viz.drawing import instance_color
from synpick_warp.apps.viz.explain import draw_observation, planning_camera
from synpick_warp.apps.viz.explain_graph import KEPT, clutter_edges, lay_out
from synpick_warp.apps.viz.explain_record import (
    CANDIDATES,
    SeenAttempt,
    break_force,
    choice_words,
    labels,
    parse_attempt,
    seal_words,
    suction_kind,
)
from synpick_warp.codes import Outcome
from synpick_warp.configs.cell.gripper import Suction
from synpick_warp.dataset.commit.manifest import episode_entry
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import DatasetError

MAX_ATTEMPTS = 6
"""Attempts on the page."""
MAX_SEARCHED = 64
"""Most episodes that are searched for attempts of every outcome."""
GRAPH_SIZE = (440, 420)
"""Width and height of the clutter graph [px]."""


@dataclass(frozen=True)
class Found:
    """Reference to a chosen attempt."""

    episode: int
    place: int
    """Position in the episode's list."""
    outcome: str


def choose_attempts(data_set: DataSet, episodes: SampledEpisodes) -> list[Found]:
    """Choose attempts: of each outcome in turn, the most frequent first, from different episodes where there are some."""
    found: dict[str, list[Found]] = {}
    for index in spread([index for index, count in episodes.attempts.items() if count], MAX_SEARCHED):
        for place, attempt in enumerate(data_set[index].attempts):
            found.setdefault(str(attempt["outcome"]), []).append(Found(index, place, str(attempt["outcome"])))
    groups = sorted(found.values(), key=lambda group: (-len(group), group[0].outcome))
    share = -(-MAX_ATTEMPTS // max(1, len(groups)))
    spreads = [spread(range(len(group)), share) for group in groups]
    chosen = [
        groups[number][spreads[number][turn]] for turn in range(share) for number in range(len(groups)) if turn < len(spreads[number])
    ]
    return sorted(chosen[:MAX_ATTEMPTS], key=lambda one: (one.episode, one.place))


def make_attempt(data_set: DataSet, found: Found, content: Content, names: Mapping[int, str], album: Album) -> dict[str, Any] | None:
    """JSON of an attempt, whose picture is added to the album; None: it exceeds the budget, or there is no colour image.

    Raises:
        DatasetError: The record or a file is missing or damaged.
    """
    config, episode = data_set.config, data_set[found.episode]
    attempt = parse_attempt(episode.attempts[found.place], f"{data_set.folder / episode_entry(found.episode)}.json")
    if not attempt.frame < len(episode):
        raise DatasetError(f"attempt {attempt.attempt} of episode {found.episode} begins in frame {attempt.frame}; it has {len(episode)}")
    camera = config.rig.index(config.perception.camera)
    view = episode.view(attempt.frame - attempt.frame % episode.frames(camera).step, camera)
    if not view.has("rgb"):
        return None
    picture = draw_observation(attempt, view, planning_camera(config.rig, camera))
    places = album.add(Section.ATTEMPTS, [encode_photo(picture)])
    if places is None:
        return None
    return {
        "episode": attempt.episode,
        "attempt": attempt.attempt,
        "mode": attempt.mode,
        "outcome": found.outcome.replace("_", " "),
        "success": Outcome[found.outcome.upper()].succeeded,
        "sentence": attempt.sentence,
        "frame": attempt.frame,
        "picture": places[0],
        "size": [picture.shape[1], picture.shape[0]],
        "words": [*choice_words(attempt, names, config.target, config.pick), *seal_words(attempt, names, config.suction)],
        "objects": _objects(attempt, names),
        "graph": _graph(attempt, config.perception.min_votes),
        "force": _force(attempt, config.suction, config.physics.tick_time),
    }


def _objects(attempt: SeenAttempt, names: Mapping[int, str]) -> list[dict[str, Any]]:
    """Observed instances for the page, in the order in which the choice rule ranks them."""
    short = labels(attempt)
    return [
        {
            "label": short[one.instance],
            "name": names.get(one.object_id, ""),
            "color": _color(one.instance),
            "above": len(one.ancestors),
            "visible": round(one.visible_fraction, 3),
            "pixels": one.visible,
            "point": CANDIDATES[suction_kind(one)],
            "target": one.instance == attempt.target,
        }
        for one in attempt.ranked()
    ]


def _graph(attempt: SeenAttempt, min_votes: float) -> dict[str, Any] | None:
    """Clutter graph: nodes and curves [px]; None: nothing was seen."""
    if not attempt.seen:
        return None
    edges = clutter_edges(attempt, min_votes)
    layout, short = lay_out(attempt, edges, GRAPH_SIZE), labels(attempt)
    nodes = [
        {
            "label": short[one.instance],
            "place": _rounded(layout.nodes[one.instance]),
            "color": _color(one.instance),
            "above": len(one.ancestors),
            "target": one.instance == attempt.target,
        }
        for one in attempt.seen
    ]
    curves = []
    for edge in edges:
        ends = layout.nodes[edge.upper], layout.nodes[edge.lower]
        points = layout.routes[edge.upper, edge.lower] if edge.state == KEPT else np.array(ends)
        curves.append({"points": [_rounded(point) for point in points], "weight": round(edge.weight), "state": edge.state})
    return {"size": list(GRAPH_SIZE), "nodes": nodes, "edges": curves, "kept": KEPT}


def _force(attempt: SeenAttempt, suction: Suction, tick_time: float) -> dict[str, Any] | None:
    """Seal force over time [s, N], and the force at which the seal breaks; None: nothing was engaged."""
    if not attempt.peak_force or not attempt.hits:
        return None
    values = [{"time": round(tick_time * number, 4), "force": round(force, 3)} for number, force in enumerate(attempt.peak_force)]
    return {"values": values, "limit": break_force(attempt, suction)}


def _color(instance: int) -> str:
    """CSS colour of an instance, as in preview pictures."""
    blue, green, red = instance_color(instance % 256)
    return f"rgb({red} {green} {blue})"


def _rounded(point: Any) -> list[float]:
    """Coordinates as floats rounded to 0.1, for JSON."""
    return [round(float(value), 1) for value in point]
