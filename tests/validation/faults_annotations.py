"""Faults of files, names and annotations; see `planting`."""

from __future__ import annotations

import os

from tests.validation.planting import SCENE, edit, edit_entry, fault, mask_path


@fault("link-outside")
def link_out_of_the_set(folder):
    os.symlink(folder.parent, folder / "models" / "elsewhere")


@fault("scene-links")
def link_image_out_of_the_set(folder):
    outside = folder.parent / "secret.png"
    outside.write_bytes((folder / SCENE / "rgb/000001.png").read_bytes())
    (folder / SCENE / "rgb/000001.png").unlink()
    os.symlink(outside, folder / SCENE / "rgb/000001.png")


@fault("split-folders", "no scene")
def stray_folder_in_split(folder):
    (folder / "train/backup").mkdir()


@fault("split-folders", "4 digits")
def short_scene_name(folder):
    (folder / "train/000002").rename(folder / "train/0002")


@fault("camera-file", "fx")
def camera_without_focal_length(folder):
    edit(folder / "camera.json", lambda content: {key: value for key, value in content.items() if key != "fx"})


@fault("set-files", "toolkit")
def no_targets(folder):
    (folder / "test_targets_bop19.json").unlink()


@fault("bake-finished")
def bake_interrupted(folder):
    (folder / "manifest/joined.json").unlink()


@fault("set-files", "this object")
def model_missing_for_evaluation(folder):
    (folder / "models_eval/obj_000007.ply").unlink()


@fault("scene-files")
def no_scene_camera(folder):
    (folder / SCENE / "scene_camera.json").unlink()


@fault("ground-truth")
def no_infos(folder):
    (folder / SCENE / "scene_gt_info.json").unlink()


@fault("image-names")
def odd_file_name(folder):
    (folder / SCENE / "rgb/1.png").write_bytes((folder / SCENE / "rgb/000001.png").read_bytes())


@fault("image-missing")
def missing_depth(folder):
    (folder / SCENE / "depth/000001.png").unlink()


@fault("image-missing")
def missing_mask(folder):
    mask_path(folder, 2).unlink()


@fault("image-extra", "no instance 7")
def mask_beyond_the_list(folder):
    mask_path(folder, 7).write_bytes(mask_path(folder, 0).read_bytes())


@fault("image-extra", "no entry 9")
def image_without_entry(folder):
    (folder / SCENE / "rgb/000009.png").write_bytes((folder / SCENE / "rgb/000001.png").read_bytes())


@fault("json-schema")
def translation_of_two_numbers(folder):
    edit_entry(folder, "gt", 0, cam_t_m2c=[1.0, 2.0])


@fault("json-keys", "leading zeros")
def padded_key(folder):
    edit(folder / SCENE / "scene_gt.json", lambda content: {f"{int(key):06d}": value for key, value in content.items()})


@fault("same-images")
def image_without_truth(folder):
    edit(folder / SCENE / "scene_gt.json", lambda content: {"0": content["0"]})


@fault("rotation", "determinant is -1")
def mirrored_rotation(folder):
    edit_entry(folder, "gt", 1, cam_R_m2c=[1, 0, 0, 0, 1, 0, 0, 0, -1])


@fault("rotation", "cam_R_w2c")
def scaled_rotation(folder):
    edit_entry(folder, "camera", cam_R_w2c=[1.01, 0, 0, 0, 1, 0, 0, 0, 1])


@fault("camera-model", "both")
def two_camera_models(folder):
    edit_entry(folder, "camera", cam_model={"projection_params": [1.0]})


@fault("camera-model", "column by column")
def transposed_intrinsics(folder):
    edit_entry(folder, "camera", cam_K=[600.0, 0, 0, 0, 600.0, 0, 100.0, 75.0, 1])


@fault("depth-scale")
def no_depth_scale(folder):
    edit(folder / SCENE / "scene_camera.json", lambda content: content["1"].pop("depth_scale") and None)


@fault("skip-translation")
def translation_of_minus_one(folder):
    edit_entry(folder, "gt", 1, cam_t_m2c=[-1, -1, -1])


@fault("translation-units", "metres")
def pose_in_metres(folder):
    def change(content):
        for item in content["1"]:
            item["cam_t_m2c"] = [value / 1000.0 for value in item["cam_t_m2c"]]

    edit(folder / SCENE / "scene_gt.json", change)


@fault("camera-units", "metres")
def camera_in_metres(folder):
    def change(content):
        for item in content.values():
            item["cam_t_w2c"] = [value / 1000.0 for value in item["cam_t_w2c"]]

    edit(folder / SCENE / "scene_camera.json", change)


@fault("extrinsics")
def half_of_the_extrinsics(folder):
    edit(folder / SCENE / "scene_camera.json", lambda content: content["1"].pop("cam_t_w2c") and None)


@fault("behind-camera")
def opengl_pose(folder):
    def change(content):
        x, y, z = content["1"][0]["cam_t_m2c"]
        content["1"][0]["cam_t_m2c"] = [x, -y, -z]

    edit(folder / SCENE / "scene_gt.json", change)


@fault("instance-ids", "2 times")
def instance_twice(folder):
    edit_entry(folder, "gt", 0, instance_id=3)


@fault("object-model", "obj_id 99")
def unknown_object(folder):
    edit_entry(folder, "gt", 0, obj_id=99)


@fault("list-lengths")
def short_infos(folder):
    edit(folder / SCENE / "scene_gt_info.json", lambda content: content["1"].pop() and None)


@fault("visible-fraction")
def wrong_fraction(folder):
    edit_entry(folder, "gt_info", 0, visib_fract=0.5)


@fault("count-order")
def counts_in_the_wrong_order(folder):
    edit_entry(folder, "gt_info", 0, px_count_all=10)


@fault("hidden-boxes")
def zero_box_of_a_visible_instance(folder):
    edit_entry(folder, "gt_info", 0, bbox_visib=[-1, -1, -1, -1])


@fault("box-inside-box")
def box_reaches_out(folder):
    edit_entry(folder, "gt_info", 0, bbox_visib=[0, 0, 199, 149])
