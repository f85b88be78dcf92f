"""Folders of any depth."""

from __future__ import annotations

import os
import subprocess
import sys
import traceback
from pathlib import Path

import numpy as np
import pytest

from synpick_warp.cli.main import main
from synpick_warp.scenes.collision.shapes import _Saver
from synpick_warp.scenes.types import ConvexPiece
from synpick_warp.system.hardware.caches import link_files
from synpick_warp.system.inputs.paths import make_folder
from tests.builders import mistake
from tests.harness.scripted_bake import bake, settings

FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
CALLS = 450
"""Calls that Python's stack has room for, instead of 1,000: time grows with the square of the depth."""
DEPTH = 500
"""More than that; the path is shorter than Linux allows, 4,096 bytes."""


def test_a_folder_with_parents_a_folder_that_is_there_and_a_file(tmp_path):
    make_folder(tmp_path / "a" / "b")
    make_folder(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()
    (tmp_path / "file").touch()
    for path, error in ((tmp_path / "file", FileExistsError), (tmp_path / "file" / "below", NotADirectoryError)):
        with pytest.raises(error):
            make_folder(path)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """The current folder, which is removed again by a program that is not recursive, as pytest's is."""
    monkeypatch.chdir(tmp_path)
    before = sys.getrecursionlimit()
    sys.setrecursionlimit(len(traceback.extract_stack()) + CALLS)
    yield tmp_path
    sys.setrecursionlimit(before)
    subprocess.run(["rm", "-rf", "d"], cwd=tmp_path, check=True)


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("deep") / "set"
    bake(out, settings(1, ("bop", "zarr")))
    return out


@pytest.mark.parametrize(
    ("command", "output"),
    [
        ("preview {data} --views 1 --out", "sheet.png"),
        ("explain {data} --out", "sheet.png"),
        ("report {data} --views 1 --out", "page.html"),
        ("stats {data} --csv", "tables"),
        ("convert {data} --to coco --threads 1 --out", "set"),
        ("convert {data} --to shards,lerobot --threads 1 --out", "set"),
        ("merge {data} --out", "set"),
    ],
)
def test_outputs_lie_at_any_depth(data, here, command, output):
    """RecursionError, with a traceback."""
    out = "/".join(["d"] * DEPTH + [output])
    assert main([*command.format(data=data).split(), out]) == 0
    assert os.path.exists(out)


def test_caches_and_textures_lie_at_any_depth(here):
    deep = Path("/".join(["d"] * DEPTH))
    lines: list[str] = []
    _Saver(lines.append)(deep / "shape.npz", (ConvexPiece(np.eye(4, 3, dtype=np.float32), FACES),))
    assert not lines
    assert (deep / "shape.npz").is_file()
    source = here / "source"
    source.mkdir()
    link_files(source, deep / "kernels")
    assert (deep / "kernels").is_dir()


def test_a_path_that_is_too_long_with_a_file_is_one_line(data, here):
    """4,096 bytes with the files of a data set; the folder alone is shorter."""
    out = "/".join(["d"] * 2030)
    for arguments in (
        ["merge", str(data)],
        *(["convert", str(data), "--to", to, "--threads", "1"] for to in ("shards", "lerobot", "coco")),
    ):
        mistake(*arguments, "--out", out)
        assert list(here.iterdir()) == []


def test_a_bake_is_refused_in_one_line_at_any_depth(here):
    out = "/".join(["d"] * DEPTH)
    arguments = ("--config", "smoke", "--device", "cpu", "--mode", "move", "--models", here)
    assert "contains no models" in mistake("bake", *arguments, "--out", out)
    assert list(here.iterdir()) == []
