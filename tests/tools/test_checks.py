"""Consistency of data sets and the static check of device code: both pass what is correct, and find each type of damage or fault;
figures: runs as JSON, the newest of each stage, and READMEs whose tables follow from them; the table of clients: readers that agree,
that disagree, that fail, that are not there (pycocotools alone, as everyone has it)."""

import json
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import trimesh

from synpick_warp.exporters.bop.scene_exporter import BopExporter
from synpick_warp.testing.box_views import cameras, config
from synpick_warp.testing.exporters import export
from tests.validation.faults import GT, INFO, moved, pixels, whole
from tools import docs, figures
from tools.checks import dataset as tool
from tools.checks.kernels import main
from tools.clients import __main__ as clients
from tools.clients import base, environments
from tools.clients.base import NOT_INSTALLED
from tools.clients.reader import CLIENTS
from tools.clients.trajectories import tone_map
from tools.options import MeasuredRow

CAMERAS = cameras(240, 180)


@pytest.fixture(scope="module")
def baked(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("check") / "set"
    settings = config()
    return export(BopExporter, out, replace(settings, bop=replace(settings.bop, split="train")), (0,), 0, 2, CAMERAS)


@pytest.fixture
def dataset(baked, tmp_path) -> Path:
    tool.read_json.cache_clear()
    tool.read_model.cache_clear()
    return Path(shutil.copytree(baked, tmp_path / "set"))


def violated(dataset: Path) -> set[str]:
    """Names of the measures that exceed their bound."""
    return {name for name, measure in vars(tool.check(dataset, 6)).items() if not measure.holds}


def negate_rotation(content: dict) -> None:
    content["0"][0]["cam_R_m2c"] = [-value for value in content["0"][0]["cam_R_m2c"]]


def blot(image: np.ndarray) -> np.ndarray:
    image[60:90, 100:130] = 255
    return image


def scale_models(folder: Path) -> None:
    for path in (folder / "models").glob("*.ply"):
        mesh = trimesh.load(path, process=False)
        mesh.apply_scale(0.97)
        mesh.export(path)


def test_a_correct_data_set_passes(dataset):
    assert violated(dataset) == set()


DEPTH = pixels("depth/*.png", lambda image: image + np.uint16(4))


@pytest.mark.parametrize(
    ("damage", "measures"),
    [
        (DEPTH, {"depth"}),
        (pixels("depth/*.png", lambda image: image - np.uint16(4)), {"depth", "visible"}),
        (pixels("depth/*.png", lambda image: 0 * image), {"unknown"}),
        (pixels("mask*/*_000001.png", lambda image: np.roll(image, 1, axis=1)), {"mask", "visible"}),
        (pixels("mask_visib/*.png", blot), {"visible"}),
        (moved(INFO, "0", 1, "px_count_all", 20), {"count_all"}),
        (moved(INFO, "0", 1, "bbox_obj", [2, 0, 0, 0]), {"box_amodal"}),
        (whole(GT, negate_rotation), {"rotation"}),
        (scale_models, {"depth", "mask", "visible", "count_all", "box_amodal"}),
    ],
)
def test_each_type_of_damage_is_found(dataset, damage, measures):
    damage(dataset)
    assert measures <= violated(dataset)


def test_a_pose_error_of_one_and_a_half_micrometres_in_one_camera_is_found(dataset):
    moved(GT, "0", 1, "cam_t_m2c", [0.0, 0.0, 1.5e-3])(dataset)
    assert violated(dataset) == {"world"}


def test_exit_codes(dataset, tmp_path, monkeypatch, capsys):
    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["dataset", *map(str, arguments)])
        return tool.main(), *capsys.readouterr()

    code, out, err = run(dataset, "--views", 2)
    assert (code, err) == (0, "")
    assert "VIOLATED" not in out
    DEPTH(dataset)
    code, out, _ = run(dataset, "--views", 6)
    assert code == 1
    assert "depth against models, inside" in {line.split("  ")[0] for line in out.splitlines() if "VIOLATED" in line}
    assert run(tmp_path / "none") == (2, "", f"dataset: {tmp_path / 'none'} has no scene\n")


def test_ray_casting_hits_a_known_triangle():
    """A triangle across the optical axis, tilted: depth 1000 + x at the point (x, y)."""
    corners = np.array([[[-100.0, -100, 900], [100, -100, 1100], [0, 100, 1000]]])
    hit = tool.cast_rays(corners, np.array([[100.0, 0, 20], [0, 100, 15], [0, 0, 1]]), 30, 40).crop(30, 40)
    rows, columns = np.nonzero(np.isfinite(hit))
    slope = (columns + 0.5 - 20) / 100
    np.testing.assert_allclose(hit[rows, columns], 1000 / (1 - slope), rtol=1e-12)
    assert len(rows) == pytest.approx(200, abs=12)  # Half of 200 x 200 mm at a metre, 100 px/m/m.


