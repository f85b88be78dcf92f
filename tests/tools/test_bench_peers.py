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
from tests.builders import FEW_STEPS
from tests.worlds.small_worlds import catalog
from tests.worlds.toy_scene import UPRIGHT
from tools.bench import __main__ as bench
from tools.bench import engines, peers, run, worlds
from tools.options import MeasuredRow

TWO = Config().with_values({"bake.worlds": 2})


def measure(folder, names: str) -> dict[tuple[str, str], float]:
    """Values of the rows of `--compare names` on two small worlds with an object each, by part and name; None: not finite."""
    file = folder / "bench.json"
    small = ("--worlds", "2", "--resolution", "32x18", "--seconds", "0", *FEW_STEPS)
    assert bench.main(["--compare", names, "--json", str(file), *small]) == 0
    return {(row["part"], row["name"]): row["value"] for row in json.loads(file.read_text())["rows"]}


@pytest.fixture
def short(monkeypatch):
    """Minimum counts of ticks, steps, worlds and repetitions."""
    for module, names in ((worlds, ("FALL_TICKS", "SETTLE_TICKS")), (run, ("BURST", "MIN_REPEATS")), (peers, ("SMALL_WORLDS_CPU",))):
        for name in names:
            monkeypatch.setattr(module, name, 1)
    monkeypatch.setattr(peers, "SMALL_SIZE", (16, 16))
    for name in ("FALL_STEPS", "LEAD_STEPS", "REST_STEPS"):
        monkeypatch.setattr(engines, name, 2)


@pytest.fixture
def mujoco():
    """MuJoCo and MuJoCo Warp, whose warnings are not ours."""
    warnings.simplefilter("ignore")
    pytest.importorskip("mujoco")
    pytest.importorskip("mujoco_warp")


@pytest.fixture
def pile():
    """Two objects on the tote's floor, side by side."""
    entries = catalog().entries[:2]
    heights = [-float(min(piece.vertices[:, 2].min() for piece in entry.pieces)) for entry in entries]
    return engines.EqualPile(entries, np.array([(x, 0.0, z, *UPRIGHT) for x, z in zip((-0.1, 0.1), heights, strict=True)]))


@pytest.mark.parametrize(("names", "modules"), [("mujoco", "mujoco"), ("mujoco-warp,sensor-camera", "mujoco and mujoco_warp")])
def test_a_missing_library_is_one_line(names, modules, monkeypatch, capsys):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name.startswith("mujoco") else find(name))
    assert bench.main(["--compare", names, *FEW_STEPS]) == 2
    assert capsys.readouterr().err == f"bench: --compare {names} needs {modules}: pip install 'synpick-warp[peers]'\n"


def test_unknown_peers_are_listed(capsys):
    with pytest.raises(SystemExit, match="2"):
        bench.main(["--compare", "isaac"])
    assert "no such peer: isaac; allowed: mujoco-warp, mujoco, sensor-camera" in capsys.readouterr().err


def test_a_peer_that_fails_says_why_and_the_others_go_on(monkeypatch, tmp_path, capsys, short):
    def fail(*_: object):
        raise RuntimeError("no rays today\nat all")

    monkeypatch.setattr(peers, "compare_hits", fail)
    monkeypatch.setattr(peers, "measure_engine", lambda *_: iter([MeasuredRow("next", 2.0)]))
    monkeypatch.setattr(bench, "check_installed", lambda names: None)
    values, reason = measure(tmp_path, "sensor-camera,mujoco"), "failed: RuntimeError: no rays today"
    assert values["sensor-camera", "32x18, 1 world: views in a batch"] == 3.0
    assert values["sensor-camera", reason] is None
    assert list(values)[-2:] == [("ours", "next"), ("mujoco", "next")]
    assert reason in capsys.readouterr().out


def check_rendering(values: dict[tuple[str, str], float], peer: str, name: str) -> None:
    """The renderers agree, and both are measured at both sizes, in depth, and in colour beside both of our modes."""
    rows = {row: value for (part, row), value in values.items() if part == peer}
    agreement = [value for row, value in rows.items() if "depth within" in row]
    assert len(agreement) == 2
    assert min(agreement) >= 99.0
    rates = {row: value for row, value in rows.items() if f"over {name}'s" in row}
    assert (len(rates), sum("render.mode unoccluded" in row for row in rates)) == (6, 2)
    assert min(rates.values()) > 0.0


