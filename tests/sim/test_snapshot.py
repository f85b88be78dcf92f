"""What a snapshot says of the frame before it."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.kernels.sim import snapshot
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import LastFrame, Snapshot
from synpick_warp.stages.launch import launch
from synpick_warp.system.hardware.device import pick_device
from tests.harness.devices import default_device

WORLDS, ROOM, FIXTURES = 3, 2, 3
SIZES = {"world": WORLDS, "instance": ROOM, "fixture": FIXTURES}
KEPT = ("catalog_index", "pose", "fixture_pose", "fixture_visible")
TICK = st.lists(st.tuples(st.integers(0, 1), st.integers(0, 2), st.integers(-1, 3)), min_size=WORLDS, max_size=WORLDS)
"""live, episode and frame of each world."""


class Linked:
    """Snapshots one after the other, told by their number: tick t of world w puts t + 10 w into every array."""

    def __init__(self) -> None:
        self.device = pick_device(default_device())
        self.last = allocate(LastFrame, SIZES, self.device)
        self.count = 0

    def tick(self, worlds: list[tuple[int, int, int]]) -> Snapshot:
        self.count += 1
        made = allocate(Snapshot, SIZES, self.device)
        for column, name in enumerate(("live", "episode", "frame")):
            getattr(made, name).assign(np.array([row[column] for row in worlds]))
        for name in KEPT:
            values = getattr(made, name).numpy()
            values[:] = (self.count + 10 * np.arange(WORLDS)).reshape(WORLDS, *(1,) * (values.ndim - 1))
            getattr(made, name).assign(values)
        launch(snapshot.link_frames_kernel, WORLDS, made, self.last)
        return made


def follows(script: list[list[tuple[int, int, int]]]) -> list[list[int]]:
    linked = Linked()
    return [linked.tick(tick).follows.numpy().tolist() for tick in script]


def test_frames_follow_within_an_episode_and_never_across():
    world = [(0, 4, -1), (1, 4, 0), (1, 4, 1), (1, 4, 2), (0, 7, -1), (1, 7, 0), (1, 7, 1)]
    assert [tick[0] for tick in follows([[tick] * WORLDS for tick in world])] == [0, 0, 1, 1, 0, 0, 1]


def test_an_episode_that_is_drawn_again_begins_anew():
    # The last frame of the failed try is not live; then the same number comes again from frame 0.
    world = [(1, 4, 0), (1, 4, 1), (0, 4, 2), (0, 4, -1), (1, 4, 0), (1, 4, 1)]
    assert [tick[0] for tick in follows([[tick] * WORLDS for tick in world])] == [0, 1, 0, 0, 0, 1]


@given(st.lists(TICK, min_size=1, max_size=6))
@settings(max_examples=30)
def test_every_snapshot_has_the_one_before_beside_it(script):
    linked, before = Linked(), [(0, 0, 0)] * WORLDS
    for number, worlds in enumerate(script):
        made = linked.tick(worlds)
        expected = [
            int(live and was_live and episode == was_episode and frame == was_frame + 1)
            for (live, episode, frame), (was_live, was_episode, was_frame) in zip(worlds, before, strict=True)
        ]
        assert made.follows.numpy().tolist() == expected
        for name in KEPT:
            values = getattr(made, f"last_{name}").numpy().reshape(WORLDS, -1)
            told = number + 10 * np.arange(WORLDS) if number else np.zeros(WORLDS)
            np.testing.assert_array_equal(values, np.broadcast_to(told[:, None], values.shape))
        before = worlds