def test_silhouettes_extend_beyond_the_image():
    corners = np.array([[[-400.0, -100, 1000], [0, -100, 1000], [-400, 300, 1000]], [[0, -100, 1000], [0, 300, 1000], [-400, 300, 1000]]])
    hit = tool.cast_rays(corners, np.array([[100.0, 0, 20], [0, 100, 15], [0, 0, 1]]), 30, 40)
    assert hit.box() == [-20, 5, 39, 39]
    assert np.isfinite(hit.depth).all()
    assert np.isfinite(hit.crop(30, 40)).sum() == 20 * 25


# ---- device code ----


GOOD = '''"""Adds."""

import warp as wp

from synpick_warp.kernels.other import helper

wp.set_module_options({"enable_backward": False})


@wp.func
def put(target: wp.array[float], index: int, value: float):
    target[index] = value


@wp.func
def put_twice(target: wp.array[float], index: int, value: float):
    put(target, index, value)


@wp.kernel
def add_kernel(
    # Scene:
    scale: float,
    # State:
    speed: wp.array[float],  # (body) [m/s]
    place_inout: wp.array[float],  # (body)
    # In:
    offset: wp.vec3,
    # Out:
    sum_out: wp.array[float],  # (body)
    total_out: wp.array2d[float],  # (world, body)
    fields_out: Fields,
):
    """x += v."""
    i = wp.tid()
    local = wp.vec3()
    local[0] = speed[i] * scale
    place_inout[i] += local[0] + offset[0]
    put_twice(sum_out, i, 1.0)
    wp.atomic_add(total_out, 0, 0, 1.0)
    helper(fields_out)
'''


def check(tmp_path: Path, capsys, kernels: str, stage: str = "", elsewhere: str = "") -> list[str]:
    """Write a source tree, check it, and return its faults as "line: rule"."""
    for folder, text in (("kernels", kernels), ("stages", stage), ("scenes", elsewhere)):
        (tmp_path / "synpick_warp" / folder).mkdir(parents=True)
        (tmp_path / "synpick_warp" / folder / "add.py").write_text(text)
    code = main(tmp_path)
    lines = capsys.readouterr().out.splitlines()
    assert code == (1 if lines else 0)
    return [line.split("add.py:")[1] for line in lines]


def test_correct_code_passes(tmp_path, capsys):
    assert check(tmp_path, capsys, GOOD, stage="wp.launch(add_kernel, dim=1)") == []


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ('"""Adds."""\n', "\n", "1: a kernel module needs a docstring"),
        ('{"enable_backward": False}', '{"enable_backward": True}', '1: missing: wp.set_module_options({"enable_backward": False})'),
        ("import warp as wp\n", "from __future__ import annotations\nimport warp as wp\n", "3: Warp reads annotations: "),
        ("import warp as wp\n", "import numpy as np\n", "3: kernels import Warp, codes and other kernels only, not numpy"),
        ("synpick_warp.kernels.other", "synpick_warp.scenes.other", "5: kernels import Warp, codes and other kernels only, not "),
        ("add_kernel(", "add(", "21: the kernel add must end in _kernel"),
        ("def put_twice(", "def put_kernel(", "16: put_kernel is not a kernel"),
        ('    """x += v."""\n', "", "21: add_kernel needs a docstring"),
        ("    scale: float,\n", "    scale,\n", "23: scale needs an annotation"),
        ("    fields_out: Fields,\n", "    fields_out: Fields = None,\n", "21: add_kernel can only have plain parameters without defaults"),
        ("    scale: float,\n", "    scale: float,\n" * 11, "21: add_kernel has 17 parameters; at most 16"),
        ("place_inout", "place", "26: add_kernel writes to place; its name must end in _out or _inout"),
        ("place_inout[i] +=", "local[1] =", "26: add_kernel never writes to place_inout"),
        ("total_out", "total", "31: add_kernel writes to total; its name must end in _out or _inout"),
        ("sum_out", "sum", "30: add_kernel writes to sum; its name must end in _out or _inout"),
        ("    # Scene:\n", "", "22: scale has no group; put it below a comment"),
        ("    # In:\n", "    # Scene:\n", "27: groups come once, in the order Scene, State, In, Out"),
        ("    # Out:\n", "", "29: sum_out is in the group # In:; names ending in _out, and no others, belong to the group # Out:"),
        ("    # In:\n    offset: wp.vec3,\n    # Out:\n", "    # Out:\n    offset: wp.vec3,\n", "28: offset is in the group # Out:; "),
        ("  # (body) [m/s]", "", "25: add_kernel: speed needs a comment with the names of its 1 dimensions"),
        ("(world, body)", "(body)", "31: add_kernel: total_out has 2 dimensions, its comment names (body)"),
    ],
)
def test_each_fault_is_found(tmp_path, capsys, old, new, fault):
    assert old in GOOD
    assert any(line.startswith(fault) for line in check(tmp_path, capsys, GOOD.replace(old, new)))


