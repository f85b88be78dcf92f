"""Grasp candidates: shares, strata, weights, uniform pixels, grasps on surfaces, and independence of the world."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from scipy.stats import chisquare

from synpick_warp.codes import Share
from synpick_warp.configs.episodes.manipulation import Picks
from synpick_warp.kernels.perception.candidates import POOL
from synpick_warp.kernels.render.images.camera_effects import SensorParameters
from synpick_warp.kernels.state import Frames
from synpick_warp.stages.buffers import LayerBuffers
from synpick_warp.stages.perception.candidates import CandidateSampler
from synpick_warp.stages.render.layers import LayerRenderer
from synpick_warp.stages.render.view_setup import make_shot
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.sim.trials import find_choices, own_grasps
from synpick_warp.views.layers import LAYER_TABLE
from tests.worlds.sights import brief

COUNT, UNIFORM = 401, 100
"""Number of candidates of a state, and of those drawn uniformly."""


def worlds(device, count: int, **changed) -> Simulation:
    return brief(device, count, bake__mode="pick", arrangement__max_objects=2, perception__normal_window=0, **changed)


class Sampled:
    """Candidates of two rows with the same state, and their sampler. Attributes: fields of `Grasps` and `Candidates`, of the first row."""

    def __init__(self, simulation: Simulation, state, rows: tuple[int, ...]) -> None:
        simulation.tick()
        self.sampler = CandidateSampler(simulation, Picks(candidates=COUNT, uniform=UNIFORM / (COUNT - 1)))
        grasps, candidates, self.visible = self.sampler.sample(state, rows)
        self.arrays = {name: getattr(part, name).numpy() for part in (grasps, candidates) for name in part._cls.vars}

    def __getattr__(self, name: str) -> np.ndarray:
        return self.arrays[name][:COUNT]


@pytest.fixture(scope="module")
def choice(device):
    """State of a world at a moment of choice, in two rows; planned grasp, its pixel, catalog index and pose of instances, catalog."""
    simulation = worlds(device, 2)
    while not len(find_choices(simulation)):
        simulation.tick()
    world = find_choices(simulation)[0]
    state = simulation.states.allocate(2)
    simulation.states.save(state, wp.array([world, world], dtype=wp.int32, device=simulation.device))
    own = own_grasps(simulation, [world])
    pixel = simulation.observation.grasp_pixel.numpy()[world, own["target"][0]]
    objects = [array.numpy()[world] for array in (simulation.record.snapshot.catalog_index, simulation.record.snapshot.pose)]
    return state, own, pixel, objects, simulation.catalog


@pytest.fixture(scope="module")
def sampled(device, choice):
    return Sampled(worlds(device, 3), choice[0], (0, 1))


def test_shares_have_their_counts(sampled):
    assert [int((sampled.share == share).sum()) for share in Share] == [1, COUNT - 1 - UNIFORM, UNIFORM]
    assert sampled.visible.all()
    np.testing.assert_array_equal(sampled.arrays["row"], np.repeat([0, 1], COUNT))
    np.testing.assert_array_equal(sampled.candidate, np.arange(COUNT))


def test_the_first_candidate_is_the_own_grasp(sampled, choice):
    _, own, pixel, *_ = choice
    for name in ("target", "point", "normal", "yaw", "tilt"):
        np.testing.assert_array_equal(getattr(sampled, name)[0], own[name][0], err_msg=name)
    np.testing.assert_array_equal(sampled.pixel[0], pixel)
    same = np.flatnonzero((sampled.pixel == pixel).all(axis=1))
    np.testing.assert_array_equal(sampled.point[same], np.broadcast_to(own["point"], (len(same), 3)))


def test_candidates_depend_on_the_state_alone(sampled, choice, device):
    """Neither on its row nor on the number of worlds or of views in a batch."""
    other = Sampled(worlds(device, 2, perception__views=1), choice[0], (1, 0))
    for name, values in sampled.arrays.items():
        if name != "row":
            np.testing.assert_array_equal(values, other.arrays[name], err_msg=name)
            np.testing.assert_array_equal(values[:COUNT], values[COUNT:], err_msg=name)


@pytest.mark.parametrize("height", [None, -5.0], ids=["empty tote", "out of view"])
def test_a_state_that_shows_nothing_has_no_candidates(choice, device, height):
    """The other row is that of a state that shows its objects, in the same batch."""
    simulation = worlds(device, 2)
    simulation.tick()
    arrays = simulation.states.to_host(choice[0])
    if height is None:
        arrays["snapshot.catalog_index"][0] = -1
    else:
        arrays["snapshot.pose"][0, :, 2] = height
    sampled = Sampled(simulation, simulation.states.from_host(arrays), (0, 1))
    assert sampled.visible.tolist() == [[False] * 2, [True] * 2]
    for name in ("target", "entry", "pixel", "weight"):
        assert not getattr(sampled, name).any()
    assert sampled.arrays["weight"][COUNT + 1 :].all()


def test_drawn_pixels_are_uniform_over_what_is_visible(sampled):
    component = sampled.sampler.images.arrays.component.numpy()[0]
    rank = np.cumsum(component.ravel() >= 0) - 1
    drawn = sampled.sampler._pool.pixel.numpy()[0, :POOL]
    place = rank[drawn[:, 1] * component.shape[1] + drawn[:, 0]]
    pixels = int((component >= 0).sum())
    assert (component[drawn[:, 1], drawn[:, 0]] >= 0).all()
    assert sampled.sampler._pool.pixels.numpy()[0] == pixels
    edges = np.linspace(0, pixels, 17).astype(int)
    counts, _ = np.histogram(place, edges)
    assert chisquare(counts, np.diff(edges) * POOL / pixels).pvalue > 1e-3


def test_strata_take_turns_and_weights_undo_them(sampled):
    """Instances have equal numbers of candidates, as have the strata of each; weighted means estimate pixel counts of the image."""
    drawn = sampled.share == Share.STRATIFIED
    counts = np.bincount(sampled.target[drawn])
    assert np.ptp(counts) <= 1
    strata = np.minimum((sampled.seal * sampled.wrench * 5).astype(int), 4)
    for instance in range(2):
        sizes = np.unique(strata[drawn & (sampled.target == instance)], return_counts=True)[1]
        assert len(sizes) > 1
        assert np.ptp(sizes) <= 1
    component = sampled.sampler.images.arrays.component.numpy()[0]
    for instance in range(2):
        estimate = (sampled.weight * (sampled.target == instance))[drawn].mean()
        assert estimate == pytest.approx((component == instance).sum(), rel=0.1)
    assert (sampled.weight[sampled.share == Share.UNIFORM] == (component >= 0).sum()).all()
    assert sampled.weight[0] == 0


def test_a_pixel_of_a_face_gives_its_normal_and_a_point_on_it(sampled, choice):
    (index, pose), objects = choice[3:]
    for instance in range(2):
        mine = sampled.target == instance
        rotation = Rotation.from_quat(pose[instance, 3:])
        np.testing.assert_array_equal(sampled.entry[mine], index[instance])
        normal = rotation.inv().apply(sampled.surface_normal[mine])
        face = np.abs(normal).argmax(axis=1)
        np.testing.assert_allclose(np.abs(normal).max(axis=1), 1.0, atol=1e-4)
        point = rotation.inv().apply(sampled.point[mine] - pose[instance, :3])
        sides = objects.entries[index[instance]].mesh.vertices.max(axis=0) * 2
        np.testing.assert_allclose(np.abs(point)[np.arange(len(face)), face], sides[face] / 2, atol=2e-4)
        np.testing.assert_allclose(np.linalg.norm(sampled.surface_normal[mine], axis=1), 1.0, atol=1e-5)


def test_scores_are_those_of_the_layers(sampled):
    images, simulation = sampled.sampler.images, sampled.sampler.simulation
    names = ("suction_seal", "suction_wrench")
    shape = images.gbuffer.depth.shape
    buffers = {name: wp.zeros(shape, dtype=wp.float32, device=images.scene.device) if name in names else None for name in LAYER_TABLE}
    out = LayerBuffers(**buffers)
    layers = LayerRenderer(names, SensorParameters(), images.scene, images.views.instances, images.views.count)
    shot = make_shot(images.scene, Frames(), images.bodies, images.gbuffer, images.views)
    layers.render(simulation.record.snapshot, shot, out, images.views.cameras)
    column, row = sampled.pixel.T
    np.testing.assert_array_equal(sampled.seal, out.suction_seal.numpy()[0, row, column])
    np.testing.assert_array_equal(sampled.wrench, out.suction_wrench.numpy()[0, row, column])
    assert 0.0 < sampled.seal.mean() < 1.0
    assert math.isfinite(sampled.wrench.sum())
