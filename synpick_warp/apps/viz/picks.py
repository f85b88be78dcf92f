"""Pictures of simulated picks: heat maps of success and of the analytic score over visible objects, and one trial explained."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import KDTree

from synpick_warp.apps.viz.drawing import INK, WHITE, Image, blank, check_picture_name, paste, put_text, write_picture
from synpick_warp.apps.viz.explain import GREEN, LINE, TEXT, wrapped
from synpick_warp.apps.viz.explain_record import disc, fixed
from synpick_warp.codes import Ending, Outcome, Share
from synpick_warp.dataset.bop.layout import names_of
from synpick_warp.dataset.reading import DataSet, Episode
from synpick_warp.dataset.view import View, mean_by_candidate
from synpick_warp.errors import DatasetError

NEIGHBOURS = 4
"""Number of nearest tried points of the same instance from which a pixel of a heat map is interpolated."""
WIDTH = 880
"""Width of a heat map on a sheet [px]."""
CROP = 0.12
"""Side of the square around the grasp point of an explained trial [m]."""
_CROP_WIDTH = 440
"""Width of its picture [px]."""
_RED = (40, 40, 200)
_DIM = 0.35
"""Brightness of the colour image under a heat map."""
_OPACITY = 0.72
"""Opacity of a heat map."""
_MARGIN = 20
_HEAD = 48
"""Height of the headline and of the captions below it [px]."""


def spread_over_surface(view: View, points: np.ndarray, instances: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Inverse distance weighting (Shepard, 1968) of values over the visible pixels of instances (H, W) float64; NaN: no point on it.

    Weights are inverse squared distances in the image to the NEIGHBOURS nearest points (point, 2) [px] of the same instance (point).
    """
    width, height = view.size
    result = np.full((height, width), np.nan)
    for instance, mask in zip(view.instance_ids.tolist(), view.masks, strict=True):
        own = instances == instance
        pixels = np.argwhere(mask)
        if not own.any() or not len(pixels):
            continue
        distance, nearest = KDTree(points[own]).query(pixels[:, ::-1] + 0.5, k=min(NEIGHBOURS, int(own.sum())))
        weight = 1.0 / np.maximum(np.reshape(distance, (len(pixels), -1)), 0.5) ** 2
        near = np.reshape(values[own][nearest], weight.shape)
        result[mask] = (weight * near).sum(axis=1) / weight.sum(axis=1)
    return result


def draw_heat(view: View, values: np.ndarray) -> Image:
    """Blend a heat map of values (H, W) from 0 (blue) to 1 (yellow) over a view's dimmed grey image; NaN: not coloured."""
    grey = cv2.cvtColor(cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2BGR)
    colors = heat_colors(np.nan_to_num(values))
    known = ~np.isnan(values)[..., None]
    shade = 0.6 + 0.4 * grey / 255.0  # The relief of the surface stays visible.
    return np.where(known, _OPACITY * colors * shade + (1 - _OPACITY) * grey, _DIM * grey).astype(np.uint8)


def heat_colors(values: np.ndarray) -> Image:
    """Map values (H, W) from 0 to 1 to VIRIDIS colours, as for the layers of suction."""
    return cv2.applyColorMap(np.rint(255.0 * np.clip(values, 0.0, 1.0)).astype(np.uint8), cv2.COLORMAP_VIRIDIS)


def draw_pick_maps(view: View, picks: np.ndarray, width: int = WIDTH) -> list[tuple[str, Image]]:
    """Heat maps of the picks that were tried from a view's frame, with the tried points: simulated success, and the analytic score. Returns
    caption and picture of each, `width` pixels wide."""
    first, success = mean_by_candidate(picks)
    tried = picks[first]
    score = (tried["seal"] * tried["wrench"]).astype(np.float64)
    points = view.project(tried["point"], view.world_to_camera)
    scale = width / view.size[0]
    size = (width, round(scale * view.size[1]))
    maps = []
    for name, values in (("simulated success", success), ("analytic score, seal x wrench", score)):
        heat = cv2.resize(draw_heat(view, spread_over_surface(view, points, tried["instance"], values)), size, interpolation=cv2.INTER_AREA)
        for place, color, won in zip(scale * points, heat_colors(values[None])[0].tolist(), success > 0.5, strict=True):
            disc(heat, place - 0.5, 4.6, WHITE if won else INK)
            disc(heat, place - 0.5, 3.2, tuple(color))
        mean = f"mean {values.mean():.2f}" if len(values) else "none tried"
        maps.append((f"{name}: yellow 1, blue 0; {mean} of {len(values)} points; white rim: it held", heat))
    return maps


