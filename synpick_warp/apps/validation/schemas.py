"""Schemas of foreign BOP annotations (msgspec types): as loose as the toolkit is, so that rules, not the parser, name what is wrong."""

from __future__ import annotations

import re
from typing import Annotated, Any

import msgspec
from msgspec import UNSET, Struct, UnsetType

from synpick_warp.dataset.annotations import GraphEntry, Index, InfoEntry, Length, Matrix3, TruthEntry, camera_schema

PLAIN_KEY = re.compile(r"0|[1-9][0-9]{0,8}")
"""An index as a key: decimal digits without leading zeros."""


CAMERA = camera_schema(cam_model=dict[str, Any], depth_scale=Length, cam_R_w2c=Matrix3)


class TruthSchema(TruthEntry, gc=False):
    """Schema of an instance's entry in scene_gt.json: object-to-camera rotation and translation [mm], obj_id."""

    cam_R_m2c: Matrix3  # noqa: N815


class Info(InfoEntry, gc=False):
    """Schema of an instance's entry in scene_gt_info.json: boxes and pixel counts [px], visible fraction."""

    visib_fract: Length


class Segmentation(Struct, gc=False):
    """Run-length encoding (RLE) of a mask; `counts` is a list, or a string in pycocotools' compressed form."""

    counts: list[Index] | str
    size: tuple[Index, Index]
    """Height and width [px]."""


class Annotation(Struct, gc=False):
    """Schema of an annotation in scene_gt_coco.json: ids, box [px], run lengths; UNSET: missing."""

    id: Index
    image_id: Index
    category_id: Index
    bbox: Annotated[list[Length], msgspec.Meta(min_length=4, max_length=4)]
    segmentation: Segmentation
    area: Length | UnsetType = UNSET
    ignore: bool | UnsetType = UNSET


class CocoImage(Struct, gc=False):
    """Schema of an image in scene_gt_coco.json."""

    id: Index
    file_name: str
    width: Index
    height: Index


class Category(Struct, gc=False):
    """Schema of a category, an object, in scene_gt_coco.json."""

    id: Index


class Coco(Struct, gc=False):
    """Schema of scene_gt_coco.json: images, annotations, categories."""

    images: list[CocoImage]
    annotations: list[Annotation]
    categories: list[Category]


RECORDS: dict[str, Any] = {"camera": CAMERA, "gt": list[TruthSchema], "gt_info": list[Info], "graph": GraphEntry}
"""Schema of an image's entry by file."""


def convert(content: Any, schema: Any) -> Any:
    """Check decoded JSON against a schema; returns it as the schema's types.

    Raises:
        ValueError: In few words, with the place in `content`.
    """
    try:
        return msgspec.convert(content, schema)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except msgspec.ValidationError as fault:
        raise ValueError(str(fault).replace("`", "")) from None
