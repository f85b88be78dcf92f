"""Rules about the tree: names of folders and files, links, files of the data set as a whole, and files of each scene."""

import re
from typing import Annotated

import msgspec

from synpick_warp.apps.validation.registry import Findings, Level, rule
from synpick_warp.apps.validation.scene_files import FolderScene
from synpick_warp.apps.validation.subjects import MASKS, SceneSubject, TreeSubject
from synpick_warp.dataset.bop.images import SUFFIXES
from synpick_warp.dataset.bop.layout import is_index
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import decode_json

_NAME = re.compile(r"[0-9]{6,9}")
_MASK = re.compile(r"[0-9]{6,9}_[0-9]{6,9}")
_CAMERA = re.compile(r"camera(_\w+)?\.json")
_MAX_CAMERA = 2**20
"""Largest camera.json [bytes]; they have 200."""
_Positive = Annotated[float, msgspec.Meta(gt=0.0, le=1e6)]


class _CameraFile(msgspec.Struct):
    """Schema of camera.json: image size, intrinsics [px], depth scale [mm per count]."""

    width: Annotated[int, msgspec.Meta(ge=1, le=2**16)]
    height: Annotated[int, msgspec.Meta(ge=1, le=2**16)]
    fx: _Positive
    fy: _Positive
    cx: float
    cy: float
    depth_scale: _Positive | msgspec.UnsetType = msgspec.UNSET


@rule(TreeSubject, "link-outside", "replace the link by a copy of what it names")
def check_links(tree: TreeSubject) -> Findings:
    """No symbolic link leads out of the data set, or nowhere, and there are no pipes or devices."""
    layout = tree.layout
    for listing in (layout.listing, *layout.models.values(), *layout.splits.values(), *layout.keyed.values()):
        for name in listing.outside:
            yield listing.name(name), "a symbolic link that leads out of the data set, or nowhere; it is not followed"
        for name in listing.special:
            yield listing.name(name), "neither a file nor a folder; it is not opened"


@rule(TreeSubject, "split-folders", "rename the folder to its scene index with six digits, or move it out of the split")
def check_split_folders(tree: TreeSubject) -> Findings:
    """A split contains only scene folders, named by six digits: the toolkit takes every folder in it for a scene."""
    for listing in tree.layout.splits.values():
        for name in sorted(listing.folders):
            if not is_index(name):
                yield listing.name(name), "a folder in a split that is no scene"
            elif not _NAME.fullmatch(name):
                yield listing.name(name), f"a scene folder of {len(name)} digits"
        # A split of ours may have still to be baked: see bake-finished.
        if not any(map(is_index, listing.folders)) and not tree.layout.ours:
            yield listing.place, "a split without a scene"


@rule(TreeSubject, "camera-file", "write the intrinsics of the split's camera, in pixels")
def check_camera_file(tree: TreeSubject) -> Findings:
    """camera.json (or camera_SENSOR.json) has width, height, fx, fy, cx, cy above 0, and depth_scale if it is there."""
    listing = tree.layout.listing
    for name in sorted(filter(_CAMERA.fullmatch, listing.files)):
        try:
            decode_json(listing.read(name, _MAX_CAMERA), _CameraFile, name, DatasetError)
        except DatasetError as error:
            yield name, str(error)


@rule(TreeSubject, "set-files", "add what is missing: tools read it without asking", level=Level.WARNING)
def check_set_files(tree: TreeSubject) -> Findings:
    """The data set has camera.json, models, models_eval with a models_info.json of its own, and test_targets_bop19.json."""
    layout = tree.layout
    if not any(map(_CAMERA.fullmatch, layout.listing.files)):
        yield "camera.json", "missing; BlenderProc and render_train_imgs.py read it"
    if not layout.models:
        yield "models", "missing; poses are not checked against pixels"
    if "models_eval" not in layout.models:
        yield "models_eval", "missing; the toolkit's evaluation and vis_poses.py read it"
    for name, listing in layout.models.items():
        if "models_info.json" not in listing.files:
            yield listing.name("models_info.json"), f"missing; diameters and symmetries of {name} are not known"
    for obj_id in sorted(layout.model_files) if "models_eval" in layout.models else ():
        if f"obj_{obj_id:06d}.ply" not in layout.models["models_eval"].files:
            yield layout.models["models_eval"].name(f"obj_{obj_id:06d}.ply"), f"missing; {layout.model_files[obj_id][0]} has this object"
    if layout.splits and "test_targets_bop19.json" not in layout.listing.files:
        yield "test_targets_bop19.json", "missing; the toolkit's calc_gt_masks.py and calc_gt_coco.py open it, and take [] for no targets"


