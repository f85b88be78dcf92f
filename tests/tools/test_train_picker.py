"""The picker on drawn boxes whose tops are flat in the middle alone; skipped without PyTorch."""

from __future__ import annotations

import numpy as np
import pytest

from synpick_warp.codes import Outcome
from synpick_warp.configs.files.load import load_config
from synpick_warp.environment.make import make_picking
from tests.builders import PICKING, boxes
from tests.worlds.small_worlds import QUICK

torch = pytest.importorskip("torch", exc_type=ImportError)
train_picker = pytest.importorskip("tools.examples.train_picker", exc_type=ImportError)
data = pytest.importorskip("tools.examples.picking_data", exc_type=ImportError)
network = pytest.importorskip("tools.examples.picking_network", exc_type=ImportError)
scores = pytest.importorskip("tools.examples.picking_scores", exc_type=ImportError)

SIZE = (32, 56)
CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def one_thread():
    """Small images: threads cost more than they save."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def draw_samples(states: int, tried: int = 40):
    """Boxes 2 cm above a floor: a pick on a top succeeds, one within 3 px of its edge fails."""
    rng = np.random.default_rng(0)
    depth, instance = np.full((states, *SIZE), 1.0, np.float32), np.zeros((states, *SIZE), np.uint8)
    for state in range(states):
        for index, left in enumerate((4, 32)):
            top, height, width = rng.integers(2, 8), rng.integers(14, 22), rng.integers(14, 20)
            place = (state, slice(top, top + height), slice(left, left + width))
            depth[place], instance[place] = 0.95 - 0.02 * rng.random(), index + 1
    sight = scores.Sight(torch.from_numpy(depth), torch.from_numpy(instance), 60.0)
    apart = scores.score_contour_distance(sight).numpy()
    rows = []
    for state in range(states):
        places = np.argwhere(instance[state] > 0)
        for candidate, (y, x) in enumerate(places[rng.choice(len(places), tried, replace=False)].tolist()):
            rows.append((state, candidate, int(instance[state, y, x]), x, y, apart[state, y, x] >= 3.5, rng.random()))
    columns = dict(zip(("state", "candidate", "obj_id", "x", "y", "success", "seal"), map(np.array, zip(*rows, strict=True)), strict=True))
    count = len(rows)
    columns |= {"frame": columns["state"], "repeat": np.zeros(count, int), "share": np.ones(count, int)}
    columns |= {"weight": np.ones(count, np.float32), "wrench": np.ones(count)}
    columns["intended"] = columns["success"]
    return data.Samples(sight, None, np.arange(states), columns)


def test_a_network_learns_where_picks_succeed():
    samples = draw_samples(16)
    trained, losses = network.train(samples.part(np.arange(12)), 6, 100, CPU, batch=8)
    assert np.mean(losses[-10:]) < 0.7 * losses[0]
    found = train_picker.evaluate(samples.part(np.arange(12, 16)), train_picker.dense_scores(trained, CPU), CPU)
    assert found["learned"]["auc"].value > 0.8
    assert found["learned"]["first"].value == 1.0
    assert abs(found["analytic"]["auc"].value - 0.5) < 0.15
    assert found["contour"]["auc"].value == pytest.approx(1.0, abs=1e-6)


def test_a_picker_is_read_as_it_was_written(tmp_path):
    one = network.Network(len(network.LABELS) + len(data.MAPS), 4, inputs=5).eval()
    network.save_picker(tmp_path / "a.pt", one, 4, SIZE)
    other, facts = network.load_picker(tmp_path / "a.pt", CPU)
    assert facts["size"] == SIZE
    inputs = torch.rand(1, 5, *SIZE)
    with torch.no_grad():
        torch.testing.assert_close(other(inputs), one(inputs))


def test_turned_images_are_those_of_turned_states():
    """After a turn the network's input at a grasp point is what it was there before, and its normal has turned with the image."""
    samples = draw_samples(1, 30)
    plain = network.Batches.of(samples, CPU)
    height, width = SIZE
    for _ in range(6):
        turned = plain.draw(1, torch.Generator().manual_seed(int(torch.randint(99, (1,)))))
        inside = turned.weight[0] > 0
        assert inside.any()
        found = [
            torch.nn.functional.grid_sample(
                part.instance, network._grid(part.place, height, width)[:, None], "nearest", align_corners=False
            )
            for part in (plain, turned)
        ]
        found = [part[0, 0, 0, inside] for part in found]
        assert (found[0] == found[1]).float().mean() > 0.9
        assert float((turned.inputs[:, 1:4].norm(dim=1)).max()) <= 1.0 + 1e-5


def test_intervals_are_wilsons():
    assert scores.wilson(930, 1000) == pytest.approx((0.9125, 0.9443), abs=1e-4)
    assert scores.wilson(0, 0) == (0.0, 1.0)


