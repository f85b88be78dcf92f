"""Fingerprints of what is computed on the host: meshes, shapes, masses, symmetries, lights, cameras, and the files of a small bake.

python -m tests.harness.fingerprints FOLDER    # prints them as JSON; `test_determinism` compares kinds of processors
"""

import hashlib
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from synpick_warp.configs.episodes.objects import EMBEDDED
from synpick_warp.configs.schema import Config
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.catalog import shape_recipe
from synpick_warp.scenes.collision.hulls import mass_properties
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.embedded.objects import procedural_objects
from synpick_warp.scenes.embedded.parts import PIECES
from synpick_warp.scenes.embedded.skies import skies
from synpick_warp.scenes.symmetries.detection import close_group, find_symmetries
from synpick_warp.stages.render.light_tables import precompute_environment
from synpick_warp.system.hardware.device import start_warp
from synpick_warp.system.linear_algebra import rotation
from synpick_warp.testing.exporters import digests
from tests.builders import PICKED, bake_boxes
from tests.harness.made_once import made_once, written_here
from tools.embedded_shapes import modelled_shape

NAMES = ("soup_tin", "gear", "pipe_tee")
"""Objects of many equal choices: round, and of one cross-section."""
NOISE = 1e-3
ONE_EPISODE = {"bake.worlds": 1, "bake.episodes": 1}
FORMATS = ["bop", "shards", "coco", "usd", "zarr"]


def fingerprint(*values: object) -> str:
    """Digest of arrays and numbers, of every bit."""
    return hashlib.sha256(b"".join(np.ascontiguousarray(value).tobytes() for value in values)).hexdigest()


def computed() -> dict[str, str]:
    """Fingerprints of what precedes a bake."""
    found, objects = {}, Config().objects
    for raw in procedural_objects(EMBEDDED):
        mesh = raw.mesh
        found[f"{raw.name} mesh"] = fingerprint(mesh.vertices, mesh.faces, mesh.normals, mesh.uv)
        if raw.name in NAMES:
            recipe = shape_recipe(raw, objects)
            pieces = modelled_shape(raw.name, recipe) if raw.name in PIECES else (simplify_hull(mesh.vertices, recipe.hull_vertices),)
            mass = mass_properties(pieces)
            found[f"{raw.name} shape"] = fingerprint(*(array for piece in pieces for array in (piece.vertices, piece.faces)))
            found[f"{raw.name} mass"] = fingerprint(mass.volume, mass.center_of_mass, mass.unit_inertia)
        if raw.name == "clamp":
            symmetries = find_symmetries(mesh.vertices, mesh.faces, raw.hull.diameter, 0.03 * raw.hull.diameter)
            found["symmetries"] = fingerprint(symmetries.discrete, symmetries.deviations)
    axes = np.eye(3) + NOISE * np.arange(9).reshape(3, 3)
    group = close_group(np.array([rotation(axis / np.sqrt((axis**2).sum()), np.pi / 2) for axis in axes[:2]]), 15.0)
    assert group is not None
    found["group"] = fingerprint(group)
    light = precompute_environment(skies()[0], np.full(3, 0.5))
    found["light"] = fingerprint(light.radiance, light.prefiltered, light.irradiance, *(lamp.points for lamp in light.lamps))
    rig = Config().rig
    cameras = make_cameras(replace(rig, rows=tuple(replace(row, resolution=(96, 54)) for row in rig.rows)))
    found["cameras"] = fingerprint(*(value for one in cameras for value in (one.matrix, one.rotation, one.translation)))
    return found


def fingerprints(folder: Path) -> dict[str, str]:
    """Fingerprints of what is computed, and of the files of a bake into a folder."""
    given = PICKED | ONE_EPISODE | {"cameras.resolution": [48, 27], "bop.keypoints": 4, "bake.formats": FORMATS}
    bake_boxes(folder, given)
    return computed() | digests(folder)


if __name__ == "__main__":
    start_warp()
    with made_once(), written_here():
        print(json.dumps(fingerprints(Path(sys.argv[1]))))
