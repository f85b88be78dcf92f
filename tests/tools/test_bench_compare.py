"""Benchmark beside other simulators and renderers: the same piles and views; without their libraries one line. No times are asserted."""

from __future__ import annotations

import importlib.util
import json
import math
import warnings

import numpy as np
import pytest
import warp as wp

from synpick_warp.configs.schema import Config
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import Snapshot
from tests.worlds.small_worlds import catalog
from tools.bench import __main__ as bench
from tools.bench.compare import engines, peers, piles, rendering, simulation
from tools.options import Row

UPRIGHT = (0.0, 0.0, 0.0, 1.0)
SMALL = (
    *("--worlds", "2", "--resolution", "32x18", "--seconds", "0", "--device", "cpu"),
    *("--set", "arrangement.volume=1e-3", "--set", "arrangement.max_objects=1"),
    *("--set", "physics.substeps=1", "--set", "physics.steps_per_tick=10"),
)
"""Arguments for two small worlds with an object each."""


@pytest.fixture
def short(monkeypatch):
    """Minimum counts of ticks, steps and repetitions, for short tests."""
    for name in ("FALL_TICKS", "SETTLE_TICKS"):
        monkeypatch.setattr(f"tools.bench.physics.{name}", 1)
    for target in ("physics.MIN_REPEATS", "compare.sensor.BURST", "compare.rendering.BURST", "compare.rendering.SMALL_WORLDS_CPU"):
        monkeypatch.setattr(f"tools.bench.{target}", 1)
    monkeypatch.setattr(rendering, "SMALL_SIZE", (16, 16))
    for name in ("FALL_STEPS", "LEAD_STEPS", "REST_STEPS"):
        monkeypatch.setattr(simulation, name, 2)


@pytest.fixture
def mujoco():
    """MuJoCo and MuJoCo Warp, whose warnings are not ours."""
    warnings.simplefilter("ignore")
    pytest.importorskip("mujoco")
    pytest.importorskip("mujoco_warp")


def boxes(config: Config) -> piles.Pile:
    """Two objects on the tote's floor, side by side."""
    entries = catalog().entries[:2]
    heights = [-float(min(piece.vertices[:, 2].min() for piece in entry.pieces)) for entry in entries]
    return piles.Pile(entries, np.array([(x, 0.0, z, *UPRIGHT) for x, z in zip((-0.1, 0.1), heights, strict=True)]))


@pytest.mark.parametrize(("names", "modules"), [("mujoco", "mujoco"), ("mujoco-warp,sensor-camera", "mujoco and mujoco_warp")])
def test_a_missing_library_is_one_line(names, modules, monkeypatch, capsys):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name.startswith("mujoco") else find(name))
    assert bench.main(["--compare", names, *SMALL]) == 2
    assert capsys.readouterr().err == f"bench: --compare {names} needs {modules}: pip install 'synpick-warp[peers]'\n"


def test_unknown_peers_are_listed(capsys):
    with pytest.raises(SystemExit, match="2"):
        bench.main(["--compare", "isaac"])
    assert "no such peer: isaac; allowed: mujoco-warp, mujoco, sensor-camera" in capsys.readouterr().err


def test_a_peer_that_fails_says_why_and_the_others_go_on(monkeypatch, tmp_path, capsys, short):
    def fail(*arguments: object):
        yield Row("first", 1.0)
        raise RuntimeError("no rays today\nat all")

    monkeypatch.setattr(peers, "measure_sensor", fail)
    monkeypatch.setattr(peers, "_measure_physics", lambda *arguments: iter([Row("next", 2.0, part="ours")]))
    monkeypatch.setattr(bench, "check_installed", lambda names: None)
    file = tmp_path / "bench.json"
    assert bench.main(["--compare", "sensor-camera,mujoco", "--json", str(file), *SMALL]) == 0
    rows = {row["name"]: row["value"] for row in json.loads(file.read_text())["rows"]}
    assert list(rows)[1:] == ["first", "failed: RuntimeError: no rays today", "next"]
    assert rows["failed: RuntimeError: no rays today"] is None
    assert "failed: RuntimeError: no rays today" in capsys.readouterr().out


def test_the_camera_sensor_is_compared_without_any_part(short, tmp_path):
    file = tmp_path / "bench.json"
    assert bench.main(["--compare", "sensor-camera", "--json", str(file), *SMALL]) == 0
    rows = json.loads(file.read_text())["rows"]
    assert {row["part"] for row in rows} == {"setup", "sensor"}
    assert {"1/s", "Mpx/s"} <= {row["unit"] for row in rows}


