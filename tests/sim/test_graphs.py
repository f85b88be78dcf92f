"""CUDA graphs of the physics: ticks that replay them are the same, bit by bit, as ticks whose kernels are launched one by one."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from synpick_warp.scenes import build
from synpick_warp.stages.sim.physics import Physics
from tests.worlds.small_worlds import CUBE, catalog, settings

WORLDS, TICKS, HOVER = 8, 5, 1.0


def fall(device: wp.Device, replays: bool, steps: int, substeps: int) -> list[np.ndarray]:
    """Joint coordinates after each tick of cubes that fall beside the gripper onto the floor, a different one in each world."""
    config = settings(
        bake__worlds=WORLDS,
        arrangement__max_objects=1,
        physics__steps_per_tick=steps,
        physics__substeps=substeps,
        physics__guide_height=0.2,
        physics__deterministic=True,
    )
    built = build.build_model(config, catalog(CUBE), device)
    physics, first = Physics(config.physics, built), build.GRIPPER_DOFS
    coordinates = physics.state.joint_q.numpy().reshape(WORLDS, -1)
    coordinates[:, 2] = HOVER
    turn = np.array([0.3, 0.2, -0.1, 0.927])
    coordinates[:, first : first + 7] = (0.1, -0.05, 0.06, *turn / np.linalg.norm(turn))
    coordinates[:, first] += np.linspace(0.0, 0.01, WORLDS)
    physics.state.joint_q.assign(coordinates.reshape(-1))
    variant = np.full((WORLDS, built.layout.bodies_per_world), -1, np.int32)
    variant[:, build.GRIPPER_BODIES] = built.variant[0]
    restarted = wp.array(np.ones(WORLDS + 1, bool), dtype=bool, device=device)
    physics.load(wp.array(variant.reshape(-1), dtype=wp.int32, device=device), restarted)
    found = []
    for _ in range(TICKS):
        if not replays:
            physics.clear_graphs()
            physics._period = lambda watcher: steps * substeps  # type: ignore[method-assign]
        physics.tick(lambda current: None)
        found.append(physics.state.joint_q.numpy().copy())
    return found


@pytest.mark.parametrize(("steps", "substeps"), [(12, 1), (12, 2), (12, 3), (9, 1)])
def test_replayed_ticks_are_those_of_single_launches(device, steps, substeps):
    if not device.is_cuda:
        pytest.skip("the CPU has no graphs")
    replayed, launched = fall(device, True, steps, substeps), fall(device, False, steps, substeps)
    np.testing.assert_array_equal(replayed, launched)
    heights = np.array(launched).reshape(TICKS, WORLDS, -1)[:, :, build.GRIPPER_DOFS + 2]
    assert (np.diff(heights[:2], axis=0) < 0.0).all()
    assert heights[-1].min() > 0.02
