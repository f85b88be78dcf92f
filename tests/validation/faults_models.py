"""Faults of models, target lists, cameras, shards and poses; see `planting`."""

from __future__ import annotations

import io
import json
import tarfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from tests.validation.planting import SCENE, edit, edit_entry, fault, mask_path, read, write


@fault("model-files", "no model")
def model_missing(folder):
    (folder / "models_eval/obj_000007.ply").unlink()


@fault("model-dialect", "float32")
def model_of_other_types(folder):
    path = folder / "models/obj_000007.ply"
    path.write_bytes(path.read_bytes().replace(b"property float ", b"property float32 "))


@fault("model-mesh")
def model_cut_short(folder):
    path = folder / "models/obj_000007.ply"
    path.write_bytes(path.read_bytes()[:-40])


def edit_model(folder: Path, **values: Any) -> None:
    edit(folder / "models/models_info.json", lambda content: content["7"].update(values))


@fault("model-entry")
def model_without_diameter(folder):
    edit(folder / "models/models_info.json", lambda content: content["7"].pop("diameter") and None)


@fault("model-diameter", "metres")
def diameter_in_metres(folder):
    edit_model(folder, diameter=0.21213)


@fault("model-box", "size_z")
def wrong_model_size(folder):
    edit_model(folder, size_z=100.0)


def move_model(folder: Path, scale: float, shift: float) -> None:
    for path in (folder / "models/obj_000007.ply", folder / "models_eval/obj_000007.ply"):
        mesh = trimesh.load_mesh(path, process=False)
        mesh.vertices = scale * mesh.vertices + shift
        path.write_bytes(mesh.export(file_type="ply"))


@fault("model-units", "metres")
def model_in_metres(folder):
    move_model(folder, 1e-3, 0.0)


@fault("model-origin")
def model_off_its_origin(folder):
    move_model(folder, 1.0, 60.0)


@fault("symmetry-identity")
def identity_listed(folder):
    edit_model(folder, symmetries_discrete=[np.eye(4).ravel().tolist()])


@fault("symmetry-rigid")
def mirror_symmetry(folder):
    edit_model(folder, symmetries_discrete=[np.diag([-1.0, 1.0, 1.0, 1.0]).ravel().tolist()])


@fault("symmetry-maps")
def false_symmetry(folder):
    edit_model(folder, symmetries_discrete=[[0, 0, 1, 0, 0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 0, 1]])


@fault("target-schema")
def targets_are_no_list(folder):
    (folder / "test_targets_bop19.json").write_text("{}")


@fault("target-scenes", "scene 77")
def target_of_another_scene(folder):
    edit(folder / "test_targets_bop19.json", lambda content: content[0].update(scene_id=77))


@fault("target-images", "image 50")
def target_of_another_image(folder):
    edit(folder / "test_targets_bop19.json", lambda content: content[0].update(im_id=50))


@fault("target-counts")
def wrong_target_count(folder):
    edit(folder / "test_targets_bop19.json", lambda content: content[0].update(inst_count=9))


@fault("rig-complete")
def camera_missing(folder):
    (folder / "train/000002").rename(folder / "gone")


@fault("world-poses", "mm")
def camera_moved(folder):
    edit_entry(folder, "camera", cam_t_w2c=[0.0, 0.0, 1490.0])


@fault("shard-index", "no shard-000000.tar")
def shard_missing(folder):
    (folder / "train_web/shard-000000.tar").unlink()


@fault("shard-files")
def shard_cut_short(folder):
    path = folder / "train_web/shard-000000.tar"
    path.write_bytes(path.read_bytes()[:5000])


@fault("mask-entries")
def shard_without_a_mask(folder):
    path, kept = folder / "train_web/shard-000000.tar", []
    with tarfile.open(path) as tar:
        for member in tar.getmembers():
            data = tar.extractfile(member).read()
            if member.name == "000000_000001.mask.json":
                data = json.dumps({key: value for key, value in json.loads(data).items() if key != "1"}).encode()
            member.size = len(data)
            kept.append((member, data))
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for member, data in kept:
            tar.addfile(member, io.BytesIO(data))


def scale_depth(folder: Path, factor: float) -> None:
    for path in (folder / SCENE / "depth").iterdir():
        write(path, np.rint(read(path) * factor).astype(np.uint16))


