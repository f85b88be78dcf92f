"""Sheet of symmetries: which axes are drawn, and the command on folders of models and data sets."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh

from synpick_warp.apps.viz.symmetries import group_turns
from synpick_warp.cli.main import main
from synpick_warp.scenes.embedded.objects import procedural_objects
from synpick_warp.scenes.symmetries.detection import turn_matrix
from tests.builders import mistake
from tests.worlds.bin_meshes import sloped_bin
from tests.worlds.model_files import exported, put


def test_axes_are_grouped_with_their_largest_fold():
    turns = [(np.eye(3)[2], fold) for fold in (4, 2)] + [(-np.eye(3)[2], 4), (np.eye(3)[0], 2)]
    middle = np.array((0.1, 0.2, 0.3))
    matrices = tuple(tuple(turn_matrix(axis, middle, 2.0 * np.pi / fold).reshape(-1)) for axis, fold in turns)
    raw = replace(procedural_objects()[0], symmetries_discrete=matrices, symmetries_continuous=(((0.0, 1.0, 0.0), (0.0, 0.0, 0.0)),))
    found = group_turns(raw)
    assert [turn.fold for turn in found] == [0, 4, 2]
    assert [tuple(turn.axis.round(6) + 0.0) for turn in found] == [(0, 1, 0), (0, 0, 1), (1, 0, 0)]
    assert np.allclose(found[1].point[:2], middle[:2])


def test_the_symmetries_of_a_folder_of_parts(tmp_path, capsys):
    put(tmp_path / "parts" / "nut.stl", exported(trimesh.creation.cylinder(30.0, 20.0, sections=6), "stl"))
    put(tmp_path / "cell.toml", "preset = 'smoke'\n[objects]\nunit = 'mm'\n")
    arguments = [
        "preview",
        str(tmp_path / "parts"),
        "--symmetries",
        "--config",
        str(tmp_path / "cell.toml"),
        "--out",
        str(tmp_path / "a.png"),
    ]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "nut.stl: 60 x 51.96 x 20 mm, unit mm" in said
    assert "nut.stl: symmetries detected: 6-fold about (0, 0, 1), 2-fold about (" in said
    assert ", 3 more axes; they move its surface by up to " in said
    image = cv2.imread(str(tmp_path / "a.png"))
    assert image is not None
    assert image.shape[1] == 5 * image.shape[0] * 260 // 304  # The part, and four rotations.
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 10


def test_parts_are_compared_with_the_bins_mesh(tmp_path, capsys):
    """A part that does not fit into a bin of the default size."""
    put(tmp_path / "parts" / "plate.stl", exported(trimesh.creation.box((0.6, 0.5, 0.1)), "stl"))
    sloped_bin().apply_scale(3.0).export(tmp_path / "bin.stl")
    put(tmp_path / "cell.toml", "preset = 'smoke'\n[bins]\nkind = 'own'\n[[bin]]\nname = 'large'\nfile = 'bin.stl'\n")
    assert main(["preview", str(tmp_path / "parts"), "--symmetries", "--config", str(tmp_path / "cell.toml")]) == 0
    assert "plate.stl: symmetries detected" in capsys.readouterr().out


def test_the_symmetries_that_a_data_set_states(picked_set, tmp_path, capsys):
    assert main(["preview", str(picked_set), "--symmetries", "--out", str(tmp_path / "a.png")]) == 0
    assert capsys.readouterr().out == f"symmetries: {tmp_path / 'a.png'}\n"
    assert "which has its settings" in mistake("preview", picked_set, "--symmetries", "--config", "smoke")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["gone", "--symmetries"], "models folder gone: no such folder"),
        (["--symmetries"], "no data set"),
        ([".", "--config", "smoke"], "--config is given without --symmetries"),
        ([".", "--symmetries", "--out", "a.txt"], "a.txt is not an image file"),
    ],
)
def test_mistakes_are_one_line(tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    assert said in mistake("preview", *arguments)