@rule(TreeSubject, "bake-finished", "the command that started the bake resumes it", level=Level.WARNING)
def check_finished(tree: TreeSubject) -> Findings:
    """A bake of ours is finished."""
    if tree.layout.ours and "joined.json" not in tree.layout.listing.enter("manifest").files:
        yield "manifest/joined.json", "missing: the bake was interrupted, so lists and episodes are missing"


@rule(SceneSubject, "scene-links", "replace the link by a copy of what it names")
def check_scene_links(scene: SceneSubject) -> Findings:
    """No symbolic link in a scene leads out of the data set, and its folders contain regular files only."""
    if isinstance(scene.files, FolderScene):
        for listing in (scene.files.listing, *scene.files.listings.values()):
            for name in (*listing.outside, *listing.special):
                yield listing.name(name), "leads out of the data set, or is no regular file; it is not read"


@rule(SceneSubject, "scene-files", "restore the file; without it no tool can read the scene")
def check_scene_files(scene: SceneSubject) -> Findings:
    """A scene has scene_camera.json and images in rgb or gray."""
    camera = scene.record("camera")
    if not camera.present or not (camera.raw or camera.faults or camera.keys):
        yield camera.file, "missing or empty"
    if scene.colour is None and "depth" not in scene.files.kinds:
        yield scene.place, f"no images: neither rgb{scene.files.ref.sensor} nor gray{scene.files.ref.sensor}"


@rule(
    SceneSubject,
    "ground-truth",
    "restore it, or make it by the toolkit's calc_gt_info.py and calc_gt_masks.py; test scenes with hidden ground truth have none",
    level=Level.WARNING,
)
def check_ground_truth(scene: SceneSubject) -> Findings:
    """A scene has scene_gt.json, scene_gt_info.json and, with ground truth, both mask folders."""
    for name in ("gt", "gt_info"):
        if not scene.record(name).present:
            yield scene.record(name).file, "missing"
    if any(scene.truths.values()):
        for name in MASKS:
            if name not in scene.files.kinds:
                yield f"{scene.place}/{name}{scene.files.ref.sensor}", "missing; COCO annotations and trainers need it"


@rule(SceneSubject, "image-names", "rename the file, or move it out of the folder")
def check_image_names(scene: SceneSubject) -> Findings:
    """Images are named by six digits and .png, .jpg or .tif; masks by image and ground-truth index of six digits each."""
    if not isinstance(scene.files, FolderScene):
        return
    for kind, listing in scene.files.listings.items():
        pattern = _MASK if kind in MASKS else _NAME
        seen: set[str] = set()
        for name in sorted(listing.files):
            stem, _, suffix = name.rpartition(".")
            if not pattern.fullmatch(stem) or suffix.lower() not in SUFFIXES:
                yield listing.name(name), "a file name that no tool expects"
            elif stem in seen:
                yield listing.name(name), "a second file of the same image"
            seen.add(stem)
        for name in sorted(listing.folders):
            yield listing.name(name), "a folder among images"


@rule(SceneSubject, "image-missing", "restore the image, or remove its entries from the scene's JSON files")
def check_images_present(scene: SceneSubject) -> Findings:
    """Every image that the annotations name exists: colour or grey, depth, and a mask of each kind for each instance."""
    for kind in (scene.colour, "depth"):
        if kind is not None and (kind == scene.colour or kind in scene.files.kinds):
            known = scene.files.indices(kind)
            for image in scene.images:
                if (image, None) not in known:
                    yield scene.files.file(kind, image), f"missing: image {image} is in the annotations"
    if isinstance(scene.files, FolderScene):
        for kind in (kind for kind in MASKS if kind in scene.files.kinds):
            known = scene.files.indices(kind)
            for image, truths in scene.truths.items():
                for index in (index for index in range(len(truths)) if (image, index) not in known):
                    yield scene.files.file(kind, image, index), f"missing: image {image} has {len(truths)} instances"


@rule(SceneSubject, "image-extra", "add the entry, or remove the file")
def check_images_extra(scene: SceneSubject) -> Findings:
    """There is no image without an entry in scene_camera.json, and no mask beyond the image's list in scene_gt.json."""
    cameras, truths = scene.record("camera"), scene.record("gt")
    for kind in sorted(scene.files.kinds):
        # By image, then by instance; without instance first.
        files = sorted(scene.files.indices(kind).items(), key=lambda item: tuple(-1 if part is None else part for part in item[0]))
        for (image, index), name in files:
            if kind not in MASKS or index is None:
                if cameras.present and image not in cameras.raw:
                    yield scene.files.file(kind, image), f"no entry {image} in {cameras.file}"
            elif truths.present and not (isinstance(entries := truths.raw.get(image), list) and index < len(entries)):
                yield scene.files.file(kind, image, index), f"no instance {index} in {truths.file}, image {image} ({name})"