@fault("depth-scaled", "1.02 times")
def depth_scaled_up(folder):
    scale_depth(folder, 1.02)


@fault("depth-scaled", "0.99 times")
def depth_scaled_down(folder):
    scale_depth(folder, 0.99)


@fault("depth-planar")
def depth_of_rays(folder):
    content = json.loads((folder / SCENE / "scene_camera.json").read_text())["1"]["cam_K"]
    for path in (folder / SCENE / "depth").iterdir():
        depth = read(path)
        x = (np.arange(depth.shape[1]) + 0.5 - content[2]) / content[0]
        y = (np.arange(depth.shape[0]) + 0.5 - content[5]) / content[4]
        write(path, np.rint(depth * np.sqrt(1.0 + x[None] ** 2 + y[:, None] ** 2)).astype(np.uint16))


@fault("mask-shifted", "(3, 0)")
def masks_shifted(folder):
    for kind in ("mask", "mask_visib"):
        for path in (folder / SCENE / kind).glob("*_000001.png"):
            write(path, np.roll(read(path), 3, axis=1))


@fault("mask-shifted", "(0, -1)")
def mask_shifted_by_one_pixel(folder):
    write(mask_path(folder, 1), np.roll(read(mask_path(folder, 1)), -1, axis=0))


@fault("mask-shifted", "mask_visib is shifted by (4, 0)")
def visible_masks_shifted(folder):
    write(mask_path(folder, 0, "mask_visib"), np.roll(read(mask_path(folder, 0, "mask_visib")), 4, axis=1))


@fault("object-shown", "object 7")
def object_ids_swapped(folder):
    def change(content):
        content["1"][1]["obj_id"], content["1"][2]["obj_id"] = content["1"][2]["obj_id"], content["1"][1]["obj_id"]

    edit(folder / SCENE / "scene_gt.json", change)


@fault("instances-swapped", "instances 0 and 2")
def masks_swapped(folder):
    for kind in ("mask", "mask_visib"):
        one, two = mask_path(folder, 0, kind), mask_path(folder, 2, kind)
        first, second = one.read_bytes(), two.read_bytes()
        one.write_bytes(second)
        two.write_bytes(first)


@fault("instances-swapped", "instances 0 and 1")
def truths_swapped(folder):
    def change(content):
        content["1"][0], content["1"][1] = content["1"][1], content["1"][0]

    edit(folder / SCENE / "scene_gt.json", change)


@fault("pose", "about")
def pose_moved_sideways(folder):
    def change(content):
        content["1"][0]["cam_t_m2c"][0] += 12.0

    edit(folder / SCENE / "scene_gt.json", change)


@fault("pose", "about 8 mm")
def pose_moved_away(folder):
    def change(content):
        content["1"][2]["cam_t_m2c"][2] -= 8.0

    edit(folder / SCENE / "scene_gt.json", change)


@fault("pose", "does not fit")
def pose_turned(folder):
    def change(content):
        turn = np.array([[np.cos(0.5), -np.sin(0.5), 0.0], [np.sin(0.5), np.cos(0.5), 0.0], [0.0, 0.0, 1.0]])
        rotation = turn @ np.reshape(content["1"][2]["cam_R_m2c"], (3, 3))
        content["1"][2]["cam_R_m2c"] = rotation.ravel().tolist()

    edit(folder / SCENE / "scene_gt.json", change)


@fault("mask-rendered")
def mask_of_a_box(folder):
    mask = read(mask_path(folder, 1))
    x, y, width, height = cv2.boundingRect(mask)
    mask[y : y + height, x : x + width] = 255
    write(mask_path(folder, 1), mask)


@fault("visible-rendered")
def half_of_the_visible_mask(folder):
    visible = read(mask_path(folder, 0, "mask_visib"))
    visible[:, : int(np.flatnonzero(visible.any(axis=0)).mean())] = 0
    write(mask_path(folder, 0, "mask_visib"), visible)


@fault("depth-rendered")
def depth_of_something_else(folder):
    path = folder / SCENE / "depth/000001.png"
    depth, visible = read(path), read(mask_path(folder, 0, "mask_visib")) > 0
    visible[: int(np.flatnonzero(visible.any(axis=1)).mean()) + 5] = False
    depth[visible] -= 300
    write(path, depth)
