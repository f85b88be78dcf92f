"""Benchmarks of pictures alone, and beside other simulators and renderers; without their libraries one line. No times are asserted."""

import importlib.util
import json
import math
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import fields, replace
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest
import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.configs.schema import Config
from synpick_warp.scenes.types import Catalog, Fixture
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.sim.simulate import Simulation
from tests.builders import FEW_STEPS, assignments
from tests.worlds.shapes import GREY, UPRIGHT, ball, box, camera, entry, sheet
from tests.worlds.small_worlds import catalog
from tests.worlds.toy_scene import ToyScene, render, snapshot
from tools.bench import __main__ as bench
from tools.bench import online, peer_scenes, peers, run, worlds
from tools.options import MeasuredRow

WORLDS, CAMERAS, BATCH, AFTER, HISTORY_TICKS, KEPT_TICKS, ROUNDS = 2, 3, 4, 2, 2, 3, 2
SETTINGS = {"bake.mode": "move", "settle.rest_displacement": 1e-3, "render.views_per_batch": BATCH}
SMALL = ("--worlds", str(WORLDS), "--resolution", "32x18", *FEW_STEPS, *assignments(SETTINGS))


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """The rows of the benchmark by name, its simulation, and what each call of the renderer got and found."""
    file, batches, simulations = tmp_path_factory.mktemp("pictures") / "bench.json", [], []
    render, tick = Renderer.render, Simulation.tick

    def watch_render(self: Renderer, snapshot, views, out, layers=None) -> None:
        render(self, snapshot, views, out, layers)
        world, camera = (array.numpy()[: views.count] for array in (views.world, views.camera))
        history = online.light_history(self)
        slots = world * CAMERAS + camera
        batches.append(
            SimpleNamespace(
                renderer=self,
                snapshot=snapshot,
                views=list(zip(snapshot.episode.numpy()[world], snapshot.frame.numpy()[world], camera, strict=True)),
                live=snapshot.live.numpy()[world],
                holds=None if history is None else self.shading.moving.holds.numpy()[: views.count].copy(),
                paths=None if history is None else history.paths.numpy()[slots],
                color=out.color.numpy()[: views.count].copy(),
            )
        )

    def watch_tick(self: Simulation) -> None:
        tick(self)
        simulations.append((self, self.record.snapshot.frame.numpy().copy()))

    with (
        mock.patch.multiple(online, HISTORY_TICKS=HISTORY_TICKS, KEPT_TICKS=KEPT_TICKS, ROUNDS=ROUNDS),
        mock.patch.object(Renderer, "render", watch_render),
        mock.patch.object(Simulation, "tick", watch_tick),
    ):
        assert bench.main(["--parts", "pictures", "--after", str(AFTER), "--json", str(file), *SMALL]) == 0
    rows = {row["name"]: row for row in json.loads(file.read_text())["rows"]}
    return SimpleNamespace(rows=rows, batches=batches, ticks=simulations)


