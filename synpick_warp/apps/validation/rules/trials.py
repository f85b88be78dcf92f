"""Validation rules of simulated picks: tables against each other, geometry against views, outcomes against measurements."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from synpick_warp.apps.validation.registry import Findings, rule
from synpick_warp.codes import Ending, Outcome, Share
from synpick_warp.dataset.bop.layout import models_folder
from synpick_warp.dataset.reading import DataSet, Episode, open_data_set
from synpick_warp.dataset.view import View
from synpick_warp.errors import DatasetError
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.system.inputs.files import path_inside
from synpick_warp.views.picks import MOVED

MILLIMETRE = 1e-3
NEAR = 1e-3
"""Largest distance of a grasp point from the mesh of its instance [m]: poses and points are in single precision."""
UNSEEN = 0.05
"""Largest share of points that a view with wider pixels than the perception image may miss, as no pixel's centre shows them: thin parts
and edges. It is 0.2 % of a pile's points in 320 px of a perception image of 1280, 0.6 % in 160 px; an object elsewhere has more."""
_AROUND = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
"""Offsets (column, row) of a pixel and its neighbours (9, 2)."""
PIXEL = 0.01
"""Largest distance of a projected point from its pixel, beyond its sides [px of the perception image]."""
SAME = 1e-4
"""Largest distance between an attempt's grasp point and that of the own grasp's trial [m]."""
_PICKED = (Outcome.TARGET_PICKED, Outcome.OTHER_PICKED)


@dataclass(eq=False)
class PicksSubject:
    """Subject of the rules: an episode's tables of picks."""

    root: Path
    """The data set."""
    index: int
    _meshes: dict[int, np.ndarray] = field(default_factory=dict)

    @property
    def place(self) -> str:
        """Path of the table of trials, relative to the data set."""
        return f"picks/{self.index:06d}.parquet"

    @cached_property
    def data(self) -> DataSet:
        """The data set, which reads its settings once."""
        return open_data_set(self.root)

    @cached_property
    def episode(self) -> Episode:
        """The episode."""
        return self.data[self.index]

    @cached_property
    def picks(self) -> np.ndarray:
        """Table of trials."""
        return self.episode.picks

    def triangles(self, obj_id: int) -> np.ndarray:
        """Triangles of an object's model (F, 3, 3) [m]; raises DatasetError or CatalogError if it cannot be read."""
        if obj_id not in self._meshes:
            path = path_inside(self.root, f"{models_folder(self.root)}/obj_{obj_id:06d}.ply", self.root, DatasetError)
            mesh = read_mesh(path, MILLIMETRE)[0]
            self._meshes[obj_id] = mesh.vertices[mesh.faces].astype(np.float64)
        return self._meshes[obj_id]

    def views(self) -> Iterator[tuple[np.void, np.ndarray, View]]:
        """Yield each state with its trials on labelled objects and its view; skips states without either."""
        episode = self.episode
        if not {"bop", "shards"} & set(self.data.config.bake.formats):
            return
        for state, view in episode.state_views():
            own = self.picks[(self.picks["state"] == state["state"]) & (self.picks["obj_id"] >= 0)]
            if len(own):
                yield state, own, view

    def tell(self, wrong: np.ndarray, text: str, rows: np.ndarray | None = None) -> Findings:
        """Yield one violation that names the first of the `wrong` rows, a mask (row) bool, and counts them; `rows`: None: all trials."""
        if wrong.any():
            rows = self.picks if rows is None else rows
            first = rows[wrong][0]
            yield self.place, f"state {first['state']}, candidate {first['candidate']}, trial {first['repeat']}: {text}; {wrong.sum()} such"


@rule(PicksSubject, "picks-tables", "bake the episode again, or restore the table")
def check_tables(subject: PicksSubject) -> Findings:
    """Tables of picks have the types, ranges and codes of their columns; each trial starts from a state of its episode, at its frame."""
    try:
        subject.episode.picks  # noqa: B018
    except DatasetError as error:
        yield subject.place, str(error)


