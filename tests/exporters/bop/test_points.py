"""The format points: its contract, and clouds as trimesh reads them: on the objects' surfaces, with their colours and ids."""

import numpy as np
import trimesh

from synpick_warp.exporters.bop.points.exporter import PointsExporter
from synpick_warp.exporters.formats import FORMAT_TABLE
from synpick_warp.testing.box_views import SIZES, batches, config
from synpick_warp.testing.exporters import LENSES, ExporterContract, digests, export, with_files

PRESENT = 0, 2, 3
"""Slots with an object."""


class TestPointsContract(ExporterContract):
    exporter_class, row = PointsExporter, FORMAT_TABLE["points"]


def test_points_lie_on_their_objects_with_the_colours_of_the_view(tmp_path):
    out = export(PointsExporter, tmp_path / "set", config(), (0, 2)) / "points"
    checked = 0
    for batch in batches(1, (0, 2), 3, LENSES):
        scene = int(len(LENSES) * batch.episode[0] + batch.camera[0])
        place = f"train_pbr/{scene:06d}/{int(batch.frame[0]):06d}.ply"
        assert f"./{place}" in (out / f"{scene:06d}.txt").read_text().splitlines()
        cloud = trimesh.load(str(out / place))
        raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
        seen = batch.depth[0] > 0
        assert len(cloud.vertices) == np.count_nonzero(seen)
        assert np.median(np.abs(cloud.colors[:, :3].astype(int) - batch.color[0][seen])) <= 3
        found = np.where(np.isin(batch.instance[0][seen], 1 + np.array(PRESENT)), batch.instance[0][seen].astype(int) - 1, -1)
        np.testing.assert_array_equal(raw["instance_id"], found)
        assert set(raw["object_id"][found < 0]) <= {0}
        for index in set(found[found >= 0].tolist()):
            own = found == index
            assert set(raw["object_id"][own]) == {batch.object_id[0, index]}
            pose = trimesh.transformations.quaternion_matrix(np.roll(batch.pose[0, index, 3:], 1))
            local = (cloud.vertices[own] - batch.pose[0, index, :3]) @ pose[:3, :3]
            outside = np.abs(local) - np.array(SIZES[int(batch.object_id[0, index])]) / 2
            assert np.abs(outside.max(axis=1)).max() < 1e-4
            checked += 1
    assert checked > 20


def test_depth_files_of_the_device_give_the_same_clouds(tmp_path):
    images = export(PointsExporter, tmp_path / "images", config())
    assert digests(export(PointsExporter, tmp_path / "files", config(), prepare=with_files)) == digests(images)
