"""Static check of device code: accepts correct code, and finds each type of fault."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.checks.kernels import main

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
