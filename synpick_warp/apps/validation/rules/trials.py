"""Validation rules of simulated picks: tables against each other, geometry against views, outcomes against measurements."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from synpick_warp.apps.validation.registry import Findings, rule
from synpick_warp.codes import Ending, Outcome, Share
from synpick_warp.dataset.reading import Episode, open_data_set
from synpick_warp.dataset.view import View
from synpick_warp.views.picks import MOVED

UNIT = 1e-3
"""Largest deviation of a direction's length from 1."""
NEAR = 5e-3
"""Largest distance of a grasp point from the depth image, along the optical axis [m]."""
PIXEL = 0.01
"""Largest distance of a projected point from its pixel, beyond its sides [px of the perception image]."""
UNSEEN = 0.05
"""Largest share of points that a view with wider pixels than the perception image may miss, as no pixel's centre shows them: thin parts
and edges. It is 0.2 % of a pile's points in 320 px of a perception image of 1280, 0.6 % in 160 px; an object elsewhere has more."""
SAME = 1e-4
"""Largest distance between an attempt's grasp point and that of the own grasp's trial [m]."""
_AROUND = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
"""Offsets (column, row) of a pixel and its neighbours (9, 2)."""
_PICKED = (Outcome.TARGET_PICKED, Outcome.OTHER_PICKED)


@dataclass(eq=False)
class PicksSubject:
    """Subject of the rules: an episode's tables of picks."""

    root: Path
    """The data set."""
    index: int
    """Index of the episode."""

    @property
    def place(self) -> str:
        """Path of the table of trials, relative to the data set."""
        return f"picks/{self.index:06d}.parquet"

    @cached_property
    def episode(self) -> Episode:
        """The episode."""
        return open_data_set(self.root)[self.index]

    @cached_property
    def picks(self) -> np.ndarray:
        """Table of trials."""
        return self.episode.picks

    def views(self) -> Iterator[tuple[np.void, np.ndarray, View]]:
        """Yield each state with its trials on labelled objects and its view; skips states without either, and views through a lens."""
        episode = self.episode
        if not {"bop", "shards"} & set(open_data_set(self.root).config.bake.formats):
            return
        for state in episode.pick_states:
            frame, camera = int(state["frame"]), int(state["camera"])
            if camera < len(episode.cameras) and frame in episode.frames(camera):
                view = episode.view(frame, camera)
                own = self.picks[(self.picks["state"] == state["state"]) & (self.picks["obj_id"] >= 0)]
                if len(own) and view.lens is None:
                    yield state, own, view

    def tell(self, wrong: np.ndarray, text: str, rows: np.ndarray | None = None) -> Findings:
        """Yield one violation that names the first of the `wrong` rows, a mask (row) bool, and counts them; `rows`: None: all trials."""
        if wrong.any():
            rows = self.picks if rows is None else rows
            first = rows[wrong][0]
            yield self.place, f"state {first['state']}, candidate {first['candidate']}, trial {first['repeat']}: {text}; {wrong.sum()} such"


@rule(PicksSubject, "picks-states", "bake the episode again: its two tables are not of the same run")
def check_states(subject: PicksSubject) -> Findings:
    """Each trial of picks starts from a state in the table of states, at its frame, which has the number of candidates that it states."""
    states, picks = subject.episode.pick_states, subject.picks
    place = {int(state): row for row, state in enumerate(states["state"])}
    row = np.array([place.get(int(state), -1) for state in picks["state"]], np.int64)
    yield from subject.tell(row < 0, "its state is not in the table of states")
    known = row >= 0
    yield from subject.tell(known & (states["frame"][row] != picks["frame"] if len(states) else False), "its frame is not its state's")
    for state in states:
        count = len(np.unique(picks["candidate"][picks["state"] == state["state"]]))
        if count != state["candidates"]:
            yield subject.place, f"state {state['state']} has trials of {count} candidates, but states {state['candidates']}"
        if not 0 <= state["frame"] < len(subject.episode):
            yield subject.place, f"state {state['state']} is of frame {state['frame']}; the episode has {len(subject.episode)} frames"


@rule(PicksSubject, "picks-geometry", "bake the episode again, or restore the table")
def check_geometry(subject: PicksSubject) -> Findings:
    """Normals and approaches of picks are unit vectors, scores lie between 0 and 1, weights are above 0."""
    picks = subject.picks
    for name in ("normal", "approach"):
        yield from subject.tell(~(np.abs(np.linalg.norm(picks[name], axis=1) - 1.0) <= UNIT), f"{name} is no unit vector")
    for name in ("seal", "wrench"):
        yield from subject.tell(~((picks[name] >= 0.0) & (picks[name] <= 1.0)), f"{name} is not between 0 and 1")
    yield from subject.tell((picks["share"] != Share.OWN) & ~(picks["weight"] > 0.0), "weight is not above 0")


@rule(PicksSubject, "picks-pixels", "bake the episode again: points, pixels or cameras are not of the same run")
def check_pixels(subject: PicksSubject) -> Findings:
    """Grasp points of picks project to their pixels in the perception image; the own grasp's may be smoothed."""
    for state, picks, view in subject.views():
        (width, height), size = view.size, np.array((int(state["width"]), int(state["height"])))
        place = view.project(picks["point"], view.world_to_camera)
        # Both images have the same horizontal field of view, and the same point in the middle.
        place = (place - (width / 2, height / 2)) * (size[0] / width) + size / 2
        off = np.abs(place - np.column_stack((picks["column"], picks["row"])) - 0.5).max(axis=1) - 0.5
        yield from subject.tell((picks["share"] != Share.OWN) & ~(off <= PIXEL), "its point does not project to its pixel", picks)