INPUTS = "[scale, state.speed, state.place, wp.vec3(offset)]"
OUTPUTS = "[self.out.sum, total, buffers['fields']]"


@pytest.mark.parametrize(
    ("body", "faults"),
    [
        (f"wp.launch(add_kernel, dim=1, inputs={INPUTS}, outputs={OUTPUTS})", []),
        (f"inputs = [scale, speed, place]; inputs += [offset]\n    launch_pixels(add_kernel, 9, inputs, {OUTPUTS}, device)", []),
        (f"some = [state.speed, state.place]\n    launch_pixels(add_kernel, 9, [scale, *some, offset], {OUTPUTS}, device)", []),
        (
            f"wp.launch(add_kernel, dim=1, inputs=[scale, place, speed, offset], outputs={OUTPUTS})",
            ["2: add_kernel takes speed where place is given; place belongs elsewhere", "2: add_kernel takes place where speed is given; "],
        ),
        (f"wp.launch(add_kernel, dim=1, inputs=[scale, speed], outputs={OUTPUTS})", ["2: add_kernel takes 7 arguments, not 5"]),
        (f"inputs = [*inputs, offset]\n    launch_pixels(add_kernel, 9, inputs, {OUTPUTS}, device)", []),
        (f"a = [scale, speed]; a = [*a, place]; a = [*a, offset]\n    launch_pixels(add_kernel, 9, a, {OUTPUTS}, device)", []),
        (f"a = [scale]; a = [*a, *a]\n    launch_pixels(add_kernel, 9, a, {OUTPUTS}, device)", ["3: add_kernel takes 7 arguments, not 5"]),
        (f"a = [*b, scale]; b = [*a]; a = [*b]\n    launch_pixels(add_kernel, 9, a, {OUTPUTS}, device)", []),
        ("self._launch(add_kernel, [offset], [total, fields, sum])", ["2: add_kernel takes sum where total is given; total belongs"]),
    ],
)
def test_swapped_and_missing_arguments_are_found(tmp_path, capsys, body, faults):
    lines = check(tmp_path, capsys, GOOD, stage=f"def run():\n    {body}\n")
    assert len(lines) >= len(faults)
    assert (lines == []) == (faults == [])
    assert all(any(line.startswith(fault) for line in lines) for fault in faults)


@pytest.mark.parametrize("call", ["wp.launch(add_kernel, dim=1)", "wp.launch_tiled(add_kernel, dim=[1])", "warp.launch(add_kernel, dim=1)"])
def test_launches_outside_the_stages_are_found(tmp_path, capsys, call):
    assert check(tmp_path, capsys, GOOD, elsewhere=f"\n{call}\n") == [
        "2: kernels are launched in synpick_warp/stages and synpick_warp/newton_patches only"
    ]


# ---- figures ----


RUN = {"stage": "pictures", "date": "2030-01-02", "card": "H100", "commit": None, "command": "c", "limit": "rays", "rows": []}


def run(**changes) -> figures.Run:
    """A run of one value."""
    row = {"name": "views", "value": 1234.5, "unit": "1/s"}
    return msgspec.convert(RUN | {"rows": [row]} | changes, type=figures.Run)


@pytest.mark.parametrize("path", docs.REFERENCES, ids=lambda path: path.relative_to(docs.ROOT).as_posix())
def test_generated_documents_are_up_to_date(path):
    assert path.read_text(encoding="utf-8") == docs.REFERENCES[path](), "run python -m tools.docs"


def test_the_readme_of_the_tools_is_short():
    assert len(docs.FIGURES.read_text(encoding="utf-8").splitlines()) <= 150


