"""synpick-warp: a GPU-parallel data factory for dynamic bin picking.

    import synpick_warp

    synpick_warp.bake("smoke", "DATA", {"bake.mode": "move"})
    view = synpick_warp.open("DATA")[0].view(frame=3)

Importing this package loads neither simulator, NumPy nor OpenCV; the functions import them when they are called.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from synpick_warp.errors import CatalogError, ConfigError, DatasetError, DeviceError, LightError, OutputError, SynpickError

if TYPE_CHECKING:
    from synpick_warp.configs.schema import Config
    from synpick_warp.dataset.reading import DataSet
    from synpick_warp.episodes import BakeSummary
    from synpick_warp.progress import Progress

__version__ = "0.1.0"
__all__ = [
    "CatalogError",
    "ConfigError",
    "DatasetError",
    "DeviceError",
    "LightError",
    "OutputError",
    "SynpickError",
    "__version__",
    "bake",
    "load_config",
    "open",
]


def bake(
    config: Config | Path | str | None,
    out: Path | str,
    settings: Mapping[str, object] | None = None,
    *,
    shard: tuple[int, int] = (0, 1),
    splits: Sequence[str] = (),
    devices: Sequence[str] = (),
    progress: Progress | None = None,
) -> BakeSummary:
    """Generate a data set: simulate, render and write it; or resume one that was interrupted. `synpick-warp bake` does the same.

    Args:
        config: Settings: a `Config`, or a preset's name or a .toml file as for `load_config`; None: the default preset.
        out: Folder of the data set: new, empty, or of an earlier bake with the same settings.
        settings: Full key, such as "bake.mode", -> value; they override a preset or file.
        shard: (i, n): only episodes with index % n == i.
        splits: Only episodes of these splits of the settings, such as ("train",) of the preset "synpick"; empty: all.
        devices: Devices with a process each: GPUs such as ("cuda:0", "cuda:1"), or ("all",), or "cpu" once per process. The bytes are those
            of one device. Empty: `bake.device` alone.
        progress: Receives stages, counts and notes; None: silent. See `synpick_warp.progress`.

    Returns:
        How every episode and attempt ended, and how long it took.

    Raises:
        SynpickError: An error that the user can correct. Committed episodes stay, and the same call resumes the bake.
        TypeError: `settings` beside a finished `Config`.
    """
    from synpick_warp.configs.schema import Config
    from synpick_warp.pipeline import run_bake
    from synpick_warp.progress import SilentProgress

    if not isinstance(config, Config):
        config = load_config(config, settings, splits=bool(splits))
    elif settings:
        raise TypeError("settings override a preset or a file; pass them to load_config, or use dataclasses.replace on the Config")
    return run_bake(config, Path(out), progress if progress is not None else SilentProgress(), shard, splits, devices)


def load_config(preset_or_file: Path | str | None = None, settings: Mapping[str, object] | None = None, *, splits: bool = False) -> Config:
    """Read a preset or a .toml file, override single settings, and validate the result.

    Args:
        preset_or_file: Name of a preset, such as "smoke", or path of a file that ends in .toml; None: the preset "synpick".
        settings: Full key, such as "physics.step", -> value.
        splits: Whether the splits that a preset offers hold; those of a file always do.

    Raises:
        ConfigError: There is no such preset, file or key, or a value is not allowed.
    """
    from synpick_warp.configs.load import load_config as load

    return load(None if preset_or_file is None else str(preset_or_file), settings or {}, splits=splits)


def open(folder: Path | str) -> DataSet:
    """Open a data set for reading; loads no simulator, and reads nothing before it is needed. See `synpick_warp.dataset.reading`.

    Raises:
        DatasetError: The folder holds no data set.
    """
    from synpick_warp.dataset.reading import open_data_set

    return open_data_set(folder)
