"""Examples of training: a network on the stream of tiny boxes; the picker on drawn boxes whose tops are flat in the middle alone. Skipped
without PyTorch."""

import numpy as np
import pytest

from synpick_warp.configs.files.load import load_config
from synpick_warp.environment.make import make_picking
from synpick_warp.environment.settings import make_choice
from tests.builders import PICKING, assignments, boxes
from tests.online.conftest import TINY
from tests.worlds.small_worlds import QUICK

torch = pytest.importorskip("torch", exc_type=ImportError)
train_online = pytest.importorskip("tools.examples.train_online", exc_type=ImportError)
picker = pytest.importorskip("tools.examples.train_picker", exc_type=ImportError)

SIZE = (32, 56)
CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def one_thread():
    """Small images: threads cost more than they save."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize(
    ("example", "arguments", "said"),
    [
        (train_online, ["--device", "cuda:99"], "cuda:99 was requested"),
        (train_online, ["--device", "gpu"], 'bake.device is "gpu"'),
        (train_online, ["--resolution", "16x4"], "--resolution is 16x4; allowed: at least 8 px on each side"),
        (train_online, ["--models", "/nowhere"], "/nowhere"),
        (train_online, ["--set", "bake.world=3"], "did you mean worlds"),
        (picker, ["train", "/nowhere"], "/nowhere"),
        (picker, ["run", "--picker", "/nowhere.pt"], "/nowhere.pt is no picker"),
        (picker, ["run", "--device", "gpu"], 'bake.device is "gpu"'),
    ],
)
def test_a_mistake_is_one_line(capsys, example, arguments, said):
    assert example.main([*arguments, *(() if "--device" in arguments else ("--device", "cpu"))]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{example.__name__.rpartition('.')[2]}: ")
    assert said in line


# ---- the stream ----


def test_a_network_learns_from_the_stream(capsys):
    given = QUICK | TINY | {"bake.mode": "move", "arrangement.volume": 3e-4}
    chosen = assignments({key: value for key, value in given.items() if key not in ("bake.device", "bake.worlds")})
    small = ["--device", "cpu", "--worlds", "2", "--resolution", "48x27", "--batch", "3", "--width", "8", "--stride", "1"]
    options = train_online.parse([*small, *chosen, "--held-out", "6", "--views", "6,24,96"])
    with boxes():
        results = train_online.run(options, torch.device("cpu"))
    assert all(0 <= value <= 1 for value in results)
    said = capsys.readouterr().out.splitlines()
    assert len(results) == 3
    assert said[0] == "held out: 6 views, obj_id up to 3"
    assert [line.split()[0] for line in said[1:]] == ["6", "24", "96"]
    first, last = (float(word) for word in said[-1].split("cross entropy ")[1].split(",")[0].split(" to "))
    assert last < 0.9 * first


@pytest.mark.parametrize("arguments", [["--views", "0"], ["--views", "abc"], ["--held-out", "0"], ["--stride", "0"], ["--width", "0"]])
def test_numbers_are_positive(capsys, arguments):
    with pytest.raises(SystemExit) as ended:
        train_online.main(arguments)
    assert ended.value.code == 2
    assert "is no count; allowed: 1 to" in capsys.readouterr().err


# ---- the picker ----


def draw_samples(states: int, tried: int = 40):
    """Boxes 2 cm above a floor: a pick on a top succeeds, one within 3 px of its edge fails."""
    rng = np.random.default_rng(0)
    depth, inside = np.full((states, *SIZE), 1.0, np.float32), np.zeros((states, *SIZE), bool)
    rows = []
    for state in range(states):
        seen = np.zeros(SIZE, bool)
        for left in (4, 32):
            top, height, width = rng.integers(2, 8), rng.integers(14, 22), rng.integers(14, 20)
            depth[state, top : top + height, left : left + width] = 0.95 - 0.02 * rng.random()
            seen[top : top + height, left : left + width] = True
            inside[state, top + 3 : top + height - 3, left + 3 : left + width - 3] = True
        places = np.argwhere(seen)
        rows += [(state, y, x, inside[state, y, x]) for y, x in places[rng.choice(len(places), tried, replace=False)].tolist()]
    columns = dict(zip(("state", "y", "x", "success"), map(np.array, zip(*rows, strict=True)), strict=True))
    columns |= {"intended": columns["success"], "weight": np.ones(len(rows), np.float32)}
    return picker.PickSamples(torch.from_numpy(depth), torch.from_numpy(depth < 1.0), 60.0, np.arange(states), columns)


def test_a_network_learns_where_picks_succeed():
    samples = draw_samples(16)
    trained, losses = picker.train(samples.part(np.arange(12)), 6, 100, CPU, 0, 8)
    assert np.mean(losses[-10:]) < 0.7 * losses[0]
    assert picker.measure_auc(trained, samples.part(np.arange(12, 16)), CPU).value > 0.8


def test_normals_of_a_plane_are_its_own():
    """A plane z = 1 + x tan 30° of a weak perspective leans by 30°."""
    x = np.arange(-28, 28) / 2000.0
    depth = torch.from_numpy(np.tile(1.0 + np.tan(np.radians(30.0)) * x, (32, 1)).astype(np.float32))[None]
    np.testing.assert_allclose(picker.find_normals(depth, 2000.0)[0, :, 16, 28].numpy(), [0.5, 0.0, -np.sqrt(0.75)], atol=2e-3)


class Middle(torch.nn.Module):
    """Network that predicts success by the depth alone: the higher, the better."""

    def forward(self, inputs):
        return -inputs[:, :1].expand(-1, 2, -1, -1)


@pytest.mark.parametrize("task", ["pick", pytest.param("target", marks=pytest.mark.slow)])
def test_both_choose_from_the_same_piles(device, task):
    """In bins of two boxes, of which a smoothed map of heights finds the middles."""
    with boxes():
        config = load_config("smoke", QUICK | PICKING)
        choice = make_choice(task, 2, ("depth", "instances"), (64, 36), "pixel", "disabled", "torch", 0, 6, None, "attempt")
        environment = make_picking(choice, config, perceives=True)
    for _ in range(2):
        assert picker.try_both(Middle(), environment) == {"learned": environment.count, "heuristic": environment.count}
    assert environment.choice == choice