def test_every_published_run_says_what_when_how_and_why():
    tables = set(re.findall(r"<!-- results: (\w+) -->", docs.FIGURES.read_text(encoding="utf-8")))
    tables |= {"sensor", "photographs", "store", "episodes"}  # Of other pages.
    runs = figures.read_runs()
    assert runs
    for name, each in runs.items():
        assert name.partition("_")[0] in tables, name
        assert all((each.stage, each.command, each.limit, each.rows)), name
        assert each.date is None or re.fullmatch(r"20\d\d-\d\d-\d\d", each.date), name
        assert set(each.shown) <= {row.name for row in each.rows}, name
        assert "/" not in each.command.replace("://", ""), f"{name} names a folder"


@pytest.mark.parametrize("fault", [{"unit": 3}, {"rows": [{"name": "views"}]}, {"rows": [{"name": "a", "value": "fast"}]}, {"date": 3}])
def test_a_file_that_is_no_run_is_refused(tmp_path, fault):
    (tmp_path / "speed_x.json").write_bytes(msgspec.json.encode(RUN | fault))
    with pytest.raises(msgspec.ValidationError):
        figures.read_runs(tmp_path)


def test_the_newest_run_of_a_stage_is_shown():
    undated = {"speed_c.json": run(date=None)}
    runs = {"speed_a.json": run(), "speed_b.json": run(date="2030-01-03", card="H200")} | undated
    assert list(figures.newest_runs(runs)) == ["speed_b.json"]
    assert figures.newest_runs(undated) == undated


def test_a_table_has_values_with_units_and_numbered_conditions():
    rows = [{"name": "views", "value": 1234.5, "unit": "1/s"}, {"name": "share", "value": 50, "unit": "%"}, {"name": "no", "value": 1}]
    noted = run(rows=rows, shown=["views", "share"], conditions="cold; alone", commit="abc")
    tables = figures.figures_tables(
        {"speed_a.json": noted, "speed_b.json": run(stage="other", conditions="alone"), "peers_a.json": run(stage="x")}
    )
    assert set(tables) == {"speed", "peers"}
    _, _, first, second, _, notes = tables["speed"].split("\n")
    assert first.startswith("| pictures | views **1,234.5/s**; share **50 %** | [H100, 2030-01-02](results/speed_a.json) (1, 2) |")
    assert first.endswith("| rays |")
    assert second.startswith("| other | views **1,234.5/s** | [H100, 2030-01-02](results/speed_b.json) (2) |")
    assert notes == "(1) cold; (2) alone."


def test_what_a_tool_writes_is_a_run(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["bench", "--models", str(tmp_path / "YCB"), "--seconds", "1"])
    machine = [("device", "cuda:0: NVIDIA H100"), ("CPU cores", "16")]
    rows = [MeasuredRow("views", 2.0, "1/s", part="pictures"), MeasuredRow("failed", float("nan"))]
    record = figures.describe_run("tools.bench", machine, rows, traces={"a": [1]})
    figures.write_run(tmp_path / "run.json", record)
    found = msgspec.json.decode((tmp_path / "run.json").read_bytes())
    assert found == record
    assert (found["command"], found["card"]) == ("python -m tools.bench --models YCB --seconds 1", "NVIDIA H100")
    assert [row["value"] for row in found["rows"]] == [2.0, None]
    assert msgspec.convert(found | {"rows": found["rows"][:1]}, type=figures.Run).more == {"traces": {"a": [1]}}
    figures.write_run(None, record)


# ---- clients ----

LENSES = cameras(160, 120)
FRAMES = 2


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = export(BopExporter, tmp_path_factory.mktemp("clients") / "set", config(), (0,), 0, FRAMES, LENSES)
    (folder / "episodes.jsonl").write_text(f'{{"episode": 0, "frames": {FRAMES}}}\n')
    return folder


@pytest.fixture
def opened(data, monkeypatch) -> dict[str, np.ndarray]:
    """The clients' data set, opened: masks with visible pixels of its first scene, which can be changed in memory."""
    scene, memory = base.first_scene(data), {}
    assert scene is not None
    for frame in range(FRAMES):
        files = sorted((scene / "mask_visib").glob(f"{frame:06d}_*"))
        masks = np.array([cv2.imread(str(path), cv2.IMREAD_UNCHANGED) > 0 for path in files])
        memory[f"visible_mask {frame}"] = masks[masks.any(axis=(1, 2))]
    monkeypatch.setattr(clients.synpick_warp, "open", lambda folder: {0: None})
    monkeypatch.setitem(CLIENTS, "coco", replace(CLIENTS["coco"], expect=lambda data_set: memory))
    return memory


