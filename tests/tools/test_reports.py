"""Reports and benchmarks: statistics and bounds, and that they run on small worlds or known data. Measured values are not asserted."""

import json
import shutil

import cv2
import numpy as np
import pytest

from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import Config
from tests.builders import FEW_STEPS, ONE_OBJECT, PICKING, assignments, refusal
from tests.harness.environment import ROOT
from tools.bench import __main__ as bench
from tools.bench import worlds
from tools.compare import __main__ as compare
from tools.compare import pictures
from tools.figures import read_runs
from tools.reports import rest as rest_report
from tools.reports import sequence
from tools.reports.real_frames import read_frames, write_data_set
from tools.reports.sequence import Pair, Shot, summarize_pairs

PICKS = {key: value for key, value in PICKING.items() if key.startswith(("perception.", "pick."))}
SHORT_PICKS = (*FEW_STEPS, *assignments(PICKS | {"pick.speed": 4.0, "pick.lift_speed": 2.0, "settle.rest_displacement": 1e-3}))
"""Options of short picking episodes of one object, with small images for perception."""


def pile(**changes):
    """A pile of two objects at rest, well within all bounds."""
    values = {
        "ticks": 30,
        "redrops": 0,
        "volume": 6.5,
        "energy": 0.0,
        "tick_speed": np.full(2, 0.01),
        "speed": np.full(2, 0.1),
        "depth": np.full(2, 0.5),
        "inside": np.full(2, True),
    }
    return rest_report.RestingPile(**values | changes)


SETTINGS = Config()


def violated(results, config=SETTINGS) -> list[str]:
    """Names of the report's rows whose bound is violated."""
    return [row.name for row in rest_report.report(results, config.physics, bool(config.arrangement.counts)) if not row.holds]


def test_a_settled_pile_is_within_all_bounds_and_none_within_no_bound():
    assert violated(rest_report.RestResults([pile(), pile()])) == []
    assert len(violated(rest_report.RestResults(given_up=1))) == 6


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"speed": np.full(2, 0.3)}, ["speed, instantaneous, median"]),
        ({"tick_speed": np.full(2, 0.3)}, ["speed, by displacement over a tick, median"]),
        ({"depth": np.array([0.1, 2.0])}, ["penetration, 99 %"]),
        ({"depth": np.array([0.1, np.nan])}, ["penetration, 99 %"]),
        ({"inside": np.array([True, False])}, ["objects inside the tote"]),
        ({"volume": 7.01}, ["total volume, max"]),
    ],
)
def test_each_bound_is_checked(changes, names):
    assert violated(rest_report.RestResults([pile(**changes)])) == names


def test_fills_by_number_may_have_any_volume_but_not_more_contacts_than_there_is_room_for():
    config = Config().with_values({"arrangement.counts": (("bracket", 150, 150),)})
    assert violated(rest_report.RestResults([pile(volume=28.0)]), config) == []
    assert violated(rest_report.RestResults([pile()], contacts=512.0, pairs=1024.0), config) == [
        "contacts a world, most in a tick",
        "pairs of shapes a world, most in a tick",
    ]


def test_inside_is_within_the_rim_from_the_floor_to_the_heap_height():
    tote = SETTINGS.tote
    (length, width), rim = tote.rim_size, tote.outer_size[2] - tote.wall
    inside = [[0, 0, 0.01], [0.499 * length, 0, 0.1], [0, 0, rim + 0.09]]
    outside = [[0, 0, -0.001], [0.501 * length, 0, 0.1], [0, -0.501 * width, 0.1], [0, 0, rim + 0.11], [np.nan, 0, 0.1]]
    assert rest_report.is_inside(BinSizes.of_tote(tote), np.array(inside + outside)).tolist() == [True] * 3 + [False] * 5


def test_transform_points_rotates_then_translates():
    half = np.sqrt(0.5)
    pose = np.array([[1.0, 2.0, 3.0, 0.0, 0.0, half, half]])  # 90° about z.
    position, rotation = rest_report.transform_points(pose, np.array([[1.0, 0.0, 0.5]]))
    np.testing.assert_allclose(position, [[1.0, 3.0, 3.5]], atol=1e-12)
    np.testing.assert_allclose(rotation[0] @ rotation[0].T, np.eye(3), atol=1e-12)


def test_more_arrangements_than_worlds(tmp_path):
    file = tmp_path / "rest.json"
    code = rest_report.main(["--arrangements", "2", "--worlds", "1", "--seed", "1", "--json", str(file), *FEW_STEPS])
    record = read_runs(tmp_path)[file.name].rows
    rows = {row.name: row.value for row in record}
    assert code == (0 if all(row.holds for row in record) else 1)
    assert rows["arrangements at rest"] == 2
    assert rows["objects"] == 2
    assert rows["objects inside the tote"] == 100.0


