"""Full bins of like parts: they come to rest within walls and floor, and stay within the capacities that follow from the catalog."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Ending, Phase
from synpick_warp.configs.schema import Config
from synpick_warp.factory.assembly import fit_to_catalog
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.build import GRIPPER_BODIES
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.system.progress import SilentProgress
from tests.builders import STIRRING, bake_boxes
from tests.harness.exporter_contract import digests
from tests.worlds.small_worlds import ANGLE, BOX, COARSE, catalog, run_ticks, settings

TICKS = 80
MOST_DEPTH = 2e-3
"""Depth to which no vertex may be inside a wall or the floor [m]; the solver's penetrations are tenths of a millimetre."""


def fitted(objects: Catalog, number: int, device, **overrides: object) -> Config:
    """Settings of a bin with `number` of the first object, in layers."""
    counts = ((objects.entries[0].name, number, number),)
    fill = {"arrangement__counts": counts, "arrangement__max_objects": number, "arrangement__drop": "layers", "settle__restless": 0.05}
    fill["bake__formats"] = ["zarr"]
    config = settings(**COARSE | fill | overrides)
    return fit_to_catalog(config, objects, make_bins(config.cell.bins), device, SilentProgress())


def depth_in_bin(config: Config, points: np.ndarray) -> float:
    """Depth of the deepest of points (N, 3) inside the bin's collision shapes [m]; below 0 outside of all."""
    planes = [ConvexHull(piece.vertices.astype(np.float64)).equations for piece in make_bins(config.cell.bins)[0].pieces]
    return max(float((-(points @ each[:, :3].T + each[:, 3]).max(axis=1)).max()) for each in planes)


@pytest.mark.parametrize("shape", [BOX, ANGLE], ids=["boxes", "angles"])
def test_a_full_bin_rests_within_its_walls_and_capacities(device, shape):
    """60 boxes, or L of two boxes: no vertex enters a wall or the floor, none lies beside the bin, and nothing overflows."""
    objects = catalog(shape)
    config = fitted(objects, 60, device)
    simulation = Simulation(config, objects, 1, device)
    for _ in range(TICKS):
        (seen,) = run_ticks(simulation, 1)
        assert seen.column("ending")[0] == Ending.RUNNING
        if seen.column("phase")[0] == Phase.ACT:
            break
    assert seen.column("phase")[0] == Phase.ACT
    pose = seen.pose[0]
    vertices = np.concatenate([piece.vertices for piece in objects.entries[0].pieces])
    points = np.einsum("nij,vj->nvi", Rotation.from_quat(pose[:, 3:]).as_matrix(), vertices) + pose[:, None, :3]
    assert len(pose) == 60
    assert depth_in_bin(config, points.reshape(-1, 3)) < MOST_DEPTH
    assert (np.abs(points[..., :2]) < np.array(config.tote.outer_size[:2]) / 2 + config.physics.gap).all()
    assert simulation.state.penetration.numpy()[GRIPPER_BODIES:].max() < MOST_DEPTH
    physics = simulation.physics
    assert 60 < int(physics.contacts.rigid_contact_count.numpy()[0]) < config.physics.contacts_per_world
    assert 60 < int(physics.overlap_count.numpy()[0]) < config.physics.pairs_per_world


@pytest.mark.slow
def test_bytes_of_full_bins_do_not_depend_on_worlds(tmp_path):
    """Three episodes of 40 boxes, with masks of each."""
    fill = {"counts": [["boxes_1", 40, 40]], "max_objects": 40, "drop": "layers"}
    given = STIRRING | {f"arrangement.{name}": value for name, value in fill.items()} | {"settle.restless": 0.5}
    given |= {"bake.episodes": 3, "bake.formats": ["bop", "usd", "zarr"], "cameras.resolution": [48, 27]}
    found = []
    for worlds in (1, 2, 8):
        bake_boxes(tmp_path / str(worlds), given | {"bake.worlds": worlds}, objects=lambda: catalog(BOX))
        files = digests(tmp_path / str(worlds)).items()
        found.append({name: digest for name, digest in files if not name.endswith(("config.toml", "manifest.json"))})
    assert found[0] == found[1] == found[2]
    assert len(found[0]) > 300
