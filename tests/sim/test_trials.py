"""Grasp trials: moments of choice, outcomes as of attempts, labels that do not depend on worlds, and grasps that are refused; grasp
candidates: shares, strata, weights, uniform pixels, grasps on surfaces, and independence of the world."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation
from scipy.stats import chisquare

from synpick_warp.codes import Outcome, Phase, Share, Task
from synpick_warp.configs.episodes.manipulation import Picks
from synpick_warp.errors import StateError
from synpick_warp.kernels.perception.candidates import POOL
from synpick_warp.kernels.render.images.camera_effects import SensorParameters
from synpick_warp.kernels.sim.trials import list_choices_kernel
from synpick_warp.kernels.state import Attempts, Frames, Worlds
from synpick_warp.kernels.structs import CatalogData
from synpick_warp.stages.buffers import LayerBuffers
from synpick_warp.stages.launch import launch
from synpick_warp.stages.perception.candidates import CandidateSampler
from synpick_warp.stages.render.layers import LayerRenderer
from synpick_warp.stages.render.view_setup import make_shot
from synpick_warp.stages.sim.physics import MIN_GPU_WORLDS
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.sim.trials import ChoiceReader, Trials, check_grasps, trial_values
from synpick_warp.views.layers import LAYER_TABLE
from tests.worlds.hanging import Hanging
from tests.worlds.kernel_worlds import filled
from tests.worlds.small_worlds import brief, find_choices, own_grasps, picking, report

ABOVE = 0.25
"""Height of a grasp in the air above the pile [m]."""


def worlds(device, count: int) -> Simulation:
    return brief(device, count, bake__mode="pick", arrangement__max_objects=2)


WHOLE = Picks(near=0.0, hold=0.0)
"""Trials with approach and lift of an attempt."""


def ticked(simulation: Simulation) -> Simulation:
    simulation.tick()
    return simulation


class Choice:
    """A world at a moment of choice: its state, planned grasp, and the outcome of the attempt."""

    def __init__(self, simulation: Simulation) -> None:
        while not len(find_choices(simulation)):
            simulation.tick()
        (self.world,) = find_choices(simulation)[:1]
        self.state, self.grasps = simulation.get_state([self.world]), own_grasps(simulation, [self.world])
        self.peak, self.ticks, row = 0.0, 0, None
        while row is None or not row.column("outcome")[self.world]:
            simulation.tick()
            row, self.ticks = report(simulation.record), self.ticks + 1
            self.peak = max(self.peak, row.measure("peak_force")[self.world])
        self.outcome, self.hits = row.column("outcome")[self.world], row.column("hits")[self.world]

    def repeated(self, count: int, **changed: np.ndarray) -> dict[str, np.ndarray]:
        """The planned grasp `count` times, with some arrays replaced."""
        return {name: np.repeat(values, count, axis=0) for name, values in self.grasps.items()} | changed


@pytest.fixture(scope="module")
def choice(device):
    return Choice(worlds(device, 3))


@pytest.fixture(scope="module")
def labels(choice, device):
    """Labels of seven trials, by number of worlds: the planned grasp, but in the air in trials 1 and 4, and turned in trial 2."""
    grasps = choice.repeated(7)
    grasps["point"][[1, 4], 2] += ABOVE
    grasps["yaw"][2] += 0.5
    found = {}
    for count in (3, 2):
        trials = Trials(ticked(worlds(device, count)), WHOLE)
        found[count] = trials.run(choice.state, trials.upload(grasps, 1))
    return found


def test_the_own_grasp_has_the_outcome_of_the_own_attempt(choice, labels):
    own = {name: values[0] for name, values in labels[3].items()}
    assert Outcome(choice.outcome) is Outcome.TARGET_PICKED
    assert own["outcome"] == choice.outcome
    assert own["hits"][0] == choice.hits
    assert own["picked"] == choice.grasps["target"][0]
    assert own["peak_force"] == np.float32(choice.peak)
    assert own["load"] == pytest.approx(choice.peak / 40.0, rel=1e-5)
    assert own["ticks"] == choice.ticks
    assert 0 < own["held"] < own["ticks"] * 16


def test_the_same_trial_has_the_same_labels_in_any_number_of_worlds(labels):
    for name, values in labels[3].items():
        assert len({values[trial].tobytes() for trial in (0, 3, 5, 6)}) == 1, name
        assert values[1].tobytes() == values[4].tobytes(), name
        np.testing.assert_array_equal(values, labels[2][name], err_msg=name)


def test_repeats_are_perturbed_alike_in_any_world(choice, device):
    """With start near the grasp and a short lift: repeat 0 is not perturbed, and is held for lift plus hold."""
    settings = Picks(near=0.02, lift_height=0.05, hold=0.1, repeats=3, angle=5.0)
    grasps, found = choice.repeated(2, candidate=np.arange(2)), {}
    for count in (3, 2):
        ordinary = worlds(device, count)
        config = ordinary.config.with_values(trial_values(settings, ordinary.layout.worlds))
        simulation = ticked(picking(config, ordinary.catalog, device, episodes=[]))
        trials = Trials(simulation, settings)
        found[count] = trials.run(choice.state, trials.upload(grasps, 1))
    mu = simulation.physics.model.shape_material_mu.numpy().reshape(simulation.layout.worlds, -1)
    assert all(len(set(row)) == 1 for row in mu)
    labels = found[3]
    for name, values in labels.items():
        np.testing.assert_array_equal(values, found[2][name], err_msg=name)
        assert values[0].tobytes() == values[3].tobytes(), name
    for name, centre, width in (("offset", 0.0, 1e-3), ("rotation", 0.0, np.radians(5.0)), ("friction", 1.0, 0.2)):
        drawn = labels[name][[1, 2, 4, 5]]
        assert len(np.unique(drawn)) == drawn.size
        assert (labels[name][::3] == centre).all()
        assert (np.abs(drawn - centre) <= width).all()
        assert np.ptp(drawn) > 0.2 * width
    assert Outcome(labels["outcome"][0]) is Outcome.TARGET_PICKED
    assert labels["held"][0] * 4e-3 == pytest.approx(0.05 / 0.6 + 0.1, abs=16 * 4e-3)


FOUR_CUPS = {
    "gripper__kind": "suction_array",
    "gripper__cups": [[0.012, 0.012], [-0.012, 0.012], [-0.012, -0.012], [0.012, -0.012]],
    "gripper__cup_width": 0.02,
    "suction__radius": 0.008,
}


def test_four_cups_are_tried_alike_in_any_world_and_others_are_measured_later(device):
    """Candidates, perturbed, with and without `picks.settle`, which changes only what is measured of the other object: it is in the air."""
    first = brief(device, 2, bake__mode="pick", arrangement__max_objects=2, **FOUR_CUPS)
    while not len(find_choices(first)):
        first.tick()
    (world,) = find_choices(first)[:1].tolist()
    arrays = first.states.to_host(first.get_state([world]))
    other = 1 - own_grasps(first, [world])["target"][0]
    upward = first.scene.layout.gripper_dofs + 6 * arrays["worlds.body_slot"][0, other] + 2
    arrays["physics.joint_qd"][0, upward] = 3.0
    state = first.states.from_host(arrays)
    settings, found = Picks(near=0.02, lift_height=0.05, hold=0.0, repeats=2, candidates=4), {}
    for count, settle in ((3, 0.0), (2, 0.0), (2, 0.3)):
        config = first.config.with_values(trial_values(settings, max(count, MIN_GPU_WORLDS) if first.device.is_cuda else count))
        simulation = ticked(picking(config, first.catalog, device, episodes=[]))
        grasps, candidates, _ = CandidateSampler(simulation, settings).sample(state, [0])
        found[count, settle] = Trials(simulation, replace(settings, settle=settle)).run(state, grasps)
        found[count, settle] |= {name: getattr(candidates, name).numpy() for name in ("pixel", "weight", "seal")}
    labels, later = found[2, 0.0], found[2, 0.3]
    for name, values in labels.items():
        np.testing.assert_array_equal(values, found[3, 0.0][name], err_msg=name)
        if name not in ("moved", "farthest", "lost"):
            np.testing.assert_array_equal(values, later[name], err_msg=name)
    assert labels["farthest"][0] > 0.3 > 0.1 > later["farthest"][0]
    assert Outcome(labels["outcome"][0]) is Outcome.TARGET_PICKED
    assert labels["hits"][:, 0].max() > 10
    assert bin(labels["hits"][0, 1]).count("1") >= 3


def test_the_load_of_a_cup_that_holds_two_objects_is_that_of_one_seal(device):
    """Not of the sum: each seal has the break force."""
    hanging, cube = Hanging(device, [[0.5, 1.0]], [[(0.05, 0.05, 0.05)] * 2]), 0.025
    hanging.start(np.array([[[-cube, 0.0, -cube], [cube, 0.0, -cube]]]))
    forces = hanging.run(100)
    assert hanging.seals.peak.numpy()[0, 1] == np.float32(forces.max()) / np.float32(40.0)
    assert forces[-1].sum() > 1.2 * forces.max()


def test_a_grasp_in_the_air_catches_nothing(labels):
    assert Outcome(labels[3]["outcome"][1]) is Outcome.NOTHING_CAUGHT
    assert labels[3]["hits"][1].tolist() == [0, 0]
    assert (labels[3]["picked"][1], labels[3]["held"][1], labels[3]["moved"][1], labels[3]["lost"][1]) == (-1, 0, 0, 0)
    assert labels[3]["peak_force"][1] == 0.0
    assert labels[3]["farthest"][1] < 5e-3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"yaw": None}, "grasps lack yaw"),
        ({"point": np.zeros((2, 2))}, r"point of 2 grasps has the shape \(2, 2\), not \(2, 3\)"),
        ({"tilt": np.array([0.0, np.nan])}, "tilt of grasp 1 is not finite"),
        ({"row": np.array([0, 3])}, "row is 3; allowed: 0 to 0"),
        ({"target": np.array([-2, 0])}, "target is -2; allowed: -1 to 1"),
    ],
)
def test_bad_grasps_are_refused(choice, changes, message):
    grasps = {name: values for name, values in (choice.repeated(2) | changes).items() if values is not None}
    with pytest.raises(StateError, match=message):
        check_grasps(grasps, 1, 2)


# ---- moments of choice: device and host agree on them, also after a first look without a target ----

STATES, ROWS, OBJECTS = 2, 8, 6
"""Saved states of an episode, rows of the ring buffer, and labelled objects: the stride is 3."""


def list_choices(device, attempts: list[int], has_target: list[bool]) -> list[tuple[int, int]]:
    """(row, attempt) of the states that the kernel lists, of attempts of one world."""
    catalog = CatalogData()
    catalog.count = OBJECTS
    stride, following = (wp.zeros(1, dtype=int, device=device) for _ in range(2))
    world, found = wp.zeros(ROWS, dtype=int, device=device), []
    for attempt, sees in zip(attempts, has_target, strict=True):
        values = {"phase": Phase.ACT, "task": Task.APPROACH if sees else Task.LOOK, "steps": 0, "attempt": attempt}
        arrays = {name: wp.array([int(value)], dtype=int, device=device) for name, value in values.items()}
        index = wp.array(np.arange(OBJECTS)[None], dtype=int, device=device)
        state = filled(Worlds(), {"phase": arrays.pop("phase"), "catalog_index": index})
        given = {"catalog": catalog, "states": STATES, "state": state, "attempts": filled(Attempts(), arrays)}
        launch(list_choices_kernel, 1, **given, stride=stride, next=following, world=world)
        found += [(int(row), attempt) for row in np.flatnonzero(world.numpy() == 0)]
    return found


def read_choices(attempts: list[int], has_target: list[bool]) -> list[tuple[int, int]]:
    """(row, attempt) of the states that the host reads from reports of the same ticks."""
    layout = SimpleNamespace(worlds=1)
    reader = ChoiceReader(SimpleNamespace(states=STATES, rows=ROWS, simulation=SimpleNamespace(layout=layout)), OBJECTS)
    found = []
    for attempt, sees in zip(attempts, has_target, strict=True):
        columns = {"phase": Phase.ACT, "task": Task.LOOK, "attempt": attempt - 1}
        report = SimpleNamespace(
            column=lambda name, columns=columns: np.array([int(columns.get(name, 0))]),
            plan=SimpleNamespace(target=np.array([0 if sees else -1])),
            catalog_index=np.arange(OBJECTS)[None],
        )
        found += [(choice.row, attempt) for choice in reader.read(report)]
    return found


@pytest.mark.parametrize(("has_target", "expected"), [([True] * 7, [(0, 0), (1, 3)]), ([False] + [True] * 6, [(0, 3)])])
def test_every_third_attempt_is_a_moment_of_choice(device, has_target, expected):
    attempts = list(range(7))
    assert list_choices(device, attempts, has_target) == expected
    assert read_choices(attempts, has_target) == expected


# ---- candidates ----

COUNT, UNIFORM = 401, 100
"""Number of candidates of a state, and of those drawn uniformly."""


def sighted(device, count: int, **changed) -> Simulation:
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
def moment(device):
    """State of a world at a moment of choice, in two rows; planned grasp, its pixel, catalog index and pose of instances, catalog."""
    simulation = sighted(device, 2)
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
def sampled(device, moment):
    return Sampled(sighted(device, 3), moment[0], (0, 1))


def test_shares_have_their_counts(sampled):
    assert [int((sampled.share == share).sum()) for share in Share] == [1, COUNT - 1 - UNIFORM, UNIFORM]
    assert sampled.visible.all()
    np.testing.assert_array_equal(sampled.arrays["row"], np.repeat([0, 1], COUNT))
    np.testing.assert_array_equal(sampled.candidate, np.arange(COUNT))


def test_the_first_candidate_is_the_own_grasp(sampled, moment):
    _, own, pixel, *_ = moment
    for name in ("target", "point", "normal", "yaw", "tilt"):
        np.testing.assert_array_equal(getattr(sampled, name)[0], own[name][0], err_msg=name)
    np.testing.assert_array_equal(sampled.pixel[0], pixel)
    same = np.flatnonzero((sampled.pixel == pixel).all(axis=1))
    np.testing.assert_array_equal(sampled.point[same], np.broadcast_to(own["point"], (len(same), 3)))


def test_candidates_depend_on_the_state_alone(sampled, moment, device):
    """Neither on its row nor on the number of worlds or of views in a batch."""
    other = Sampled(sighted(device, 2, perception__views=1), moment[0], (1, 0))
    for name, values in sampled.arrays.items():
        if name != "row":
            np.testing.assert_array_equal(values, other.arrays[name], err_msg=name)
            np.testing.assert_array_equal(values[:COUNT], values[COUNT:], err_msg=name)


@pytest.mark.parametrize("height", [None, -5.0], ids=["empty tote", "out of view"])
def test_a_state_that_shows_nothing_has_no_candidates(moment, device, height):
    """The other row is that of a state that shows its objects, in the same batch."""
    simulation = sighted(device, 2)
    simulation.tick()
    arrays = simulation.states.to_host(moment[0])
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


def test_a_pixel_of_a_face_gives_its_normal_and_a_point_on_it(sampled, moment):
    (index, pose), objects = moment[3:]
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