def test_a_client_that_agrees_and_one_that_disagrees(data, opened, tmp_path, capsys):
    assert clients.main([str(data), "--clients", "coco,xarray_store", "--json", str(tmp_path / "table.json")]) == 0
    first, second = json.loads((tmp_path / "table.json").read_text())["more"]["clients"]
    assert first["version"].startswith("pycocotools 2")
    assert first["agreement"] == f"{FRAMES} values equal"
    assert second["agreement"] == clients.NO_FORMAT
    assert "pycocotools" in capsys.readouterr().out
    opened["visible_mask 1"] = ~opened["visible_mask 1"]
    assert clients.main([str(data), "--clients", "coco"]) == 1
    assert "DIFFERS" in capsys.readouterr().out


def test_a_client_that_fails(tmp_path):
    broken = tmp_path / "train_pbr" / "000000"
    broken.mkdir(parents=True)
    (broken / "scene_camera.json").write_text("{}")
    (tmp_path / "episodes.jsonl").write_text('{"episode": 0, "frames": 1}\n')
    (broken / "scene_gt_coco.json").write_text("{")
    result = clients.run_client("coco", sys.executable, tmp_path, {}, "")
    assert (result.agreement, result.holds) == ("FAILED", False)
    assert result.remarks.startswith("json.decoder.JSONDecodeError")


@pytest.mark.parametrize("name", ["bop_toolkit", "coco"])
def test_a_client_that_is_not_installed_is_no_error(data, opened, name):
    python = sys.executable if name == "bop_toolkit" else str(data / "no-python")
    result = clients.run_client(name, python, data, {}, "")
    assert (result.agreement, result.holds) == (NOT_INSTALLED, True)


@pytest.mark.parametrize("arguments", [(), ("--python", "coco"), ("--python", "word=python3")])
def test_bad_input_is_one_line(tmp_path, capsys, arguments):
    assert clients.main([str(tmp_path), *arguments]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_values_are_compared_by_difference_and_pictures_by_psnr():
    ramp = np.linspace(0.0, 1.0, 300).reshape(10, 10, 3)
    assert clients.difference(np.array([1.0, np.nan]), np.array([1.5, np.nan])) == 0.5
    assert clients.difference(np.array([1.0, np.nan]), np.array([1.0, 2.0])) == np.inf
    assert clients.difference(ramp, ramp[1:]) == np.inf
    assert clients.psnr(ramp, ramp + 0.1) == pytest.approx(20.0)
    assert clients.compare(CLIENTS["coco"], {"picture 0": ramp + 0.1}, {"picture 0": ramp}) == ("DIFFERS: picture 0", False)
    assert clients.compare(CLIENTS["coco"], {"a": ramp}, {"b": ramp})[1] is False


def test_blenders_light_goes_through_our_tone_curve():
    """Linear to sRGB up to 0.6; continuous there; below 1 for any light."""
    developed = tone_map(np.array([0.0, 0.18, 0.6, 0.6001, 100.0]))
    np.testing.assert_allclose(developed[:4], [0.0, 0.4614, 0.7977, 0.7978], atol=1e-4)
    assert 0.99 < developed[4] <= 1.0


@pytest.mark.parametrize(("count", "frames"), [(1, [0]), (2, [0, 1]), (221, [0, 110, 220])])
def test_sampled_frames_are_spread_evenly(count, frames):
    assert base.sample_frames(count) == frames


# ---- libraries of reinforcement learning ----


def test_the_table_of_libraries(tmp_path, monkeypatch, capsys):
    """Of one that runs, one that fails and one that is not there; the others are not installed."""
    answers = {
        "gymnasium": "print('gymnasium 1.4.0', '16 steps', sep=chr(9))",
        "skrl": "raise ValueError('spaces differ')",
        "torchrl": "import no_such_library",
    }
    for name, text in answers.items():
        (tmp_path / name).write_text(f"#!{sys.executable}\n{text}\n")
        (tmp_path / name).chmod(0o755)
    given = [f"--python={name}={tmp_path / name}" for name in ("all", *answers)]
    assert environments.main([*given, "--json", str(tmp_path / "table.json")]) == 1
    rows = {row["client"]: row for row in json.loads((tmp_path / "table.json").read_text())["more"]["clients"]}
    assert (rows["gymnasium"]["version"], rows["gymnasium"]["remarks"]) == ("gymnasium 1.4.0", "16 steps")
    assert (rows["skrl"]["agreement"], rows["skrl"]["remarks"]) == ("FAILED", "ValueError: spaces differ")
    missing = [name for name, row in rows.items() if row["agreement"] == NOT_INSTALLED]
    assert missing == ["statistics", "torchrl", "rsl_rl", "stable_baselines3"]
    assert "spaces differ" in capsys.readouterr().out
    assert environments.main(["--python", "keras=python"]) == 2
