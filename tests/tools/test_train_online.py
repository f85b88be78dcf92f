"""The training example, on tiny pictures of boxes; skipped without PyTorch."""

from __future__ import annotations

import pytest

from synpick_warp.factory import assembly
from tests.online.conftest import TINY
from tests.worlds.small_worlds import QUICK, catalog

pytest.importorskip("torch", exc_type=ImportError)
train_online = pytest.importorskip("tools.examples.train_online", exc_type=ImportError)


def test_a_network_learns_from_the_stream(monkeypatch, capsys):
    monkeypatch.setattr(assembly, "load_catalog", lambda config, report: catalog())
    given = QUICK | {key.replace("__", "."): value for key, value in TINY.items()} | {"bake.mode": "move", "arrangement.volume": 3e-4}
    assignments = [
        part for key, value in given.items() if key not in ("bake.device", "bake.worlds") for part in ("--set", f"{key}={value}")
    ]
    small = ["--device", "cpu", "--worlds", "2", "--resolution", "48x27", "--batch", "3", "--width", "8", "--stride", "1"]
    results = train_online.main([*small, *assignments, "--held-out", "6", "--views", "6,24,96"])
    assert all(0 <= value <= 1 for value in results)
    said = capsys.readouterr().out.splitlines()
    assert len(results) == 3
    assert said[0] == "held out: 6 views, obj_id up to 3"
    assert [line.split()[0] for line in said[1:]] == ["6", "24", "96"]
    first, last = (float(word) for word in said[-1].split("cross entropy ")[1].split(",")[0].split(" to "))
    print(*said, sep="\n")
    assert last < 0.9 * first
