"""Attempts and simulated picks explained on a page; drawing and sentences are those of `explain`."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from synpick_warp.apps.report.charts import Chart
from synpick_warp.apps.report.frames import Album, SampledEpisodes, Section, css_color, encode_photo, spread
from synpick_warp.apps.report.page import Html, element, image, join, table_html
from synpick_warp.apps.statistics.picks import SCORES, PickFigures, picks_tables
from synpick_warp.apps.viz import explain_record
from synpick_warp.apps.viz.explain import draw_observation, planning_camera
from synpick_warp.apps.viz.picks import draw_pick_maps
from synpick_warp.codes import Outcome
from synpick_warp.configs.cell.gripper import Suction
from synpick_warp.dataset.commit.manifest import episode_entry
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import DatasetError
from synpick_warp.system.codecs.charts import INK, Spec, field

MAX_ATTEMPTS = 6
"""Attempts on the page."""
MAX_SEARCHED = 64
"""Most episodes that are searched for attempts of every outcome, and for states."""
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


def make_attempt(data_set: DataSet, found: Found, names: Mapping[int, str], album: Album) -> dict[str, Any] | None:
    """JSON of an attempt, whose picture is added to the album; None: it exceeds the budget, or there is no colour image. Raises
    DatasetError if the record or a file is missing or damaged."""
    config, episode = data_set.config, data_set[found.episode]
    attempt = explain_record.parse_attempt(episode.attempts[found.place], f"{data_set.folder / episode_entry(found.episode)}.json")
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
        "words": [
            *explain_record.choice_words(attempt, names, config.target, config.pick),
            *explain_record.seal_words(attempt, names, config.suction),
        ],
        "objects": _objects(attempt, names),
        "graph": _graph(attempt, config.perception.min_votes),
        "force": _force(attempt, config.suction, config.physics.tick_time),
    }


def _objects(attempt: explain_record.SeenAttempt, names: Mapping[int, str]) -> list[dict[str, Any]]:
    """Observed instances for the page, in the order in which the choice rule ranks them."""
    short = explain_record.labels(attempt)
    return [
        {
            "label": short[one.instance],
            "name": names.get(one.object_id, ""),
            "color": css_color(one.instance),
            "above": len(one.ancestors),
            "visible": round(one.visible_fraction, 3),
            "pixels": one.visible,
            "point": explain_record.CANDIDATES[explain_record.suction_kind(one)],
            "target": one.instance == attempt.target,
        }
        for one in attempt.ranked()
    ]


def _graph(attempt: explain_record.SeenAttempt, min_votes: float) -> dict[str, Any] | None:
    """Clutter graph: nodes and curves [px]; None: nothing was seen."""
    if not attempt.seen:
        return None
    edges = explain_record.clutter_edges(attempt, min_votes)
    layout, short = explain_record.lay_out(attempt, edges, GRAPH_SIZE), explain_record.labels(attempt)
    nodes = [
        {
            "label": short[one.instance],
            "place": _rounded(layout.nodes[one.instance]),
            "color": css_color(one.instance),
            "above": len(one.ancestors),
            "target": one.instance == attempt.target,
        }
        for one in attempt.seen
    ]
    curves = []
    for edge in edges:
        ends = layout.nodes[edge.upper], layout.nodes[edge.lower]
        points = layout.routes[edge.upper, edge.lower] if edge.state == explain_record.KEPT else np.array(ends)
        curves.append({"points": [_rounded(point) for point in points], "weight": round(edge.weight), "state": edge.state})
    return {"size": list(GRAPH_SIZE), "nodes": nodes, "edges": curves, "kept": explain_record.KEPT}


def _force(attempt: explain_record.SeenAttempt, suction: Suction, tick_time: float) -> dict[str, Any] | None:
    """Seal force over time [s, N], and the force at which the seal breaks; None: nothing was engaged."""
    if not attempt.peak_force or not attempt.hits:
        return None
    values = [{"time": round(tick_time * number, 4), "force": round(force, 3)} for number, force in enumerate(attempt.peak_force)]
    return {"values": values, "limit": explain_record.break_force(attempt, suction)}


def _rounded(point: Any) -> list[float]:
    """Coordinates as floats rounded to 0.1, for JSON."""
    return [round(float(value), 1) for value in point]


HEIGHT = 320
"""Height of the calibration curve [px]."""
STATES = 2
"""States of which heat maps are shown: those with the most candidates, of different episodes."""
DRAWS = 300
"""Bootstrap samples: enough for two digits."""
PICKS_LEAD = (
    "Grasps that were tried in simulation from states of the episodes: heat maps of success between the tried points, beside the analytic"
    " score of SuctionNet at the same points, and how well that score predicts success."
)
_NO_SCORES = (
    "No score is evaluated: no sampled candidate has an outcome. With picks.candidates = 1 only the episodes' own grasps are tried."
)
_MAP_WIDTH = 640
"""Width of a heat map [px]."""


def calibration_spec(figures: PickFigures) -> Spec:
    """Vega-Lite reliability diagram of SuctionNet's score: success rate over mean score by bin, with 95 % intervals; on the diagonal the
    score is the probability of success. Discs grow with the number of trials."""
    rows = [
        {"predicted": float(predicted), "observed": float(observed), "count": int(count), "candidates": each.population}
        | ({} if low != low else {"low": float(low), "high": float(high)})
        for each in figures.scores
        if each.score == SCORES[0]
        for count, predicted, observed, low, high in each.calibration.bins
        if predicted == predicted
    ]
    share = {"domain": [0, 1], "nice": False}
    x = field("predicted", "quantitative", "analytic score, seal x wrench", scale=share)
    y = field("observed", "quantitative", "simulated success", scale=share)
    color = field("candidates", "nominal", None, legend={"orient": "top", "labelLimit": 0})
    tooltip = [
        field("predicted", "quantitative", "mean score", format=".2f"),
        field("observed", "quantitative", "success", format=".1%"),
        field("low", "quantitative", "from", format=".1%"),
        field("high", "quantitative", "to", format=".1%"),
        field("count", "quantitative", "trials", format=","),
    ]
    diagonal = [{"predicted": 0, "observed": 0}, {"predicted": 1, "observed": 1}]
    return {
        "height": HEIGHT,
        "layer": [
            {
                "data": {"values": diagonal},
                "mark": {"type": "line", "strokeDash": [4, 4], "color": INK, "opacity": 0.5},
                "encoding": {"x": x, "y": y},
            },
            {
                "data": {"values": rows},
                "encoding": {"x": x, "color": color, "tooltip": tooltip},
                "layer": [
                    {"mark": {"type": "rule", "strokeWidth": 2}, "encoding": {"y": {**y, "field": "low"}, "y2": {"field": "high"}}},
                    {"mark": {"type": "line", "strokeWidth": 2}, "encoding": {"y": y}},
                    {
                        "mark": {"type": "point", "filled": True, "opacity": 1},
                        "encoding": {"y": y, "size": field("count", "quantitative", None, legend=None, scale={"range": [30, 260]})},
                    },
                ],
            },
        ],
    }


def calibration_chart(figures: PickFigures) -> Chart:
    """The calibration curve as a chart of the report."""
    first = figures.scores[0]
    caption = (
        f"Share of successful picks by SuctionNet's analytic score, with 95 % intervals over {figures.states:,} states; where it was a"
        f" probability, points would lie on the dashed line. AUC {first.auc.value:.3f}, calibration error"
        f" {first.calibration.error.value:.3f} ({first.population})."
    )
    return Chart("calibration", "Analytic score and simulated success", caption, calibration_spec(figures))


def picks_section(data_set: DataSet, figures: PickFigures) -> Html:
    """Heat maps of some states, and tables of the scores and of objects; raises DatasetError if a file is missing or damaged."""
    tables = [table_html(table) for table in picks_tables(figures) if table.name != "pick_calibration"]
    if not figures.scores:
        tables = [element("p", _NO_SCORES, class_="empty")]
    return join([*_state_maps(data_set), *tables])


def _state_maps(data_set: DataSet) -> Iterator[Html]:
    """Figures of the heat maps of states; none if the data set has no colour images."""
    found = []
    for _, episode in zip(range(MAX_SEARCHED), data_set.values(), strict=False):
        if best := max(episode.state_views(), key=lambda one: one[0]["candidates"], default=None):
            found.append((episode, *best))
    for episode, state, view in sorted(found, key=lambda one: -one[1]["candidates"])[:STATES]:
        if not (view.has("rgb") and view.has("mask_visib")):
            continue
        for caption, picture in draw_pick_maps(view, episode.picks[episode.picks["state"] == state["state"]], _MAP_WIDTH):
            photo = encode_photo(picture)
            text = f"Episode {episode.index}, frame {view.frame}: {caption}."
            shown = image(photo.kind, photo.text, text)
            yield element("figure", shown, element("figcaption", text))
