"""All accumulators of a part of a data set, which merge to those of the whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from synpick_warp.apps.statistics.annotations import AnnotationCounts
from synpick_warp.apps.statistics.attempts import EpisodeCounts
from synpick_warp.apps.statistics.bins import BinCounts
from synpick_warp.apps.statistics.counting import Group
from synpick_warp.apps.statistics.coverage import CoverageCounts
from synpick_warp.apps.statistics.depth import DepthCounts
from synpick_warp.apps.statistics.lights import LightCounts
from synpick_warp.apps.statistics.looks import LookCounts
from synpick_warp.apps.statistics.records import AttemptFacts, EpisodeFacts
from synpick_warp.apps.statistics.rest import RestCounts
from synpick_warp.apps.statistics.scenes import SceneTruth, read_scene
from synpick_warp.apps.statistics.timeline import TimelineCounts
from synpick_warp.dataset.annotations import check_content
from synpick_warp.dataset.commit.manifest import episode_entry
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import DatasetError

MAX_OBJECTS = 65_536
"""Maximum number of distinct objects; more are a sign of corrupt annotations."""


@dataclass
class Partial:
    """Accumulators of all statistics, over some episodes and scenes; partial counts of processes are added up."""

    annotations: AnnotationCounts = field(default_factory=AnnotationCounts)
    episodes: EpisodeCounts = field(default_factory=EpisodeCounts)
    timeline: TimelineCounts = field(default_factory=TimelineCounts)
    coverage: CoverageCounts = field(default_factory=CoverageCounts)
    depth: DepthCounts = field(default_factory=DepthCounts)
    lights: LightCounts = field(default_factory=LightCounts)
    looks: LookCounts = field(default_factory=LookCounts)
    bins: BinCounts = field(default_factory=BinCounts)
    rest: RestCounts = field(default_factory=RestCounts)

    def merge(self, other: Partial) -> None:
        """Add the counts of another part. The order of merges does not change the result.

        Raises:
            DatasetError: There are more than MAX_OBJECTS objects.
        """
        for item in fields(self):
            getattr(self, item.name).merge(getattr(other, item.name))
        if len(self.annotations.objects) > MAX_OBJECTS:
            raise DatasetError(f"the annotations have more than {MAX_OBJECTS:,} different obj_id; scene_gt.json is damaged")

    def add_episode(self, data_set: DataSet, episode: int) -> EpisodeFacts:
        """Count an episode, its attempts and its bin; returns its row.

        Raises:
            DatasetError: Its manifest entry is damaged.
        """
        known, source = data_set[episode], data_set.folder / f"{episode_entry(episode)}.json"
        row = check_content(known.row, EpisodeFacts, source)
        attempts = [check_content(attempt, AttemptFacts, source) for attempt in known.attempts]
        self.episodes.add_episode(group_of(data_set, episode, row), row, attempts, data_set.config.suction if attempts else None)
        self.looks.add_episode(row.looks)
        if row.bin is not None:
            self.bins.add_episode(row.bin)
        return row

    def add_scene(self, data_set: DataSet, episode: int, camera: int, depth_frames: Sequence[int] = ()) -> None:
        """Count a scene; of camera 0 also objects over time and light.

        Args:
            data_set: The data set.
            episode: Index of the episode.
            camera: Index of the camera.
            depth_frames: Frames of which the depth image is read.

        Raises:
            DatasetError: A file is missing or damaged.
        """
        known = data_set[episode]
        group = group_of(data_set, episode, check_content(known.row, EpisodeFacts, data_set.folder / episode_entry(episode)))
        scene = read_scene(data_set, episode, camera)
        self.annotations.add_scene(group, scene)
        self.coverage.add_scene(scene)
        if camera == 0:
            if data_set.period is not None:
                self.timeline.add_scene(group, scene, data_set.period)
            if scene.light is not None:
                self.lights.add_episode(scene.light)
        for frame in depth_frames:
            self._add_depth(scene, frame)

    def _add_depth(self, scene: SceneTruth, frame: int) -> None:
        """Accumulate the histogram of a depth image; scenes without depth images are skipped."""
        if not scene.files.has("depth") or np.isnan(scene.depth_scale[frame]):
            return
        image = scene.files.typed_image("depth", scene.images[frame], None, "uint16")
        self.depth.add_image(image, float(scene.depth_scale[frame]))


def group_of(data_set: DataSet, episode: int, row: EpisodeFacts) -> Group:
    """Split and mode of an episode."""
    return Group(data_set.split_of(episode), row.mode)
