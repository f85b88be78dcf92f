"""Rows of picks for tests/test_cases.py: tables that replace a data set's own are refused in one line, by every command that reads them;
parts that suction does not hold are not held in a new cell.
"""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

from synpick_warp.configs.cell.gripper import describe_forces
from synpick_warp.configs.files.load import load_config
from synpick_warp.exporters.picks import pick_files
from tests.builders import mistake, run
from tests.worlds.box_sets import write_pick_set


def _is_refused(column: str, value: str, path: Path, out: Path) -> None:
    """The line names table, column, row and value."""
    place = pick_files(0)[path.name.startswith("states")]
    shutil.copyfile(path, write_pick_set(out / "set") / place)
    for command in (("explain", "--state=0"), ("preview", "--picks")):
        said = mistake(command[0], out / "set", command[1], f"--out={out / 'picture.png'}")
        assert said.startswith(f"{out / 'set' / place}, column {column}, row 0 is {value}; allowed: ")
    assert [path.name for path in out.iterdir()] == ["set"]


def _has_physics(parts: Path, out: Path) -> None:
    """Break forces follow from the vacuum, as `tests/sim/test_vacuum.py` measures on these parts; a bake without one tells its forces."""
    assert run("new-cell", out / "cell", "--part", parts, "--unit", "mm").code == 0
    cell = load_config(str(out / "cell/cell.toml"), {"gripper.cup_width": 0.022})
    found = cell.suction.vacuum, cell.suction.surface, cell.suction.radius, round(cell.suction.good_force, 1)
    assert found == (60.0, "mesh", 0.011, 22.8)
    line = describe_forces(cell.gripper, load_config("smoke").suction)
    assert line.startswith("suction: a seal breaks at 40 or 2 N, as in the paper, whatever cup")
    assert "(full vacuum below this cup: 38.5 N)" in line


ROWS = {
    f"picks/{name}.parquet": partial(_is_refused, *said)
    for name, said in {
        "states_frame_2147483647": ("frame", "2147483647"),
        "trials_outcome_255": ("outcome", "255"),
        "trials_point_floatnan": ("point", "[nan, nan, nan]"),
        "trials_state_-1": ("state", "-1"),
    }.items()
} | {"parts/suction_default_porous": _has_physics}
