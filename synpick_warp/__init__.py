"""synpick-warp: a GPU-parallel data factory for dynamic bin picking."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from synpick_warp.dataset.reading import DataSet

__version__ = "0.1.0"


def open(folder: Path | str) -> DataSet:
    """Open a data set's trajectories, lazily; see `synpick_warp.dataset.reading`. Loads no simulator.

    Raises:
        DatasetError: There are none.
    """
    from synpick_warp.dataset.reading import open_data_set

    return open_data_set(folder)
