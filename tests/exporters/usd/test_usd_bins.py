"""Bins in USD: an asset each, of which an episode references its own."""

from __future__ import annotations

from dataclasses import replace

import pytest
from pxr import Usd

from synpick_warp.configs.cell.bins import BinRow, Bins
from synpick_warp.configs.schema import Config
from tests.worlds.small_worlds import catalog
from tests.worlds.usd_sets import write_set

ROWS = (BinRow(name="kanban", compartments=(2, 1)), BinRow(name="2nd"))


@pytest.mark.parametrize(
    ("kind", "rows", "assets", "prim"),
    [
        ("tote", (), {"tote"}, "Tote"),
        ("own", ROWS, {"bin_kanban", "bin_2nd"}, "Bin"),
        ("pallet", (), {"pallet"}, "Bin"),
        ("none", (), set(), ""),
    ],
)
def test_an_episode_references_its_bin(tmp_path, kind, rows, assets, prim):
    config = replace(Config(), bins=Bins(kind=kind), bin=rows)
    folder = write_set(tmp_path / "set", config, catalog(), frames=4)
    names = {path.stem for path in (folder / "assets").glob("*.usdc")}
    assert names - {"finger", "cup", "table"} - {name for name in names if name.startswith("obj_")} == assets
    stage = Usd.Stage.Open(str(folder / "000000.usdc"))
    for name in ("Tote", "Bin"):
        found = stage.GetPrimAtPath(f"/Episode/{name}")
        assert found.IsValid() == (name == prim)
        if name == prim:
            assert stage.GetPrimAtPath(f"/Episode/{name}/Visual").IsValid()
            pieces = stage.GetPrimAtPath(f"/Episode/{name}/Collision").GetChildren()
            assert len(pieces) == {"tote": 9, "own": 10, "pallet": 1}[kind]