@pytest.mark.slow
def test_bench_measures_every_part_of_small_worlds(tmp_path, monkeypatch, capsys):
    for name in ("FALL_TICKS", "SETTLE_TICKS", "STIR_TICKS", "LEAD_TICKS", "PICK_TICKS", "STREAM_BATCHES"):
        monkeypatch.setattr(worlds, name, 1)
    for target in ("run.MIN_REPEATS", "run.BURST", "bakes.LEAD_TICKS"):
        monkeypatch.setattr(f"tools.bench.{target}", 1)
    # Other tests write to and delete from the file system whose used space is measured.
    unchanged = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: unchanged)
    file = tmp_path / "bench.json"
    small = ("--worlds", "1", "--resolution", "32x18", "--seconds", "0", "--set", 'bake.formats=["bop", "shards"]')
    assert bench.main([*small, "--json", str(file), *SHORT_PICKS]) == 0
    rows = json.loads(file.read_text())["rows"]
    assert {row["part"] for row in rows} == {"setup", *bench.DEFAULT_PARTS}
    assert all(row["value"] >= 0.0 for row in rows)
    printed = capsys.readouterr().out
    for name in ("views, all stages", "picking, steps alone", "perception and planning: fraction of the simulation's time"):
        assert name in printed


@pytest.mark.parametrize(
    ("tool", "arguments", "said"),
    [
        (rest_report, ["--device", "cuda:99"], "cuda:99"),
        (bench, ["--device", "cuda:99"], "cuda:99"),
        *((pictures, ["--devices", devices], "compare pictures: ") for devices in ("cpu", "cpu,cpu,cpu", "cpu,tpu", "")),
        *(
            (sequence, arguments, "reports.sequence: ")
            for arguments in (["--size", "32"], ["--size", "axb"], ["--set", "render.bounces=0"])
        ),
        *((compare, arguments, " is no comparison; ") for arguments in ([], ["dance"])),
        (compare, ["guard", str(ROOT), "/nowhere"], " is no checkout"),
    ],
)
def test_a_mistake_is_one_line(tool, arguments, said, capsys):
    assert tool.main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


# ---- frames of episodes ----


def shot(level: int, size: tuple[int, int] = (9, 16)) -> Shot:
    """A uniform grey image."""
    return Shot(np.full((*size, 3), level, np.uint8), np.full((*size, 3), level / 255, np.float32))


def pair(denoised: Shot, *references: Shot) -> Pair:
    return Pair("map", denoised, (references[0], references[-1]))


def test_quality_is_psnr_without_the_references_noise():
    assert round(pair(shot(101), shot(100)).quality, 3) == 48.131
    assert pair(shot(100), shot(100)).quality > 100.0
    assert pair(shot(100), shot(110)).bias == pytest.approx(-100.0 / 11.0, rel=1e-4)
    random = np.random.default_rng(0)
    truth = random.uniform(60, 190, (256, 256, 3))
    noisy = [np.rint(truth + random.normal(0.0, 12.0, truth.shape)).astype(np.uint8) for _ in range(2)]
    denoised, first, second = (Shot(color, color / np.float32(255)) for color in (np.rint(truth + 4.0).astype(np.uint8), *noisy))
    assert pair(denoised, first).quality == pytest.approx(10 * np.log10(255**2 / (4.0**2 + 12.0**2)), abs=0.2)
    assert pair(denoised, first, second).quality == pytest.approx(10 * np.log10(255**2 / 4.0**2), abs=0.5)


def test_bounds_are_of_the_means():
    good, dark = pair(shot(100), shot(100)), pair(shot(98), shot(110))
    assert [row.holds for row in summarize_pairs([good, good])] == [True, True, True]
    assert [row.holds for row in summarize_pairs([dark, dark])] == [False, True, False]


@pytest.mark.slow
def test_a_report_of_a_sequence_compares_its_frames_with_references(tmp_path, capsys):
    """A bound of 35 dB does not hold for tiny images of few paths: exit code 1."""
    file = tmp_path / "numbers.json"
    options = ["--mode", "move", "--frames", "3,0", "--size", "32x18", "--samples", "4", "--json", str(file)]
    code = sequence.main([*options, *FEW_STEPS])
    rows = {row["name"]: row for row in json.loads(file.read_text())["rows"]}
    frames = [int(name.split(",")[0].removeprefix("frame ")) for name in rows if name.endswith("denoised against reference")]
    assert frames == [0, 3]
    mean = rows["denoised against reference, mean"]
    assert mean["value"] == pytest.approx(
        np.mean([row["value"] for name, row in rows.items() if name.endswith(": denoised against reference")])
    )
    assert (mean["holds"], code) == (mean["value"] >= 35.0, 1)
    capsys.readouterr()
    assert sequence.main(["--frames", "100000", "--mode", "move", "--size", "32x18", *FEW_STEPS, "--set", "move.speed=9"]) == 2
    assert "no episode has frame 100000" in capsys.readouterr().err