def test_the_pile_is_that_of_the_median_world_and_worlds_repeat(device):
    snapshot = allocate(Snapshot, {"world": 3, "instance": 2, "fixture": 3}, device)
    snapshot.catalog_index.assign(np.array([[0, 1], [-1, 1], [-1, -1]], np.int32))
    snapshot.pose.assign(np.arange(42, dtype=np.float32).reshape(3, 2, 7))
    pile = piles.pick_pile(catalog(), snapshot)
    assert [entry.obj_id for entry in pile.entries] == [2]
    assert pile.pose.tolist() == [list(range(21, 28))]
    tiled = rendering.tile_snapshot(snapshot, 5, device)
    assert tiled.catalog_index.numpy().tolist() == [[0, 1], [-1, 1], [-1, -1], [0, 1], [-1, 1]]
    assert tiled.pose.numpy()[4].tolist() == snapshot.pose.numpy()[1].tolist()


def test_worlds_of_a_pile_are_equal_and_a_fall_starts_above(device):
    config, few = Config(), catalog()
    pile = boxes(config)
    lifted = pile.lift()
    assert (lifted.pose[:, 2] > pile.pose[:, 2] + 0.99 * piles.LIFT).all()
    assert (lifted.pose[:, :2] == pile.pose[:, :2]).all()
    model = piles.build_piles(config.physics, config.tote, pile, 3, device)
    assert (model.world_count, model.body_count) == (3, 6)
    assert model.body_mass.numpy() == pytest.approx([few.entries[0].mass, few.entries[1].mass] * 3)


def check_engine(engine: engines.Engine, config: Config, pile: piles.Pile) -> None:
    """The engine starts where it is told; a pile in the air falls as Galilei says, and one on the floor stays."""
    steps = 20
    seconds = steps * config.physics.step
    lifted = pile.lift()
    engine.start(lifted)
    assert engine.run(steps) > 0.0
    position, velocity = engine.bodies()
    assert position.shape == velocity.shape == (engine.worlds, 2, 3)
    assert lifted.pose[:, 2] - position[..., 2] == pytest.approx(config.physics.gravity * seconds**2 / 2, rel=0.1)
    assert velocity[..., 2] == pytest.approx(-config.physics.gravity * seconds, rel=0.02)
    engine.start(pile)
    engine.run(steps)
    position, velocity = engine.bodies()
    assert np.abs(position - pile.pose[:, :3]).max() < 1e-3
    assert np.abs(velocity).max() < 0.05


def test_our_engine_falls_and_rests(device):
    config = Config()
    check_engine(engines.make_ours(config.physics, config.tote, boxes(config), 2, device), config, boxes(config))


@pytest.mark.parametrize("cone", engines.CONES)
def test_mujoco_falls_and_rests(cone, mujoco):
    config = Config()
    check_engine(engines.MujocoEngine(config.physics, config.tote, boxes(config), cone), config, boxes(config))


def test_mujoco_warp_falls_and_rests(device, mujoco):
    config = Config()
    check_engine(engines.make_mujoco_warp(config.physics, config.tote, boxes(config), 2, device, "pyramidal", 16), config, boxes(config))


@pytest.mark.parametrize("cone", engines.CONES)
def test_mujoco_warp_in_graphs_takes_the_steps_of_single_launches(cone, mujoco, monkeypatch):
    """On a CPU, where Warp might replay another kernel of the same key."""
    config, found = Config(), []
    for captures in (False, True):
        monkeypatch.setattr(engines, "may_capture", lambda device, captures=captures: captures)
        engine = engines.make_mujoco_warp(config.physics, config.tote, boxes(config), 2, wp.get_device("cpu"), cone, 16)
        engine.start(boxes(config))
        engine.run(4 * engines.GRAPH_STEPS)
        found.append(engine.bodies())
    np.testing.assert_array_equal(*found)


def test_all_peers_are_measured_and_both_renderers_agree(short, mujoco, tmp_path):
    file = tmp_path / "bench.json"
    assert bench.main(["--compare", "mujoco-warp,mujoco", "--json", str(file), *SMALL]) == 0
    rows = json.loads(file.read_text())["rows"]
    assert {row["part"] for row in rows} == {"setup", "ours", "mujoco", "mujoco-warp"}
    assert all(row["value"] is not None and math.isfinite(row["value"]) for row in rows)
    agreement = {row["name"]: row["value"] for row in rows if "depth within" in row["name"]}
    assert len(agreement) == 2
    assert min(agreement.values()) >= 99.0
    rates = {row["name"]: row["value"] for row in rows if "render.mode unoccluded" in row["name"]}
    assert sum("over MuJoCo Warp" in name for name in rates) == 2
    assert min(rates.values()) > 0.0