def split_passes(measured) -> tuple[list, dict[Renderer, list[list]]]:
    """Batches before the passes, and of each renderer those of each pass; a pass has two batches a tick."""
    per_tick = -(-WORLDS * CAMERAS // BATCH)
    first = HISTORY_TICKS * per_tick
    warmup, timed = measured.batches[first : first + 3 * per_tick], measured.batches[first + 3 * per_tick :]
    renderers = list(dict.fromkeys(batch.renderer for batch in warmup))
    size = KEPT_TICKS * per_tick
    passes = [timed[start : start + size] for start in range(0, len(timed), size)]
    return measured.batches[:first], {renderer: passes[index :: len(renderers)] for index, renderer in enumerate(renderers)}


def all_views(batches: Sequence) -> list[tuple]:
    """Episode, frame and camera of all views of some batches."""
    return [view for batch in batches for view in batch.views]


def test_each_pass_renders_each_view_of_each_kept_tick_once(measured):
    first, passes = split_passes(measured)
    assert [len(of_renderer) for of_renderer in passes.values()] == [ROUNDS] * 3
    assert len(all_views(first)) == HISTORY_TICKS * WORLDS * CAMERAS
    assert min(frame for _, frame, _ in all_views(first)) >= AFTER
    episodes = {episode for episode, *_ in all_views(first)}
    last = {episode: max(frame for other, frame, _ in all_views(first) if other == episode) for episode in episodes}
    assert len(episodes) == WORLDS
    wanted = {
        (episode, last[episode] + 1 + tick, camera) for episode in episodes for tick in range(KEPT_TICKS) for camera in range(CAMERAS)
    }
    for of_renderer in passes.values():
        for batches in of_renderer:
            assert {batch.renderer for batch in batches} == {of_renderer[0][0].renderer}
            assert Counter(all_views(batches)) == dict.fromkeys(wanted, 1)
            assert all(batch.live.all() for batch in batches)
            assert [len(batch.views) for batch in batches] == [4, 2] * KEPT_TICKS


def test_kept_snapshots_are_copies(measured):
    """They hold successive frames, though the simulation has overwritten its record since."""
    _, passes = split_passes(measured)
    snapshots = list(dict.fromkeys(batch.snapshot for batch in next(iter(passes.values()))[0]))
    assert len(snapshots) == KEPT_TICKS
    simulated = [frame for _, frame in measured.ticks[-KEPT_TICKS:]]
    assert [snapshot.frame.numpy().tolist() for snapshot in snapshots] == [frame.tolist() for frame in simulated]
    simulation = measured.ticks[0][0]
    names = [item.name for item in fields(Snapshot)]
    taken = {getattr(simulation.record.snapshot, name).ptr for name in names}
    kept = [getattr(snapshot, name).ptr for snapshot in snapshots for name in names]
    assert len(set(kept)) == len(kept)
    assert not taken & set(kept)


def test_histories_continue_in_every_pass_and_are_the_same_in_each(measured):
    first, passes = split_passes(measured)
    with_history, whole, without = passes.values()
    assert all(not batch.holds.any() for batch in first[:2])
    assert all(batch.holds.all() for batches in (*with_history, *whole) for batch in batches)
    assert all(batch.holds is None for batches in without for batch in batches)
    for batch, again in (*zip(*with_history, strict=True), *zip(with_history[0], whole[0], strict=True)):
        np.testing.assert_array_equal(batch.paths, again.paths)
        np.testing.assert_array_equal(batch.color, again.color)
    longest = [max(batch.paths.max() for batch in batches) for batches in (first[:2], first[-2:], with_history[0][-2:])]
    assert longest[0] < longest[1] < longest[2]


def test_rows_state_counts_and_rates(measured):
    rows = {name: row["value"] for name, row in measured.rows.items()}
    assert {row["part"] for row in measured.rows.values()} == {"pictures"}
    assert rows["ticks in a pass"] == KEPT_TICKS
    assert rows["views in a pass"] == KEPT_TICKS * WORLDS * CAMERAS
    assert rows["views in a batch"] == BATCH
    assert rows["paths in a history before a pass, mean"] > 1.0
    for name in ("all stages", "all stages, render.reuse=false", "all stages, render.history=0"):
        rate = rows[f"{name}: views, median of {ROUNDS} passes"]
        assert 0.0 < rows[f"{name}: views, slowest pass"] <= rate <= rows[f"{name}: views, fastest pass"]
        assert rows[f"{name}: pixels"] == pytest.approx(32 * 18e-6 * rate)
        assert rows[f"{name}: a view"] == pytest.approx(1e3 / rate)
        assert measured.rows[f"{name}: pixels"]["unit"] == "Mpx/s"


# ---- Newton's SensorCamera ----


OBLIQUE = np.array([[1.0, 0.0, 0.0], [0.0, -0.6, -0.8], [0.0, 0.8, -0.6]])
"""World-to-camera rotation of a camera that looks down and towards +y."""


@pytest.fixture(scope="module")
def views(device):
    """Two worlds of overlapping objects by two cameras: the sensor's scene and images, and ours."""
    rng = np.random.default_rng(0)
    quaternions = rng.normal(size=(2, 3, 4))
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    positions = rng.uniform((-0.15, -0.1, 0.05), (0.15, 0.1, 0.2), (2, 3, 3))
    entries = ((0, 1, 1), (1, 0, 0))
    toy = ToyScene(
        [entry(ball(0.08, 3)), entry(box(0.2, 0.1, 0.05))],
        [[(entry_index, (*positions[w, i], *quaternions[w, i])) for i, entry_index in enumerate(entries[w])] for w in range(2)],
        (camera(80, 60, 90.0, (0.0, 0.0, 1.0)), camera(80, 60, 90.0, (0.0, -0.8, 0.7), OBLIQUE)),
        fixtures=(Fixture(box(0.5, 0.4, 0.02), GREY), Fixture(box(0.05, 0.05, 0.4), GREY), Fixture(box(0.1, 0.1, 0.1), GREY)),
        fixture_poses=((0.0, 0.0, 0.0, *UPRIGHT), (0.1, 0.0, 0.4, *UPRIGHT), (0.0, 0.0, 0.1, *UPRIGHT)),
        fixtures_visible=(1, 1, 0),
        table=True,
    )
    config = toy.settings()
    scene = peer_scenes.SensorScene(
        config.render, Catalog(tuple(toy.entries)), toy.fixtures, toy.cameras, -config.tote.wall, snapshot(toy, device), 4, device
    )
    scene.prepare(color=False)[0]()
    return scene, *scene.read_hits(4), render(toy, device)


def test_an_independent_renderer_agrees(views):
    scene, index, depth, ours = views
    assert set(np.unique(ours.instance)) == {1, 2, 3, Segment.TABLE, Segment.TOTE, Segment.FINGER}
    same, close, largest = (row.value for row in peer_scenes.compare_hits(scene.segment, index, depth, ours.instance, ours.depth, 0.1))
    # Rounding decides on which side of a silhouette a grazing ray passes.
    assert same >= 99.9
    assert close >= 99.9
    assert largest >= 0.0


def test_differences_are_counted(views):
    scene, index, depth, ours = views
    segment, counts = ours.instance.copy(), ours.depth.copy()
    segment[0, :30] = Segment.CUP
    counts[0, 30:] += 100
    same, close, largest = (row.value for row in peer_scenes.compare_hits(scene.segment, index, depth, segment, counts, 0.1))
    assert same == pytest.approx(87.5, abs=0.2)
    assert close == pytest.approx(75.0, abs=0.2)
    assert largest >= 9.9


def test_textures_with_the_same_border_stay_distinct():
    black = np.zeros((1024, 1024, 3), np.uint8)
    framed = black.copy()
    framed[:, 1:] = 200
    first, second = (peer_scenes.newton_mesh(sheet(1.0, 1.0), replace(GREY, texture=texture)) for texture in (black, framed))
    assert first.texture_hash != second.texture_hash


# ---- other simulators and renderers ----


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
        monkeypatch.setattr(peers, name, 2)


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
    return peers.EqualPile(entries, np.array([(x, 0.0, z, *UPRIGHT) for x, z in zip((-0.1, 0.1), heights, strict=True)]))


@pytest.mark.parametrize(("names", "modules"), [("mujoco", "mujoco"), ("mujoco-warp,sensor-camera", "mujoco and mujoco_warp")])
def test_a_missing_library_is_one_line(names, modules, monkeypatch, capsys):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name.startswith("mujoco") else find(name))
    assert bench.main(["--compare", names, *FEW_STEPS]) == 2
    assert capsys.readouterr().err == f"bench: --compare {names} needs {modules}: pip install 'synpick-warp[peers]'\n"


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
    median = peers.pick_pile(catalog(), snapshot)
    assert [entry.obj_id for entry in median.entries] == [2]
    assert median.pose.tolist() == [list(range(21, 28))]
    tiled = peers.tile_snapshot(snapshot, 5, device)
    assert tiled.catalog_index.numpy().tolist() == [[0, 1], [-1, 1], [-1, -1], [0, 1], [-1, 1]]
    assert tiled.pose.numpy()[4].tolist() == snapshot.pose.numpy()[1].tolist()