def describe_trial(trial: Mapping[str, Any] | np.void, name: str) -> list[str]:
    """Explain a trial in sentences, from its row; `name`: that of the intended object."""
    tilt, aside = (
        math.degrees(math.acos(float(np.clip(-trial["approach"] @ axis, -1.0, 1.0))))
        for axis in (np.array([0.0, 0.0, 1.0]), trial["normal"])
    )
    place = ", ".join(f"{1e3 * value:.0f}" for value in trial["point"])
    how = Share(int(trial["share"])).name.lower()
    lines = [
        f"candidate {trial['candidate']} of state {trial['state']} ({how}), trial {trial['repeat']}: on {name} at ({place}) mm,"
        f" pressed {tilt:.0f} degrees off the vertical, {aside:.0f} off the surface normal",
        f"analytic: seal {trial['seal']:.2f}, wrench {trial['wrench']:.2f}, score {trial['seal'] * trial['wrench']:.2f}",
    ]
    if np.any(trial["offset"]) or np.any(trial["rotation"]) or trial["friction"] != 1.0:
        turned = math.degrees(float(np.linalg.norm(trial["rotation"])))
        lines.append(
            f"perturbed: point by {1e3 * float(np.linalg.norm(trial['offset'])):.1f} mm, cup by {turned:.1f} degrees, "
            f"friction by a factor of {trial['friction']:.2f}"
        )
    outcome, ending = Outcome(int(trial["outcome"])), Ending(int(trial["ending"]))
    if outcome is Outcome.NONE:
        return [*lines, f"no outcome: {ending.sentence}"]
    if not trial["hits"]:
        lines.append("suction on: no ray of the cup hit an object")
    else:
        sealed = int(trial["sealed"]).bit_count()
        lines.append(f"suction on: {trial['hits']} rays hit; {'good' if sealed else 'poor'} seal{'s' if sealed > 1 else ''}")
        load = f"largest seal force {trial['peak_force']:.1f} N"
        if not np.isnan(trial["margin"]):
            load += f", margin {trial['margin']:.2f}"
        lines.append(load if np.isnan(trial["time_to_break"]) else f"{load}: it broke after {trial['time_to_break']:.2f} s")
    lines.append(f"outcome: {outcome.sentence}")
    moved = (
        f"{trial['moved']} other objects moved, by up to {1e3 * trial['farthest']:.0f} mm" if trial["moved"] else "no other object moved"
    )
    return [*lines, moved + (f"; {trial['lost']} fell out of the bin" if trial["lost"] else "")]


def draw_trial(view: View, trial: np.void, radius: float) -> Image:
    """Draw a trial over a crop of the colour image: the cup's rim (`radius` [m]) on the surface, and its direction of approach."""
    point, normal = np.asarray(trial["point"], np.float64), np.asarray(trial["normal"], np.float64)
    center = view.project(point, view.world_to_camera)
    depth = (view.world_to_camera[:3, :3] @ point + view.world_to_camera[:3, 3])[2]
    scale = _CROP_WIDTH / (CROP * view.intrinsics[0, 0] / depth)
    corner = center - _CROP_WIDTH / scale / 2
    move = np.array([[scale, 0.0, -scale * corner[0]], [0.0, scale, -scale * corner[1]]])
    crop = cv2.warpAffine(view.rgb[..., ::-1], move, (_CROP_WIDTH, _CROP_WIDTH), flags=cv2.INTER_LINEAR, borderValue=WHITE)
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    turn = np.linspace(0.0, 2 * np.pi, 49)
    rim = point + radius * (np.outer(np.cos(turn), first) + np.outer(np.sin(turn), np.cross(normal, first)))
    shaft = np.stack((point - 0.04 * np.asarray(trial["approach"], np.float64), point))
    color = GREEN if trial["success"] else _RED
    for line, closed in ((rim, True), (shaft, False)):
        places = fixed(scale * (view.project(line, view.world_to_camera) - corner) - 0.5)
        cv2.polylines(crop, [places], closed, WHITE, 6, cv2.LINE_AA, 4)
        cv2.polylines(crop, [places], closed, color, 3, cv2.LINE_AA, 4)
    return crop


def choose_trial(picks: np.ndarray, candidate: int | None = None) -> np.void:
    """Choose a trial to explain: the unperturbed failure with the highest analytic score; without failures, the success with the lowest.
    With `candidate`, its first trial; raises DatasetError if there is no such candidate."""
    rows: Any = picks  # NumPy's stubs take a row of a structured array for an array.
    if candidate is not None:
        own = np.flatnonzero(picks["candidate"] == candidate)
        if not len(own):
            raise DatasetError(f"the state has no candidate {candidate}; it has {len(np.unique(picks['candidate']))} candidates")
        return rows[own[0]]
    plain = np.flatnonzero(picks["repeat"] == picks["repeat"].min())
    score, failed = picks["seal"][plain] * picks["wrench"][plain], ~picks["success"][plain]
    return rows[plain[np.argmax(np.where(failed, score, -1.0)) if failed.any() else np.argmin(score)]]


