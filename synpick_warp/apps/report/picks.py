"""Section of the report on simulated picks: calibration curve and tables of the analytic scores, and heat maps of a state."""

from __future__ import annotations

import base64
from collections.abc import Iterator

from synpick_warp.apps.report.album import encode_photo
from synpick_warp.apps.report.charts import Chart
from synpick_warp.apps.report.markup import Html, element, image, join, table_html
from synpick_warp.apps.statistics.picks import SCORES, PickFigures, picks_tables
from synpick_warp.apps.viz.picks import draw_pick_maps
from synpick_warp.dataset.reading import DataSet
from synpick_warp.system.codecs.charts import INK, Spec, field

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
_SEARCHED = 64
"""Most episodes that are searched for states."""
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
        for count, predicted, observed, low, high in each.calibration.bins()
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
    """Heat maps of some states, and tables of the scores and of objects.

    Raises:
        DatasetError: A file is missing or damaged.
    """
    tables = [table_html(table) for table in picks_tables(figures) if table.name != "pick_calibration"]
    if not figures.scores:
        tables = [element("p", _NO_SCORES, class_="empty")]
    return join([*_state_maps(data_set), *tables])


def _state_maps(data_set: DataSet) -> Iterator[Html]:
    """Figures of the heat maps of states; none if the data set has no colour images."""
    found = []
    for _, episode in zip(range(_SEARCHED), data_set.values(), strict=False):
        if best := max(episode.state_views(), key=lambda one: one[0]["candidates"], default=None):
            found.append((episode, *best))
    for episode, state, view in sorted(found, key=lambda one: -one[1]["candidates"])[:STATES]:
        if not (view.has("rgb") and view.has("mask_visib")):
            continue
        for caption, picture in draw_pick_maps(view, episode.picks[episode.picks["state"] == state["state"]], _MAP_WIDTH):
            photo = encode_photo(picture)
            text = f"Episode {episode.index}, frame {view.frame}: {caption}."
            shown = image(photo.kind, base64.b64encode(photo.data).decode("ascii"), text)
            yield element("figure", shown, element("figcaption", text))