@rule(PicksSubject, "picks-pixels", "bake the episode again: points, pixels or cameras are not of the same run")
def check_pixels(subject: PicksSubject) -> Findings:
    """Grasp points of picks project to their pixels, where masks show their instance; the own grasp's pixel may be another."""
    for state, picks, view in subject.views():
        if view.has("mask_visib"):
            pixel = np.floor(view.project(picks["point"], view.world_to_camera)).astype(np.int64)[:, None] + _AROUND
            column, row = (pixel[..., axis].clip(0, view.size[axis] - 1) for axis in (0, 1))
            shown = np.zeros(len(picks), bool)
            for instance, mask in zip(view.instance_ids.tolist(), view.masks, strict=True):
                shown |= (picks["instance"] == instance) & mask[row, column].any(axis=1)
            if (~shown).sum() > (UNSEEN if view.size[0] < state["width"] else 0.0) * len(shown):
                yield from subject.tell(~shown, "its pixel does not show its instance", picks)
        if view.lens is not None:
            continue  # The perception image is that of a pinhole.
        (width, height), size = view.size, np.array((int(state["width"]), int(state["height"])))
        place = view.project(picks["point"], view.world_to_camera)
        # Both images have the same horizontal field of view, and the same point in the middle.
        place = (place - (width / 2, height / 2)) * (size[0] / width) + size / 2
        off = np.abs(place - np.column_stack((picks["column"], picks["row"])) - 0.5).max(axis=1) - 0.5
        yield from subject.tell((picks["share"] != Share.OWN) & ~(off <= PIXEL), "its point does not project to its pixel", picks)


@rule(PicksSubject, "picks-surface", "bake the episode again: points and poses are not of the same run")
def check_surface(subject: PicksSubject) -> Findings:
    """Grasp points of picks lie on the mesh of their instance, at its pose in that frame."""
    for _, picks, view in subject.views():
        row = {instance: index for index, instance in enumerate(view.instance_ids.tolist())}
        index = np.array([row.get(instance, -1) for instance in picks["instance"].tolist()])
        wrong = (index < 0) | (view.object_ids[index] != picks["obj_id"])
        yield from subject.tell(wrong, "its instance is not an object of that obj_id", picks)
        off = np.zeros(len(picks), bool)
        for one in np.unique(index[~wrong]):
            mine = np.flatnonzero((index == one) & ~wrong)
            triangles = subject.triangles(int(view.object_ids[one]))
            pose = view.object_to_world[one]
            local = (picks["point"][mine] - pose[:3, 3]) @ pose[:3, :3]
            off[mine] = [not is_on_surface(point, triangles) for point in local]
        yield from subject.tell(off, f"its point is more than {1e3 * NEAR:.0f} mm from the surface of its instance", picks)


def is_on_surface(point: np.ndarray, triangles: np.ndarray) -> bool:
    """Whether a point (3) is at most NEAR from one of the triangles (F, 3, 3), both [m]: exact distances to those whose boxes are."""
    from trimesh.triangles import closest_point

    near = triangles[((triangles.min(axis=1) - NEAR <= point) & (point <= triangles.max(axis=1) + NEAR)).all(axis=1)]
    found = closest_point(near, np.broadcast_to(point, (len(near), 3))) if len(near) else np.full((1, 3), np.inf)
    return bool(np.linalg.norm(found - point, axis=1).min() <= NEAR)


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
        "it has no outcome, but nothing ended it": (outcome == Outcome.NONE) & (picks["ending"] == Ending.RUNNING),
        "moved and farthest do not agree": (picks["moved"] > 0) != (picks["farthest"] > MOVED),
    }
    for text, wrong in rules.items():
        yield from subject.tell(wrong, text)


@rule(PicksSubject, "picks-own", "bake the episode again: attempts and picks are not of the same run")
def check_own(subject: PicksSubject) -> Findings:
    """The own grasp of a state of picks is that of the attempt that chose from its frame, with its outcome where it takes its path."""
    config = subject.data.config
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