def test_normals_of_a_plane_are_its_own():
    """A plane z = 1 + x tan 30° of a weak perspective leans by 30°, and is flat everywhere."""
    x = np.arange(-28, 28) / 2000.0
    depth = torch.from_numpy(np.tile(1.0 + np.tan(np.radians(30.0)) * x, (32, 1)).astype(np.float32))[None]
    normal = scores.find_normals(depth, 2000.0)[0, :, 16, 28]
    np.testing.assert_allclose(normal.numpy(), [0.5, 0.0, -np.sqrt(0.75)], atol=2e-3)
    sight = scores.Sight(depth, torch.ones(1, *SIZE, dtype=torch.uint8), 2000.0)
    assert float(scores.score_flatness(sight)[0, 16, 28]) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["train", "/nowhere"], "/nowhere"),
        (["run", "--picker", "/nowhere.pt"], "/nowhere.pt is no picker"),
        (["run", "--device", "gpu"], 'bake.device is "gpu"'),
    ],
)
def test_a_mistake_is_one_line(capsys, arguments, said):
    assert train_picker.main([*arguments, *(() if "--device" in arguments else ("--device", "cpu"))]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("train_picker: ")
    assert said in line


@pytest.mark.parametrize("task", ["pick", pytest.param("target", marks=pytest.mark.slow)])
def test_pickers_are_run_from_the_same_piles(device, task):
    """In bins of two boxes, whose middles can be picked: heuristic, analytic map and distances to contours find them."""
    runs = pytest.importorskip("tools.examples.picking_runs", exc_type=ImportError)
    with boxes():
        config = load_config("smoke", QUICK | PICKING)
        environment = make_picking(runs.choose_environment(task, 2, (64, 36), 0, max_steps=6), config, perceives=True)
    contour = runs.DenseChoice(scores.score_contour_distance)
    pickers = {"contour": contour, "heuristic": runs.choose_planned, "analytic": runs.AnalyticChoice(environment)}
    ((found, piles),) = runs.run_first_choices(environment, pickers, 2)
    assert piles == environment.count
    assert {name: picked for name, (picked, _) in found.items()} == dict.fromkeys(pickers, piles)
    assert all(int(outcomes.sum()) == piles for _, outcomes in found.values())
    total = runs.run_until_empty(environment, contour)
    assert total.empty == environment.count
    assert int(total.attempts.sum()) == int(total.outcomes.sum())
    others = int(total.outcomes[runs.Outcome.OTHER_PICKED]) * (task == "target")
    assert int(total.picked.sum()) + others == 2 * environment.count <= int(total.attempts.sum())


def test_attempts_of_a_bin_do_not_count_as_independent():
    import torch

    tries, outcomes = torch.full((20,), 10), torch.zeros(len(Outcome), dtype=torch.int64)
    outcomes[0] = 200
    for picked, wider in ((torch.tensor([10, 0] * 10), True), (torch.full((20,), 5), False)):
        found = train_picker.show_rate({"picker": "any"}, picked, outcomes, tries)
        low, high = scores.wilson(100, 200)
        assert (found["low"] < low - 0.1) == (found["high"] > high + 0.1) == wider
        assert found["picked"] == sum(found["bin_picked"]) == 100
        assert found["attempts"] == sum(found["bin_attempts"])


def test_a_pixel_is_picked_as_its_label_was(device):
    """Surface point, normal, yaw and tilt of a pick at a pixel are those of the candidate there."""
    runs = pytest.importorskip("tools.examples.picking_runs", exc_type=ImportError)
    with boxes():
        config = load_config("smoke", QUICK | PICKING | {"perception.resolution": [64, 36], "perception.normal_window": 1})
        environment = make_picking(runs.choose_environment("pick", 1, (64, 36), 0), config)
    environment.reset()
    state, analytic = environment.get_state(), runs.AnalyticChoice(environment)
    grasps, candidates, _ = analytic.sampler.sample(state.worlds, [0])
    worlds, pixels = environment.worlds, candidates.pixel.numpy()
    environment.set_state(state)
    for row in (1, 100, 255):
        worlds.attempt_pixels(np.ones(1, bool), pixels[row : row + 1])
        for name in ("point", "normal", "yaw", "tilt"):
            np.testing.assert_allclose(getattr(worlds.simulation.plan, name).numpy()[0], getattr(grasps, name).numpy()[row], atol=1e-6)
        environment.set_state(state)


def test_choices_are_on_the_target_and_not_barred():
    """Whatever the range of the scores: barred pixels of the target come before those beside it."""
    runs = pytest.importorskip("tools.examples.picking_runs", exc_type=ImportError)
    import torch

    value = torch.tensor([[[40.0, 3.0], [2.0, 1.0]]])
    target, nothing = torch.tensor([[[False, True], [True, False]]]), torch.zeros_like(value, dtype=torch.bool)
    choose = runs.DenseChoice(lambda _: value)
    sight = scores.Sight(value, value.to(torch.uint8), 1.0, target)
    for barred, pixel in ((None, [1, 0]), (nothing, [1, 0]), (nothing | torch.tensor([[False, True], [False, False]]), [0, 1])):
        assert choose(None, sight, barred).tolist() == [pixel]
    assert choose(None, sight, target).tolist() == [[1, 0]]