def test_worlds_of_a_pile_are_equal_and_a_fall_starts_above(pile, device):
    lifted = pile.lift()
    assert (lifted.pose[:, 2] > pile.pose[:, 2] + 0.99 * peers.LIFT).all()
    assert (lifted.pose[:, :2] == pile.pose[:, :2]).all()
    model = peers.build_piles(TWO, pile, 3, device)
    assert (model.world_count, model.body_count) == (3, 6)
    assert model.body_mass.numpy() == pytest.approx([entry.mass for entry in pile.entries] * 3)


@pytest.mark.parametrize("name", ["ours", "mujoco-warp", *peers.CONES])
def test_a_pile_in_the_air_falls_as_galilei_says_and_one_on_the_floor_stays(name, pile, device, request):
    if name == "ours":
        engine = peers.make_ours(TWO, pile, device)
    else:
        request.getfixturevalue("mujoco")
        warp_engine = name == "mujoco-warp"
        engine = peers.make_mujoco_warp(TWO, pile, device, "pyramidal", 16) if warp_engine else peers.MujocoEngine(TWO, pile, name)
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


@pytest.mark.parametrize("cone", peers.CONES)
def test_mujoco_warp_in_graphs_takes_the_steps_of_single_launches(cone, pile, mujoco, monkeypatch):
    """On a CPU, where Warp might replay another kernel of the same key."""
    found = []
    for captures in (False, True):
        monkeypatch.setattr(peers, "may_capture", lambda device, captures=captures: captures)
        engine = peers.make_mujoco_warp(TWO, pile, wp.get_device("cpu"), cone, 16)
        engine.start(pile)
        engine.run(4 * peers.GRAPH_STEPS)
        found.append(engine.bodies())
    np.testing.assert_array_equal(*found)