def test_the_camera_sensor_is_compared_without_any_part(short, tmp_path):
    values = measure(tmp_path, "sensor-camera")
    assert {part for part, _ in values} == {"setup", "sensor-camera"}
    check_rendering(values, "sensor-camera", "SensorCamera")


def test_mujoco_is_compared_in_physics_and_pictures(short, mujoco, tmp_path):
    values = measure(tmp_path, "mujoco-warp,mujoco")
    assert {part for part, _ in values} == {"setup", "ours", "mujoco", "mujoco-warp"}
    assert all(value is not None and math.isfinite(value) for value in values.values())
    check_rendering(values, "mujoco-warp", "MuJoCo Warp")


def test_the_pile_is_that_of_the_median_world_and_worlds_repeat(device):
    snapshot = allocate(Snapshot, {"world": 3, "instance": 2, "fixture": 3}, device)
    snapshot.catalog_index.assign(np.array([[0, 1], [-1, 1], [-1, -1]], np.int32))
    snapshot.pose.assign(np.arange(42, dtype=np.float32).reshape(3, 2, 7))
    median = engines.pick_pile(catalog(), snapshot)
    assert [entry.obj_id for entry in median.entries] == [2]
    assert median.pose.tolist() == [list(range(21, 28))]
    tiled = peers.tile_snapshot(snapshot, 5, device)
    assert tiled.catalog_index.numpy().tolist() == [[0, 1], [-1, 1], [-1, -1], [0, 1], [-1, 1]]
    assert tiled.pose.numpy()[4].tolist() == snapshot.pose.numpy()[1].tolist()


def test_worlds_of_a_pile_are_equal_and_a_fall_starts_above(pile, device):
    lifted = pile.lift()
    assert (lifted.pose[:, 2] > pile.pose[:, 2] + 0.99 * engines.LIFT).all()
    assert (lifted.pose[:, :2] == pile.pose[:, :2]).all()
    model = engines.build_piles(TWO, pile, 3, device)
    assert (model.world_count, model.body_count) == (3, 6)
    assert model.body_mass.numpy() == pytest.approx([entry.mass for entry in pile.entries] * 3)


@pytest.mark.parametrize("name", ["ours", "mujoco-warp", *engines.CONES])
def test_a_pile_in_the_air_falls_as_galilei_says_and_one_on_the_floor_stays(name, pile, device, request):
    if name == "ours":
        engine = engines.make_ours(TWO, pile, device)
    else:
        request.getfixturevalue("mujoco")
        warp_engine = name == "mujoco-warp"
        engine = engines.make_mujoco_warp(TWO, pile, device, "pyramidal", 16) if warp_engine else engines.MujocoEngine(TWO, pile, name)
    steps, lifted = 20, pile.lift()
    seconds = steps * TWO.physics.step
    engine.start(lifted)
    assert engine.run(steps) > 0.0
    position, velocity = engine.bodies()
    assert position.shape == velocity.shape == (engine.worlds, 2, 3)
    assert lifted.pose[:, 2] - position[..., 2] == pytest.approx(TWO.physics.gravity * seconds**2 / 2, rel=0.1)
    assert velocity[..., 2] == pytest.approx(-TWO.physics.gravity * seconds, rel=0.02)
    engine.start(pile)
    engine.run(steps)
    position, velocity = engine.bodies()
    assert np.abs(position - pile.pose[:, :3]).max() < 1e-3
    assert np.abs(velocity).max() < 0.05


@pytest.mark.parametrize("cone", engines.CONES)
def test_mujoco_warp_in_graphs_takes_the_steps_of_single_launches(cone, pile, mujoco, monkeypatch):
    """On a CPU, where Warp might replay another kernel of the same key."""
    found = []
    for captures in (False, True):
        monkeypatch.setattr(engines, "may_capture", lambda device, captures=captures: captures)
        engine = engines.make_mujoco_warp(TWO, pile, wp.get_device("cpu"), cone, 16)
        engine.start(pile)
        engine.run(4 * engines.GRAPH_STEPS)
        found.append(engine.bodies())
    np.testing.assert_array_equal(*found)
