"""Rows of bins' meshes for `test_cases`: floor and opening of each, and what is said of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from synpick_warp.configs.cell.bins import BinRow
from synpick_warp.scenes.bin_meshes.reading import read_bin


def _measures(floor: tuple[float, float], opening: tuple[float, float], said: str, **settings: str) -> Callable[[Path, Path], None]:
    """Floor and opening of a bin's mesh [mm], and a line on it."""

    def check(file: Path, _: Path) -> None:
        file = file / "wire.stl" if file.is_dir() else file
        model = read_bin(BinRow(name="own", file=str(file), **settings))
        assert said in " ".join(model.notes)
        for sides, expected in ((model.measured.floor or model.measured.opening, floor), (model.measured.opening, opening)):
            np.testing.assert_allclose(1000.0 * np.array(sides), expected, atol=0.5 if model.measured.floor else 4.0)

    return check


ROWS = {
    "bins/hopper.stl": _measures((232.0, 172.0), (488.0, 340.0), "floor 232 x 172 mm, opening 488 x 340 mm", unit="mm"),
    "bins/nofloor.stl": _measures((390.0, 290.0), (390.0, 290.0), "it has no floor: parts will lie on the table"),
    "bins/sloped.stl": _measures((412.0, 262.0), (492.0, 342.0), "floor 412 x 262 mm, opening 492 x 342 mm", unit="mm"),
    "parts/bin_wire": _measures((392.0, 292.0), (392.0, 292.0), "it collides as a closed box", unit="mm", collision="box"),
}
"""By path below tests/cases."""
