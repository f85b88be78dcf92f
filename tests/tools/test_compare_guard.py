"""The guard of two checkouts: texts, files and kernels that differ are found, and what may differ is not."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

import synpick_warp
from tests.harness.environment import ROOT
from tools.compare import guard, guard_device, kernel_sources
from tools.compare.__main__ import main
from tools.compare.guard_steps import SETS, Step, cpu_steps

SOURCE = """
// scale: a comment
#define float(x) cast_float(x)
static CUDA_CALLABLE wp::float32 {scale}_0(
    wp::float32 var_{factor})
{{
    if (true) {{ var_1 = wp::mul(var_{factor}, {two}); }}
    return var_1;
}}
extern "C" __global__ void WP_MAXNREG(64) {kernel}_0123abcd_cuda_kernel_forward(
    wp::launch_bounds_t<1> dim)
{{
    var_2 = {scale}_0(var_0);  // x = scale(y)  <L 7>
}}
"""
NAMES = {"scale": "scale", "factor": "factor", "two": "2.0", "kernel": "scale_kernel"}


def canonical(**changes: str) -> str:
    definitions = kernel_sources.split_definitions(SOURCE.format_map(NAMES | changes))
    (kernel,) = (name for name in definitions if name.endswith("_forward"))
    return kernel_sources.canonical(kernel, definitions)


def test_names_do_not_matter_to_a_kernels_source():
    assert canonical() == canonical(scale="enlarge", factor="gain", kernel="enlarge_kernel")
    assert "// " not in canonical()


def test_the_order_of_overloads_does_not_matter_and_all_of_them_count():
    kinds = ("Sum_0123abcd", "Mean_4567ef01", "Peak_89abcdef")
    first, second, third = (f"CUDA_CALLABLE {kind} add(const {kind}& a) {{ return a; }}\n" for kind in kinds)
    one, other, more = (kernel_sources.split_definitions(text) for text in (first + second, second + first, first + second + third))
    assert one == other != more


def test_values_matter_also_in_functions_that_a_kernel_calls():
    assert kernel_sources.first_difference([canonical()], [canonical(two="3.0")]).endswith(
        "wp::mul(p0, 2.0); } | if (true) { var_1 = wp::mul(p0, 3.0); }"
    )


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
    line = guard._compare_kernels("modules", *files)
    assert (line.verdict, line.detail) == (verdict, detail)


def sides(tmp_path: Path) -> list[guard.Side]:
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
    (line,) = guard._compare_step(*both, step, ("commands",))
    assert line.verdict == verdict


def test_a_command_that_fails_in_both_is_not_equal(tmp_path):
    step = Step("verify picks", ("verify", "picks"))
    for side in (both := sides(tmp_path)):
        side.text_file(step).write_text("exit code 2\nsynpick-warp: error: no\n")
    (line,) = guard._compare_step(*both, step, ("commands",))
    assert (line.verdict, line.detail) == ("failed", "old: exit code 2: synpick-warp: error: no")


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
    monkeypatch.setattr(guard_device, "_run", lambda *_: "")
    monkeypatch.setattr(guard_device, "digest_folder", lambda folder: digests[folder.parent.name == "new"])
    results = list(guard_device.compare_worlds(*sides(tmp_path), options))
    assert len(results) >= 2 * len(guard_device.WORLDS)
    assert [verdict for title, verdict, _ in results if title.startswith("old")] == ["equal"] * (len(results) // 2)
    assert {verdict for title, verdict, _ in results if title.startswith("new")} == {"equal" if digests[0] == digests[1] else "different"}


@pytest.mark.parametrize(("rates", "verdict"), [((1000.0, 995.0), "equal"), ((1000.0, 985.0), "different"), ((1000.0, 1100.0), "equal")])
def test_pictures_may_be_one_percent_slower(tmp_path, monkeypatch, rates, verdict):
    def measure(side: guard.Side, command: tuple[str, ...]) -> str:
        rows = [{"name": "all stages: views, median of 5 passes", "unit": "1/s", "value": rates[side.folder.name == "new"]}]
        (side.folder / command[-1]).write_text(json.dumps({"rows": rows}))
        return ""

    monkeypatch.setattr(guard_device, "_run", measure)
    ((_, found, detail),) = guard_device.compare_pictures(*sides(tmp_path), SimpleNamespace(device="cuda:0", models="", lights=""))
    assert found == verdict
    assert detail.startswith("1000.0 and")


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
    assert guard_device.digest_folder(tmp_path / "a") == guard_device.digest_folder(tmp_path / "b")
    (tmp_path / "b" / "train" / "scene_gt.json").write_text("[]")
    assert guard_device.digest_folder(tmp_path / "a") != guard_device.digest_folder(tmp_path / "b")


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


def test_a_folder_without_the_package_is_an_error(tmp_path, capsys):
    assert main(["guard", str(ROOT), str(tmp_path)]) == 2
    assert "is no checkout" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [[], ["dance"]])
def test_unknown_comparisons_are_one_line(arguments, capsys):
    assert main(arguments) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