def write_pick_sheet(data_set: DataSet, out: Path, episode: int | None, state: int | None = None, candidate: int | None = None) -> Path:
    """Draw the heat maps of a state, and below them a trial explained: picture and sentences.

    None stands for the first episode with trials, its first state, and the candidate of `choose_trial`. Raises DatasetError if there is no
    such state or candidate, or a file is missing or damaged, and OutputError if the picture cannot be written.
    """
    check_picture_name(out)
    chosen = _find_episode(data_set, episode)
    states = chosen.pick_states
    index = int(states["state"][0]) if state is None else state
    if index not in states["state"]:
        raise DatasetError(f"episode {chosen.index} has no state {index}; it has {len(states)} states")
    row = states[states["state"] == index][0]
    picks = chosen.picks[chosen.picks["state"] == index]
    view = next((view for found, view in chosen.state_views() if found["state"] == index), None)
    if view is None:
        raise DatasetError(f"camera {row['camera']} has no picture in frame {row['frame']}, of state {index} of episode {chosen.index}")
    return write_picture(out, _compose(view, picks, choose_trial(picks, candidate), names_of(data_set), data_set.config.suction.radius))


def write_pick_maps(data_set: DataSet, out: Path, count: int) -> Path:
    """Draw the heat maps of up to `count` states, evenly spread over those of the data set, one below the other; raises DatasetError if
    there is no state, or a file is missing or damaged, and OutputError if the picture cannot be written."""
    check_picture_name(out)
    states = [(episode, state, view) for episode in data_set.values() for state, view in episode.state_views()]
    if not states:
        raise DatasetError(f"{data_set.folder} has no state from which picks were tried, with a picture")
    rows = []
    for place in np.linspace(0, len(states) - 1, min(count, len(states))).round().astype(int).tolist():
        episode, state, view = states[place]
        picks = episode.picks[episode.picks["state"] == state["state"]]
        rows.append(_maps_row(f"Episode {episode.index}, frame {view.frame}: {len(picks):,} trials from one state", view, picks))
    return write_picture(out, np.concatenate(rows))


def _find_episode(data_set: DataSet, episode: int | None) -> Episode:
    """An episode with states; None: the first of them. Raises DatasetError if there is none."""
    if episode is not None and episode not in data_set:
        raise DatasetError(f"{data_set.folder} has no episode {episode}")
    found = next((each for each in ([data_set[episode]] if episode is not None else data_set.values()) if len(each.pick_states)), None)
    if found is None:
        raise DatasetError(f"{data_set.folder if episode is None else f'episode {episode}'} has no state from which picks were tried")
    return found


def _maps_row(head: str, view: View, picks: np.ndarray) -> Image:
    """Two heat maps beside each other, with a headline and their captions above."""
    maps = draw_pick_maps(view, picks)
    row = blank(2 * WIDTH + 3 * _MARGIN, _HEAD + maps[0][1].shape[0] + _MARGIN)
    put_text(row, head, (_MARGIN, 18), 1.3 * TEXT, INK, 2)
    for number, (caption, picture) in enumerate(maps):
        left = _MARGIN + number * (WIDTH + _MARGIN)
        put_text(row, caption, (left, _HEAD - 8), TEXT, INK)
        paste(row, picture, left, _HEAD)
    return row


def _compose(view: View, picks: np.ndarray, trial: np.void, names: Mapping[int, str], radius: float) -> Image:
    """Sheet of a state: two heat maps beside each other, below them the picture of a trial and its sentences."""
    head = f"Episode {view.episode}, frame {view.frame}, camera {view.camera}: {len(picks):,} trials from one state"
    maps, crop = _maps_row(head, view, picks), draw_trial(view, trial, radius)
    name = f"{names.get(int(trial['obj_id']), 'object')} (instance {trial['instance']})"
    lines = [line for text in describe_trial(trial, name) for line in wrapped(text, 1.3 * TEXT, 2 * WIDTH - _CROP_WIDTH)]
    below = blank(maps.shape[1], max(_CROP_WIDTH, round(1.3 * LINE) * len(lines)) + _MARGIN)
    paste(below, crop, _MARGIN, 0)
    for number, line in enumerate(lines):
        color = (GREEN if trial["success"] else _RED) if line.startswith("outcome") else INK
        put_text(below, line, (2 * _MARGIN + _CROP_WIDTH, round(1.3 * LINE) * (number + 1) - 8), 1.3 * TEXT, color)
    return np.concatenate((maps, below))