@rule(PicksSubject, "picks-surface", "bake the episode again: points and poses are not of the same run")
def check_surface(subject: PicksSubject) -> Findings:
    """Grasp points of picks lie on the visible surface of their instance: mask and depth show it there.

    In a view with wider pixels than the perception image, a point may lie between the depths around it, and UNSEEN of them anywhere.
    """
    for state, picks, view in subject.views():
        width, height = view.size
        allowed = UNSEEN if width < state["width"] else 0.0
        rotation, offset = view.world_to_camera[:3, :3], view.world_to_camera[:3, 3]
        point, normal = picks["point"] @ rotation.T + offset, picks["normal"] @ rotation.T
        pixel = np.floor(view.project(point)).astype(np.int64)[:, None] + _AROUND
        column, row = pixel[..., 0].clip(0, width - 1), pixel[..., 1].clip(0, height - 1)
        if view.has("depth"):
            rays = (np.stack((column, row), axis=-1) + 0.5 - view.intrinsics[:2, 2]) / view.intrinsics[[0, 1], [0, 1]]
            facing = np.einsum("nkc,nc->nk", np.concatenate((rays, np.ones_like(rays[..., :1])), axis=-1), normal)
            # The depth at a neighbouring pixel is that of the tangent plane; where that is nearly seen from the side, that of the point.
            plane = np.einsum("nc,nc->n", point, normal)[:, None] / np.where(np.abs(facing) < 0.05, np.nan, facing)
            behind = view.depth[row, column] - point[:, 2:]
            near = np.fmin(np.abs(view.depth[row, column] - plane), np.abs(behind)).min(axis=1)
            # Wider pixels miss thin parts: their centres lie before and behind such a point.
            between = (behind.min(axis=1) < 0.0) & (behind.max(axis=1) > 0.0)
            off = ~(near <= NEAR) & ~(between & (width < state["width"]))
            if off.sum() > allowed * len(off):
                yield from subject.tell(off, f"its point is more than {1e3 * NEAR:.0f} mm from the surface that depth shows", picks)
        if view.has("mask_visib"):
            shown = np.zeros(len(picks), bool)
            for instance, mask in zip(view.instance_ids.tolist(), view.masks, strict=True):
                shown |= (picks["instance"] == instance) & mask[row, column].any(axis=1)
            if (~shown).sum() > allowed * len(shown):
                yield from subject.tell(~shown, "its pixel does not show its instance", picks)
        known = dict(zip(view.instance_ids.tolist(), view.object_ids.tolist(), strict=True))
        wrong = np.array([known.get(instance) != obj_id for instance, obj_id in zip(picks["instance"], picks["obj_id"], strict=True)])
        yield from subject.tell(wrong, "its instance is not an object of that obj_id", picks)


@rule(PicksSubject, "picks-outcomes", "bake the episode again, or restore the table")
def check_outcomes(subject: PicksSubject) -> Findings:
    """Outcomes of picks agree with what was measured: who was held, how many rays hit, how far others moved, and whether all ended well."""
    picks = subject.picks
    outcome = picks["outcome"]
    held = np.isin(outcome, _PICKED)
    rules = {
        "success does not agree with its outcome": picks["success"] != held,
        "intended does not agree with its outcome": picks["intended"] & (outcome != Outcome.TARGET_PICKED),
        "it succeeded without a picked instance": held & (picks["picked"] < 0),
        "it succeeded, but nothing was held": held & ~(picks["held"] > 0.0),
        "it succeeded, but no ray hit": held & (picks["hits"] <= 0),
        "rays hit, but nothing was caught": (outcome == Outcome.NOTHING_CAUGHT) & (picks["hits"] > 0),
        "its seals broke, but when is not known": (outcome == Outcome.DROPPED) & (picks["held"] > 0.0) & np.isnan(picks["time_to_break"]),
        "it broke, but also succeeded": held & ~np.isnan(picks["time_to_break"]),
        "its margin is above 1": picks["margin"] > 1.0 + UNIT,
        "it has no outcome, but nothing ended it": (outcome == Outcome.NONE) & (picks["ending"] == Ending.RUNNING),
        "moved and farthest do not agree": (picks["moved"] > 0) != (picks["farthest"] > MOVED),
    }
    for text, wrong in rules.items():
        yield from subject.tell(wrong, text)


@rule(PicksSubject, "picks-own", "bake the episode again: attempts and picks are not of the same run")
def check_own(subject: PicksSubject) -> Findings:
    """The own grasp of a state of picks is that of the attempt that chose from its frame, with its outcome where it takes its path."""
    config = open_data_set(subject.root).config
    is_same = (config.picks.near, config.picks.hold, config.picks.lift_height) == (0.0, 0.0, config.pick.lift_height)
    attempts = {attempt["frame"]: attempt for attempt in subject.episode.attempts if attempt.get("point") is not None}
    own = subject.picks[(subject.picks["share"] == Share.OWN) & (subject.picks["repeat"] == 0)]
    for trial in own:
        attempt = attempts.get(int(trial["frame"]))
        where = f"state {trial['state']}, candidate {trial['candidate']}"
        if attempt is None:
            yield subject.place, f"{where}: no attempt chose from frame {trial['frame']}"
        elif attempt["target"] != trial["instance"] or np.abs(np.array(attempt["point"]) - trial["point"]).max() > SAME:
            yield subject.place, f"{where}: attempt {attempt['attempt']} chose another grasp"
        elif is_same and attempt["outcome"] != (outcome := Outcome(int(trial["outcome"])).name.lower()):
            yield subject.place, f"{where}: its outcome is {outcome}, that of attempt {attempt['attempt']} is {attempt['outcome']}"
