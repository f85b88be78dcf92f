"""Schemas of foreign BOP annotations (msgspec types): as loose as the toolkit is, so that rules, not the parser, name what is wrong."""

from __future__ import annotations

import re
from typing import Annotated, Any

import msgspec
from msgspec import UNSET, Struct, UnsetType

from synpick_warp.dataset.annotations import Index, InfoEntry, Length, LenientCameraEntry, Matrix3, TruthEntry

PLAIN_KEY = re.compile(r"0|[1-9][0-9]{0,8}")
"""An index as a key: decimal digits without leading zeros."""


class Camera(LenientCameraEntry, gc=False):
    """Entry of scene_camera.json: intrinsics [px], depth scale [mm per unit], pose of the world in the camera [mm]."""

    cam_model: dict[str, Any] | UnsetType = UNSET
    depth_scale: Length | UnsetType = UNSET
    cam_R_w2c: Matrix3 | UnsetType = UNSET  # noqa: N815


class Truth(TruthEntry, gc=False):
    """An instance's entry in scene_gt.json [mm]."""

    cam_R_m2c: Matrix3  # noqa: N815


class Info(InfoEntry, gc=False):
    """An instance's entry in scene_gt_info.json [px]."""

    visib_fract: Length


class Segmentation(Struct, gc=False):
    """Run-length encoding (RLE) of a mask; `counts` is a list, or a string in pycocotools' compressed form."""

    counts: list[Index] | str
    size: tuple[Index, Index]
    """Height and width [px]."""


class Annotation(Struct, gc=False):
    """An instance's entry in scene_gt_coco.json [px]."""

    id: Index
    image_id: Index
    category_id: Index
    bbox: Annotated[list[Length], msgspec.Meta(min_length=4, max_length=4)]
    segmentation: Segmentation
    area: Length | UnsetType = UNSET
    ignore: bool | UnsetType = UNSET


class CocoImage(Struct, gc=False):
    """An image's entry in scene_gt_coco.json."""

    id: Index
    file_name: str
    width: Index
    height: Index


class Category(Struct, gc=False):
    """An object's entry in scene_gt_coco.json."""

    id: Index


class Coco(Struct, gc=False):
    """scene_gt_coco.json."""

    images: list[CocoImage]
    annotations: list[Annotation]
    categories: list[Category]


RECORDS: dict[str, Any] = {"camera": Camera, "gt": list[Truth], "gt_info": list[Info]}
"""Schema of an image's entry by file."""


def convert(content: Any, schema: Any) -> Any:
    """Check decoded JSON against a schema.

    Raises:
        ValueError: In few words, with the place in `content`.
    """
    try:
        return msgspec.convert(content, schema)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except msgspec.ValidationError as fault:
        raise ValueError(str(fault).replace("`", "")) from None
