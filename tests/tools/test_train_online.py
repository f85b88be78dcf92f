"""The training example, on tiny pictures of boxes; skipped without PyTorch."""

from __future__ import annotations

import pytest

from tests.builders import assignments, boxes
from tests.online.conftest import TINY
from tests.worlds.small_worlds import QUICK

torch = pytest.importorskip("torch", exc_type=ImportError)
train_online = pytest.importorskip("tools.examples.train_online", exc_type=ImportError)


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
    print(*said, sep="\n")
    assert last < 0.9 * first


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--device", "cuda:99"], "cuda:99 was requested"),
        (["--device", "gpu"], 'bake.device is "gpu"'),
        (["--resolution", "16x4"], "--resolution is 16x4; allowed: at least 8 px on each side"),
        (["--models", "/nowhere"], "/nowhere"),
        (["--set", "bake.world=3"], "did you mean worlds"),
    ],
)
def test_a_mistake_is_one_line(capsys, arguments, said):
    assert train_online.main(["--device", "cpu", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("train_online: ")
    assert said in line


@pytest.mark.parametrize("arguments", [["--views", "0"], ["--views", "abc"], ["--held-out", "0"], ["--stride", "0"], ["--width", "0"]])
def test_numbers_are_positive(capsys, arguments):
    with pytest.raises(SystemExit) as ended:
        train_online.main(arguments)
    assert ended.value.code == 2
    assert "is no count; allowed: 1 to" in capsys.readouterr().err
