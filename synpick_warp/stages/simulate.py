"""All worlds, one tick at a time. Nothing here asks the device for an answer."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import warp as wp

from synpick_warp.arrays import allocate
from synpick_warp.configs.schema import Config
from synpick_warp.kernels import pack
from synpick_warp.scenes.build import build_model
from synpick_warp.scenes.shapes import Catalog
from synpick_warp.stages import act, arrange
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.constants import SceneData, make_scene_data
from synpick_warp.stages.physics import Physics
from synpick_warp.stages.worlds import WorldState, WorldStatus, world_sizes

# A tick is recorded while the last one's record is still read.
RECORDS = 2


@dataclass(frozen=True, eq=False)
class TickRecord:
    """What one tick leaves for pictures and for the host."""

    snapshot: Snapshot
    status: WorldStatus


class Simulation:
    """N worlds that take episodes by number until none is left."""

    def __init__(self, config: Config, catalog: Catalog, lights: int, device: wp.Device) -> None:
        """Build the model and allocate all state.

        Args:
            config: Settings.
            catalog: The objects.
            lights: How many light maps there are to draw from.
            device: Where everything lies.
        """
        self.config = config
        self.device = device
        built = build_model(config, catalog, device)
        self.layout = built.layout
        self.physics = Physics(config, built)
        self.scene: SceneData = make_scene_data(config, catalog, built, lights, device)
        sizes = world_sizes(config, built.layout.bodies_per_world)
        self.state = allocate(WorldState, sizes, device)
        self.records = tuple(self._make_record(sizes) for _ in range(RECORDS))

    def _make_record(self, sizes: dict[str, int]) -> TickRecord:
        record = TickRecord(allocate(Snapshot, sizes, self.device), allocate(WorldStatus, sizes, self.device))
        record.snapshot.fixture_visible.fill_(1)
        return record

    def tick(self, record: TickRecord) -> None:
        """Hand out episodes, simulate one tick, judge, and record what came of it in one of `records`."""
        state, scene, physics, seed = self.state, self.scene, self.physics, self.config.bake.seed
        arrange.take_episodes(state, self.config.bake.episodes, self.config.settle.tries)
        arrange.draw_objects(scene, state, seed)
        arrange.drop_objects(scene, state, physics, seed)
        arrange.set_guides(scene, state, physics)
        physics.tick(functools.partial(act.drive_gripper, scene, state, physics))
        arrange.judge_settling(scene, state, physics, seed)
        arrange.set_guides(scene, state, physics)
        act.begin_moving(scene, state, physics, seed)
        physics.refresh_poses()
        arrange.judge_episodes(scene, state, physics)
        self._take_snapshot(record)

    def _take_snapshot(self, record: TickRecord) -> None:
        state, snapshot = self.state, record.snapshot
        wp.launch(
            pack.take_snapshot_kernel,
            dim=self.layout.worlds,
            inputs=[self.scene.layout, state.phase, state.ending, state.address, state.frame, state.entry, state.slot,
                    self.physics.state.body_q],
            outputs=[snapshot.live, snapshot.episode, snapshot.frame, snapshot.entry, snapshot.pose, snapshot.fixture_pose,
                     record.status.table],
            device=self.device,
        )
        wp.copy(snapshot.light, state.light)
        wp.copy(snapshot.light_turn, state.light_turn)
