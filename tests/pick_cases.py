"""Rows of picks for tests/test_cases.py: tables that replace a data set's own are refused in one line, by every command that reads them."""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

from synpick_warp.exporters.picks import pick_files
from tests.builders import mistake
from tests.worlds.box_sets import write_pick_set


def _is_refused(column: str, value: str, path: Path, out: Path) -> None:
    """The line names table, column, row and value."""
    place = pick_files(0)[path.name.startswith("states")]
    shutil.copyfile(path, write_pick_set(out / "set") / place)
    for command in (("explain", "--state=0"), ("preview", "--picks")):
        said = mistake(command[0], out / "set", command[1], f"--out={out / 'picture.png'}")
        assert said.startswith(f"{out / 'set' / place}, column {column}, row 0 is {value}; allowed: ")
    assert [path.name for path in out.iterdir()] == ["set"]


ROWS = {
    f"picks/{name}.parquet": partial(_is_refused, *said)
    for name, said in {
        "states_frame_2147483647": ("frame", "2147483647"),
        "trials_outcome_255": ("outcome", "255"),
        "trials_point_floatnan": ("point", "[nan, nan, nan]"),
        "trials_state_-1": ("state", "-1"),
    }.items()
}
