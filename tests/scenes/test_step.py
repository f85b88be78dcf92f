"""STEP files: cylinders, whose size is known; skipped without cascadio, but for what is said then."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.meshes import MeshOptions, read_mesh, signed_volume
from tests.worlds.model_files import box, load_models, put, step_cylinder

SHOWN = "not readable as STEP (OpenCASCADE refuses it)"


@pytest.mark.parametrize(
    ("name", "size", "prefix"), [("a.step", (20.0, 60.0), ".MILLI."), ("a.STP", (2.0, 6.0), ".CENTI."), ("a.stp", (0.02, 0.06), "$")]
)
def test_lengths_are_in_the_unit_that_the_file_names(tmp_path, name, size, prefix):
    pytest.importorskip("cascadio")
    put(tmp_path / "parts" / name, step_cylinder(size[0], size[1], prefix))
    catalog, lines = load_models(tmp_path / "parts", tmp_path, unit="in", center=True)
    (entry,), (line,) = catalog.entries, lines
    assert all(words in line for words in (" x 60 mm, unit of the file; centred: moved by ", ", -0.03 m"))
    assert np.ptp(entry.mesh.vertices, axis=0) == pytest.approx((0.04, 0.04, 0.06), rel=2e-3)
    # Within the distance of chords from the circle.
    assert signed_volume(entry.mesh.vertices, entry.mesh.faces) == pytest.approx(np.pi * 0.02**2 * 0.06, rel=0.01)


def test_a_step_file_beside_its_mesh_is_ignored(tmp_path):
    put(tmp_path / "parts" / "a.step", "no STEP file")
    put(tmp_path / "parts" / "a.stl", box(0.1, 0.1, 0.1, kind="stl"))
    catalog, lines = load_models(tmp_path / "parts", tmp_path)
    assert [entry.name for entry in catalog.entries] == ["a"]
    assert lines == [f"{tmp_path / 'parts'}: 1 STEP files beside meshes of the same name are ignored"]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("no STEP file", SHOWN),
        (step_cylinder(20, 60)[:700], SHOWN),
        (step_cylinder(20, 60).replace("MANIFOLD_SOLID_BREP", "GEOMETRIC_SET"), "no triangles"),
    ],
)
def test_damaged_files_are_one_line(tmp_path, content, said):
    pytest.importorskip("cascadio")
    with pytest.raises(CatalogError, match=r"a\.step: ") as caught:
        read_mesh(put(tmp_path / "a.step", content), 1.0, MeshOptions())
    assert said in str(caught.value)


def test_without_cascadio_the_line_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "cascadio", None)
    with pytest.raises(
        CatalogError, match=r"a\.step: STEP files need cascadio, which is not installed: pip install 'synpick-warp\[step\]', or save"
    ):
        read_mesh(put(tmp_path / "a.step", step_cylinder(20, 60)), 1.0)
