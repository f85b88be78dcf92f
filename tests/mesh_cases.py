"""What is right for the inputs of users that are parts, models_info.json and TOML."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import Bake, Config, Objects
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.catalog import load_catalog


def _one_part(sides: tuple[float, ...], turns: int = 0, said: str = "", **objects) -> Callable[[Path, Path], None]:
    """One object of these sides [m], with a number of continuous symmetries, and a line that ends so; empty: none."""

    def check(case: Path, out: Path) -> None:
        lines: list[str] = []
        config = Config(bake=Bake(models=str(case)), objects=Objects(**objects))
        (entry,) = load_catalog(config, out, lines.append).entries
        assert np.ptp(entry.mesh.vertices, axis=0) == pytest.approx(sides, rel=1e-5)
        assert len(entry.symmetries_continuous) == turns
        assert sum(line.endswith(said) for line in lines if said) == bool(said), lines

    return check


def _has_one_world(case: Path, out: Path) -> None:
    assert load_config(str(case)).bake.worlds == 1


def _is_refused_with_a_line(case: Path, out: Path) -> None:
    """Whatever an earlier bake left in the cache, an object whose decomposition takes too long has no other shape instead."""
    (out / "models").mkdir()
    trimesh.creation.torus(40.0, 10.0).export(out / "models" / "ring.ply")
    config = load_config(str(case))
    config = replace(config, bake=replace(config.bake, models=str(out / "models")))
    for _ in range(2):
        with pytest.raises(CatalogError, match=r"ring: .* took longer than 0\.2 s of processor time .*; decimate"):
            load_catalog(config, out / "cache", lambda line: None)
        assert not (out / "cache").exists()


SIDES = (0.04, 0.03, 0.02)
ROWS = {
    "cells/decomposition_limit.toml": _is_refused_with_a_line,
    "parts/gltf_skin": _one_part(SIDES),
    "parts/models_info_padded_key": _one_part((0.03, 0.03, 0.05), 1),
    "parts/other_formats_silent": _one_part(
        SIDES, said=": of a format that is not read: a.3mf, b.usd, c.dae, d.fbx; save them as PLY, OBJ, glTF, STL or STEP files", unit="mm"
    ),
    "parts/stl_count_zero": _one_part(
        SIDES, said="its header announces 0 triangles, its body holds 12: 12 are read; 40 x 30 x 20 mm, unit mm", unit="mm"
    ),
    "settings/bom.toml": _has_one_world,
}