@pytest.mark.slow
def test_histories_bring_frames_nearer_to_the_reference():
    """With histories later frames have more paths than single frames have; references of few paths suffice, as their noise cancels."""
    fixed = {"cameras.resolution": [64, 36], "bake.mode": "move", "bake.episodes": 1, "bake.worlds": 1, "render.samples": 64}
    given = fixed | ONE_OBJECT | {"bake.device": "cpu"}
    quality = {}
    for history in (0, 16):
        config = load_config("synpick", given | {"render.history": history})
        ((_, found),) = sequence.compare_frames(config, (12,))
        quality[history] = found.quality
    assert quality[16] > quality[0]


# ---- photographs as a data set ----


MATRIX = [[200.0, 0.0, 31.5], [0.0, 200.0, 23.5], [0.0, 0.0, 1.0]]


@pytest.fixture
def frames(tmp_path, real_models):
    """A foam brick 0.5 m before the middle of a camera of 64 x 48 px, and a folder of its model."""
    folder, models = tmp_path / "frames", tmp_path / "models"
    folder.mkdir()
    models.mkdir()
    for name in ("models_info.json", "obj_000021.ply", "obj_000021.png"):
        shutil.copy(real_models / name, models)
    label = np.zeros((48, 64), np.uint8)
    label[10:38, 18:46] = 21
    cv2.imwrite(str(folder / "0003_000007-label.png"), label)
    cv2.imwrite(str(folder / "0003_000007-depth.png"), np.where(label, 4750, 0).astype(np.uint16))
    cv2.imwrite(str(folder / "0003_000007-color.png"), np.full((48, 64, 3), (10, 20, 30), np.uint8))
    pose = {"obj_id": 21, "R_model_to_camera": np.eye(3).tolist(), "t_bop_m": [0.0, 0.0, 0.5]}
    world = np.eye(4)[:3].tolist()
    content = {"sequence": "0003", "frame": "000007", "K": MATRIX, "world_to_camera": world, "objects": [pose]}
    (folder / "0003_000007-poses.json").write_text(json.dumps(content))
    return folder, models


def test_a_frame_is_read_in_our_coordinates(frames):
    (frame,) = read_frames(frames[0])
    assert frame.intrinsics[:2, 2].tolist() == [32.0, 24.0]
    assert frame.translations.tolist() == [[0.0, 0.0, 500.0]]
    assert frame.color[0, 0].tolist() == [30, 20, 10]
    assert frame.mask(0).sum() == 28 * 28


def test_the_data_set_has_bops_files(frames, tmp_path):
    out = write_data_set(*frames, tmp_path / "out")
    scene = out / "test" / "000003"
    truth = json.loads((scene / "scene_gt.json").read_text())["7"][0]
    assert (truth["obj_id"], truth["instance_id"], truth["cam_t_m2c"]) == (21, 0, [0.0, 0.0, 500.0])
    silhouette = cv2.imread(str(scene / "mask" / "000007_000000.png"), cv2.IMREAD_UNCHANGED) > 0
    rows, columns = np.nonzero(silhouette)
    # 51 x 77 x 52 mm about the middle of the picture; the near faces are 26 mm nearer.
    assert abs(rows.mean() - 23.5) <= 0.5
    assert abs(columns.mean() - 31.5) <= 0.5
    assert {path.name for path in (out / "models").iterdir()} == {"models_info.json", "obj_000021.ply", "obj_000021.png"}
    info = json.loads((scene / "scene_gt_info.json").read_text())["7"][0]
    assert (info["px_count_all"], info["px_count_visib"]) == (silhouette.sum(), 28 * 28)


def test_bad_folders_are_one_line(frames, tmp_path):
    folder, models = frames
    (tmp_path / "there").mkdir()
    assert "has no frames" in refusal(write_data_set, tmp_path, models, tmp_path / "a")
    assert "exists; name a new folder" in refusal(write_data_set, folder, models, tmp_path / "there")
    assert str(tmp_path) in refusal(write_data_set, folder, tmp_path, tmp_path / "b")
    (folder / "0003_000007-depth.png").unlink()
    assert "0003_000007-depth.png" in refusal(read_frames, folder)
