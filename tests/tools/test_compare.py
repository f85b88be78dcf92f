"""Comparisons: of data sets, by file and key, pixel, index or line in it; of outputs between devices; of two checkouts by the guard."""

import io
import json
import operator
import shutil
import tarfile
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import warp as wp
import zarr
from pxr import Usd, UsdGeom

import synpick_warp
from synpick_warp.configs.files.load import config_to_toml, load_config
from synpick_warp.configs.schema import FAST, LAYERS, REFERENCE, RENDER_MODES
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import Snapshot, ViewBuffers
from tests.builders import ONE_OBJECT, assignments
from tests.harness.environment import ROOT
from tools.compare import guard, kernel_sources, pictures
from tools.compare import runs as compared
from tools.compare.__main__ import main
from tools.compare.guard import SETS, Step, cpu_steps


@pytest.fixture
def runs(tmp_path) -> tuple[Path, Path]:
    """Two equal folders with a file of every type."""
    first, second = tmp_path / "a", tmp_path / "b"
    scene = first / "train" / "000004"
    (scene / "depth").mkdir(parents=True)
    (first / "usd").mkdir()
    (first / "manifest").mkdir()
    cv2.imwrite(str(scene / "depth" / "000002.png"), np.arange(48, dtype=np.uint16).reshape(6, 8))
    (scene / "scene_gt.json").write_text(json.dumps({"0": [{"obj_id": 3, "cam_t_m2c": [1.0, 2.0, 3.0]}]}))
    (first / "episodes.jsonl").write_text('{"frames": 7}\n{"frames": 8}\n')
    (first / "manifest" / "000001.sha256").write_text("00  a\n11  b\n")
    (first / "config.toml").write_text(config_to_toml(load_config("smoke", {})))
    array = zarr.create_array(str(first / "trajectory.zarr" / "episodes" / "000001" / "pose"), shape=(4, 3), dtype="f4", chunks=(4, 3))
    array[...] = np.arange(12).reshape(4, 3)
    with tarfile.open(first / "shard-000000.tar", "w") as file:
        add(file, "000001.gt.json", b"[1, 2]")
    stage = Usd.Stage.CreateNew(str(first / "usd" / "000001.usdc"))
    UsdGeom.Sphere.Define(stage, "/Ball").GetRadiusAttr().Set(2.0)
    stage.Save()
    shutil.copytree(first, second)
    return first, second


def add(file: tarfile.TarFile, name: str, data: bytes) -> None:
    member = tarfile.TarInfo(name)
    member.size = len(data)
    file.addfile(member, io.BytesIO(data))


def edit_image(path: Path) -> None:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    image[3, 5] += 4
    image[4, 1] += 9
    cv2.imwrite(str(path), image)


def edit_shard(path: Path) -> None:
    with tarfile.open(path, "w") as file:
        add(file, "000001.gt.json", b"[1, 4]")


def edit_usd(path: Path) -> None:
    stage = Usd.Stage.Open(str(path))
    UsdGeom.Sphere(stage.GetPrimAtPath("/Ball")).GetRadiusAttr().Set(3.0)
    stage.Save()


