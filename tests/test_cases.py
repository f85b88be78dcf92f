"""Inputs of users in tests/cases, one row each: what a command says of them, or what is right."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests import bin_cases, camera_cases, mesh_cases, pick_cases

CASES = Path(__file__).parent / "cases"
KINDS = ("bins", "calibrations", "cells", "meshes", "parts", "picks", "settings")
"""Folders whose inputs have a row here; lights and others have theirs in tests/scenes."""
Check = Callable[[Path, Path], None]
"""Takes the path of an input and an empty folder for output; asserts."""
ROWS: dict[str, Check] = {**bin_cases.ROWS, **camera_cases.ROWS, **mesh_cases.ROWS, **pick_cases.ROWS}
"""By path below CASES."""
PENDING: set[str] = set()


@pytest.mark.parametrize("case", ROWS)
def test_an_input_of_a_user(tmp_path, case):
    ROWS[case](CASES / case, tmp_path)


def test_every_input_has_a_row():
    present = {str(path.relative_to(CASES)) for kind in KINDS for path in (CASES / kind).iterdir()}
    assert present == ROWS.keys() | PENDING
