"""Support recorded by tick: who lies on whom, against statics."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Phase
from synpick_warp.scenes import build
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import read_tick
from tests.worlds.small_worlds import CUBE, catalog, settings

BAR = ((0.2, 0.05, 0.02),)
GRAVITY = 9.81
LEANING = [float(value) for value in Rotation.from_euler("y", -20, degrees=True).as_quat()]
UPRIGHT = [0.0, 0.0, 0.0, 1.0]
SCENES = {
    "stack": {0: (0.0, 0.0, 0.025), 1: (0.01, 0.0, 0.075), 2: (0.0, 0.1, 0.01)},
    "bridge": {0: (-0.06, 0.0, 0.025), 1: (0.06, 0.0, 0.025), 2: (0.0, 0.0, 0.06)},
    "leaning": {0: (0.08, 0.0, 0.025), 1: (-0.1, 0.1, 0.025), 2: (0.0, 0.0, 0.046)},
}
"""Position [m] of a cube, another, and a bar; the last leans on the first cube's edge."""


@pytest.fixture(scope="module")
def rested(device) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Support (object, supporter) [N] in each scene, at rest, and weights of the objects [N]; the last supporter is the bin."""
    objects = catalog(CUBE, CUBE, BAR)
    given = {"arrangement__max_objects": 3, "arrangement__volume": 1e-3, "settle__min_time": 3.0, "move__repeats": False}
    simulation = Simulation(settings(bake__worlds=3, bake__episodes=3, bop__graph=True, **given), objects, 1, device)
    simulation.tick()
    physics, layout = simulation.physics, simulation.layout
    chosen, slot = simulation.state.catalog_index.numpy(), simulation.state.body_slot.numpy()
    places, speeds = (array.numpy() for array in (physics.state.joint_q, physics.state.joint_qd))
    for world, scene in enumerate(SCENES.values()):
        for instance, which in enumerate(chosen[world]):
            turn = LEANING if scene is SCENES["leaning"] and which == 2 else UPRIGHT
            first = world * layout.coords_per_world + build.GRIPPER_DOFS + 7 * slot[world, instance]
            places[first : first + 7] = [*scene[which], *turn]
    speeds[:] = 0.0
    physics.state.joint_q.assign(places)
    physics.state.joint_qd.assign(speeds)
    physics.refresh_poses()
    for _ in range(12):
        simulation.tick()
    report = read_tick(simulation.record)
    assert (report.column("phase") == Phase.SETTLE).all()
    assert report.steps == {}
    assert report.tick["support"].shape == (3, 3, 3)
    result = {}
    for world, name in enumerate(SCENES):
        order = np.argsort(chosen[world])
        result[name] = np.column_stack([report.tick["support"][world][np.ix_(order, order)], report.tick["static_support"][world][order]])
    return result, GRAVITY * np.array([entry.mass for entry in objects.entries])


@pytest.mark.parametrize("name", SCENES)
def test_what_rests_is_carried_by_its_weight(rested, name):
    """Upward forces on each object, less those with which it carries others, sum to m g; those of a pair are opposite."""
    support, weights = rested[0][name], rested[1]
    np.testing.assert_allclose(support.sum(axis=1), weights, rtol=0.02)
    np.testing.assert_array_equal(support[:, :3], -support[:, :3].T)


def test_supporters_are_what_lies_below(rested):
    support, weights = rested
    cube, _, bar = weights
    np.testing.assert_allclose(support["stack"], [[0, -cube, 0, 2 * cube], [cube, 0, 0, 0], [0, 0, 0, bar]], atol=0.02 * cube)
    np.testing.assert_allclose(
        support["bridge"], [[0, 0, -bar / 2, cube + bar / 2], [0, 0, -bar / 2, cube + bar / 2], [bar / 2, bar / 2, 0, 0]], atol=0.05 * bar
    )
    leaning = support["leaning"]
    assert 0.2 * bar < leaning[2, 0] < 0.8 * bar
    assert leaning[2, 0] + leaning[2, 3] == pytest.approx(bar, rel=0.02)
    assert leaning[1].tolist()[:3] == [0.0, 0.0, 0.0]