def text(old: str, new: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(path.read_text().replace(old, new))


IMAGE, STAGE, ARRAY = "train/000004/depth/000002.png", "usd/000001.usdc", "trajectory.zarr/episodes/000001/pose"
OTHER = {"bake.worlds": 9, "bake.seed": 5}
CASES = [
    (IMAGE, edit_image, ": [3, 5]: 29 and 33; 2 of 48 values, by up to 9", "train/*/depth/*.png", 9.0),
    ("train/000004/scene_gt.json", text("2.0", "2.5"), ": 0[0].cam_t_m2c[1]: 2.0 and 2.5", "train/*/scene_gt.json", 0.5),
    ("episodes.jsonl", text("8", "9"), ": [1].frames: 8 and 9", "episodes.jsonl", 1.0),
    ("manifest/000001.sha256", text("11", "12"), ": line 2: 11  b and 12  b", "manifest/*.sha256", None),
    (
        ARRAY,
        lambda path: operator.setitem(zarr.open_array(path, mode="r+"), (2, 1), 7.25),
        "/c/0/0: [2, 1]: 7.0 and 7.25; 1 of 12 values, by up to 0.25",
        "trajectory.zarr/episodes/*/pose/c/0",
        0.25,
    ),
    ("shard-000000.tar", edit_shard, ": 000001.gt.json[1]: 2 and 4", "shard-*.tar", 2.0),
    (STAGE, edit_usd, ": line 5: double radius = 2 and double radius = 3", "usd/*.usdc", None),
    ("config.toml", lambda path: path.write_text(config_to_toml(load_config("smoke", OTHER))), ": bake.seed: 0 and 5", "config.toml", 5.0),
]


def test_equal_folders(runs, capsys):
    assert compared.main([str(path) for path in runs]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "no difference"


@pytest.mark.parametrize(("name", "edit", "message", "layer", "largest"), CASES, ids=[name for name, *_ in CASES])
def test_the_first_difference_and_its_layer_are_reported(runs, capsys, name, edit, message, layer, largest):
    edit(runs[1] / name)
    assert compared.main([str(path) for path in runs]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == f"first difference: {name}{message}"
    (row,) = (line.split() for line in lines if line.startswith(layer + " "))
    assert row[1:] == ["1", "1", *(["not", "numeric"] if largest is None else [f"{largest:g}"])]
    assert sum(line.split()[2] == "1" for line in lines[1:-1]) == 1


def test_settings_are_compared_first(runs):
    for name, edit, *_ in CASES:
        edit(runs[1] / name)
    _, message = compared.compare(*runs)
    assert message == "config.toml: bake.seed: 0 and 5"


def test_settings_without_effect_on_files_are_ignored(runs):
    (runs[1] / "config.toml").write_text(config_to_toml(load_config("smoke", {"bake.worlds": 9, "bake.writers": 3})))
    assert compared.compare(*runs)[1] == ""


def test_missing_files_and_folders(runs, tmp_path, capsys):
    (runs[1] / IMAGE).unlink()
    assert compared.compare(*runs)[1] == compared.compare(*runs[::-1])[1] == f"{IMAGE}: only in {runs[0]}"
    (tmp_path / "empty").mkdir()
    for name in ("none", "empty"):
        assert compared.main([str(runs[0]), str(tmp_path / name)]) == 2
        assert name in capsys.readouterr().err


# ---- rendered outputs ----


def test_every_output_has_a_tolerance():
    arrays = {item.name for item in fields(ViewBuffers)}
    assert arrays - set(pictures.PACKED) | set(LAYERS) | {"masks"} == {*pictures.TOLERANCES, "color"}
    assert set(pictures.PACKED) < arrays
    assert set(pictures.COLORS) == set(RENDER_MODES)


OUTPUTS = {
    "color": np.full((1, 2, 5, 3), 7, np.uint8),
    "masks": np.zeros((1, 2, 5, 3), bool),
    "boxes": np.full((2, 3, 2, 4), -1, np.int32),
    "flow": np.full((1, 2, 5, 2), np.nan, np.float32),
}


@pytest.mark.parametrize(
    ("mode", "name", "changes", "expected"),
    [
        *((FAST, name, {}, (0.0, 0.0, 0.0, 0.0)) for name in OUTPUTS),
        # A pixel differs if one of its channels does; the second by no more than the tolerance.
        (FAST, "color", {(0, 0, 0): (252, 7, 7), (0, 1, 4): (8, 9, 7)}, (20.0, 24.7, 245.0, 10.0)),
        (REFERENCE, "masks", {(0, 0, 0, 2): True}, (10.0, 0.1, 1.0, 10.0)),
        (FAST, "flow", {(0, 1, 2): 0.0}, (10.0, 0.0, np.inf, 10.0)),
        (FAST, "boxes", {(0, 0, 0, 0): 1}, (100 / 48, 2 / 48, 2.0, 100 / 48)),
    ],
)
def test_outputs_are_compared_by_pixels_or_values(mode, name, changes, expected):
    """Percentage of differing values, mean and maximum difference, and percentage beyond the tolerance; symmetric in both inputs."""
    a, b = OUTPUTS[name], OUTPUTS[name].copy()
    for index, value in changes.items():
        b[index] = value
    for difference in (pictures.compare(mode, name, a, b), pictures.compare(mode, name, b, a)):
        found = difference.differing, difference.mean, difference.largest, difference.beyond
        assert found == pytest.approx(expected)
        assert difference.holds == (not changes)


def test_a_rounded_depth_may_be_one_count_off():
    a = np.zeros((1, 2, 5), np.uint16)
    assert pictures.compare(FAST, "depth", a, a + 1).holds
    assert not pictures.compare(FAST, "depth", a, a + 2).holds


@pytest.mark.slow
def test_a_device_equals_itself(tmp_path):
    file = tmp_path / "numbers.json"
    options = ["--devices", "cpu,cpu", "--scenes", "1", "--size", "16x9", "--samples", "2", "--json", str(file), *assignments(ONE_OBJECT)]
    assert pictures.main(options) == 0
    rows = json.loads(file.read_text())["rows"]
    assert {(row["mode"], row["output"]) for row in rows} == {
        (mode, name) for mode in RENDER_MODES for name in (*pictures.TOLERANCES, "color")
    }
    assert all(row["differing"] == 0.0 for row in rows)


def test_exceeded_tolerances_exit_with_1(monkeypatch, capsys):
    a = np.zeros((1, 2, 5), np.uint8)
    monkeypatch.setattr(pictures, "compare_devices", lambda *_: [pictures.compare(FAST, "instance", a, a + 1)])
    assert pictures.main(["--devices", "cpu,cpu"]) == 1
    assert "VIOLATED" in capsys.readouterr().out


def test_the_next_frame_displaces_objects_and_keeps_the_rest(device):
    snapshot = allocate(Snapshot, {"world": 1, "instance": 2, "fixture": 3}, device)
    snapshot.frame.fill_(7)
    snapshot.pose.fill_(wp.transform((1.0, 2.0, 3.0), wp.quat_identity()))
    after = pictures.next_frame(snapshot, 0.5)
    assert after.frame.numpy().tolist() == [8]
    assert after.follows.numpy().tolist() == [1]
    assert after.pose.numpy()[0, 1, :3].tolist() == [1.5, 2.0, 3.0]
    assert np.array_equal(after.last_pose.numpy(), snapshot.pose.numpy())
    assert snapshot.frame.numpy().tolist() == [7]


# ---- the guard of two checkouts ----


def test_the_order_of_overloads_does_not_matter_and_all_of_them_count():
    kinds = ("Sum_0123abcd", "Mean_4567ef01", "Peak_89abcdef")
    first, second, third = (f"CUDA_CALLABLE {kind} add(const {kind}& a) {{ return a; }}\n" for kind in kinds)
    one, other, more = (kernel_sources.split_definitions(text) for text in (first + second, second + first, first + second + third))
    assert one == other != more


@pytest.mark.parametrize(
    ("old", "new", "verdict", "detail"),
    [
        ({"a": ["x"]}, {"a": ["x"]}, "equal", "1 kernels"),
        ({"a": ["x"]}, {"b": ["x"]}, "equal", "1 kernels; a is now b"),
        ({"a": ["x"]}, {"a": ["y"]}, "different", "1 of 1 kernels; a: line 1: x | y"),
        ({"a": ["x"]}, {"a": ["x"], "b": ["y"]}, "different", "1 kernels; only new: b"),
        ({"a": ["x"], "b": ["y"]}, {"a": ["x"]}, "different", "2 kernels; only old: b"),
    ],
)
def test_kernels_are_compared_by_source(tmp_path, old, new, verdict, detail):
    files = [tmp_path / name for name in ("old.json", "new.json")]
    for file, content in zip(files, (old, new), strict=True):
        file.write_text(json.dumps(content))
    result = guard._compare_kernels("modules", *files)
    assert (result.verdict, result.detail) == (verdict, detail)


def sides(tmp_path: Path) -> list[guard.Side]:
    """Two checkouts, old and new."""
    found = [guard.Side(ROOT, tmp_path / name) for name in ("old", "new")]
    for side in found:
        (side.folder / "text").mkdir(parents=True)
    return found


@pytest.mark.parametrize(
    ("old", "new", "verdict"),
    [
        ("3 views in 0:03 (15.6 views/s)", "3 views in 0:12 (3.1 views/s)", "equal"),
        ("   0:05  views 3\n3 views", "   0:06  views 1\n   0:07  views 2\n3 views", "equal"),
        ("3 poses in 4.1 s (2 poses/s, waiting 2%)", "3 poses in 1.4 s (3 poses/s, waiting 3%)", "equal"),
        ("3 poses in 4.1 s", "4 poses in 4.1 s", "different"),
        ("3 views; peak memory 277 MiB", "3 views; peak memory 1,278 MiB", "equal"),
        ('"seconds_per_image": 0.25', '"seconds_per_image": 1.5e-05', "equal"),
        ("3 views", "4 views", "different"),
        ("3 views", "3 views\n1 warning", "different"),
    ],
)
def test_texts_are_compared_without_times_and_progress(tmp_path, old, new, verdict):
    step = Step("verify picks", ("verify", "picks"))
    for side, text in zip(both := sides(tmp_path), (old, new), strict=True):
        side.text_file(step).write_text(f"exit code 0\n{side.folder}/picks\n{text}\n")
    (result,) = guard._compare_step(*both, step, ("commands",))
    assert result.verdict == verdict
    for side in both:  # A command that fails in both is not equal.
        side.text_file(step).write_text("exit code 2\nsynpick-warp: error: no\n")
    (result,) = guard._compare_step(*both, step, ("commands",))
    assert (result.verdict, result.detail) == ("failed", "old: exit code 2: synpick-warp: error: no")


@pytest.mark.parametrize(
    ("name", "old", "new", "verdict"),
    [
        ("single.csv", "image,score,time\n1,2.5,0.1\n", "image,score,time\n1,2.5,0.2\n", "equal"),
        ("single.csv", "image,score,time\n1,2.5,0.1\n", "image,score,time\n1,2.6,0.1\n", "different"),
        ("report.html", f"baked by {synpick_warp.__version__}", f"baked by {synpick_warp.__version__}", "equal"),
        ("sheet.png", "a", "b", "different"),
    ],
)
def test_files_are_compared_without_times(tmp_path, name, old, new, verdict):
    for side, content in zip(both := sides(tmp_path), (old, new), strict=True):
        (side.folder / name).write_text(content)
    assert guard._compare_output("commands", *both, name).verdict == verdict


@pytest.mark.parametrize("digests", [("a", "a"), ("a", "b")])
def test_all_worlds_of_both_checkouts_have_one_digest(tmp_path, monkeypatch, digests):
    options = SimpleNamespace(device="cuda:0", models="", lights="")
    monkeypatch.setattr(guard, "_run", lambda *_: "")
    monkeypatch.setattr(guard, "digest_folder", lambda folder: digests[folder.parent.name == "new"])
    results = list(guard.compare_worlds(*sides(tmp_path), options))
    assert len(results) >= 2 * len(guard.WORLDS)
    assert [line.verdict for line in results if line.name.startswith("old")] == ["equal"] * (len(results) // 2)
    assert {line.verdict for line in results if line.name.startswith("new")} == {"equal" if digests[0] == digests[1] else "different"}


@pytest.mark.parametrize(("rates", "verdict"), [((1000.0, 995.0), "equal"), ((1000.0, 985.0), "different"), ((1000.0, 1100.0), "equal")])
def test_pictures_may_be_one_percent_slower(tmp_path, monkeypatch, rates, verdict):
    def measure(side: guard.Side, command: tuple[str, ...]) -> str:
        rows = [{"name": "all stages: views, median of 5 passes", "unit": "1/s", "value": rates[side.folder.name == "new"]}]
        (side.folder / command[-1]).write_text(json.dumps({"rows": rows}))
        return ""

    monkeypatch.setattr(guard, "_run", measure)
    (line,) = guard.compare_pictures(*sides(tmp_path), SimpleNamespace(device="cuda:0", models="", lights=""))
    assert line.verdict == verdict
    assert line.detail.startswith("1000.0 and")


def test_each_set_is_verified_and_every_format_and_layer_is_in_one():
    names = [step.name for step in cpu_steps(guard.CPU_PARTS)]
    assert len(SETS) == 6
    assert {f"{command} {name}" for name in SETS for command in ("bake", "verify", "validate", "stats")} <= set(names)
    assert len(set(names)) == len(names)


def test_digests_leave_out_worlds_and_version(tmp_path):
    for name, settings in (("a", "worlds = 8"), ("b", "worlds = 512")):
        (tmp_path / name / "train").mkdir(parents=True)
        (tmp_path / name / "config.toml").write_text(settings)
        (tmp_path / name / "train" / "scene_gt.json").write_text("{}")
    assert guard.digest_folder(tmp_path / "a") == guard.digest_folder(tmp_path / "b")
    (tmp_path / "b" / "train" / "scene_gt.json").write_text("[]")
    assert guard.digest_folder(tmp_path / "a") != guard.digest_folder(tmp_path / "b")


RANDOM = """
import warp as wp

UNIT = wp.constant({unit})


@wp.func
def {function}(key: int) -> float:
    return float(key) * UNIT
"""
KERNEL = """
import warp as wp

from synpick_warp.kernels.{room}.random import {function}


@wp.kernel
def draw_kernel(
    values_out: wp.array[float],  # (world)
):
    world = wp.tid()
    values_out[world] = {function}(world)
"""


def make_checkout(folder: Path, unit: str = "0.5", function: str = "uniform", room: str = "sim") -> Path:
    """A package with one kernel, which calls a function of another module."""
    package = folder / "synpick_warp"
    files = {f"kernels/{room}/random.py": RANDOM.format(unit=unit, function=function)}
    files[f"kernels/{room}/draw.py"] = KERNEL.format(room=room, function=function)
    for name, text in files.items() | {(f"{place}__init__.py", "") for place in ("", "kernels/", f"kernels/{room}/", "stages/")}:
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(text)
    return folder


def test_the_source_of_kernels_may_move_but_not_change(tmp_path, capsys):
    """Generated by two checkouts of one kernel each: a function that is called otherwise, lies elsewhere, or computes something else."""
    old, moved = make_checkout(tmp_path / "old"), make_checkout(tmp_path / "moved", function="draw_uniform", room="solver")
    changed = make_checkout(tmp_path / "changed", unit="0.25")
    work = ("--parts", "kernels", "--work", str(tmp_path / "work"))
    assert main(["guard", str(old), str(moved), *work]) == 0
    assert capsys.readouterr().out.startswith("equal      kernels: modules: 1 kernels\n1 of 1 equal")
    assert main(["guard", str(old), str(changed), *work]) == 1
    assert "different  kernels: modules: 1 of 1 kernels; draw_kernel: line" in capsys.readouterr().out
