"""Dataset card of shards: README.md with the YAML header that the Hugging Face hub, its viewer and the package `datasets` read.

The header declares each split's files, as key_to_shard.json lies beside them, and the columns' types: inferred ones come from the first
views, and miss masks of scenes with more objects, or find nothing but null where a later scene has a light's direction.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from synpick_warp.configs.dataset.splits import DataLayout, split_kind

CARD_FILE = "README.md"
"""Name that the hub gives the card."""
_SIZES = ("K", "M", "B", "T")
"""Units of the hub's size categories: powers of 1000."""
_NUMBERS, _INTEGERS = {"list": "float64"}, {"list": "int64"}
_LIGHT = {"map": "string", "yaw": "float64", "exposure": "float64", "direction": _NUMBERS}
_POSE = {"cam_R_m2c": _NUMBERS, "cam_t_m2c": _NUMBERS, "obj_id": "int64", "instance_id": "int64"}
_COUNTS = dict.fromkeys(("px_count_all", "px_count_valid", "px_count_visib"), "int64")
_INFO = {"bbox_obj": _INTEGERS, "bbox_visib": _INTEGERS, **_COUNTS, "visib_fract": "float64"}
_MASK = {"counts": _INTEGERS, "size": _INTEGERS}

_FOREIGN = "\nObjects or light maps are not synpick-warp's own: set `license` to theirs in the copy that you upload.\n"


@dataclass(frozen=True)
class SplitContent:
    """What the dataset card says of a split: names, numbers of views and shards, size [B]."""

    name: str
    """Name on the hub."""
    folder: str
    """Folder of its shards."""
    views: int
    shards: int
    bytes: int
    """Size of all shards [B]."""


@dataclass(frozen=True)
class CardContent:
    """What the dataset card says of a data set: its splits, origin of the objects, image formats, masks, layers and effects."""

    splits: tuple[SplitContent, ...]
    """At least one."""
    embedded: bool
    """Whether objects and light maps are those of synpick-warp; others have licences of their own."""
    color_suffix: str
    """.jpg or .png."""
    masks: bool
    """Whether views have masks."""
    instances: int
    """Maximum number of instances of a view."""
    layers: tuple[str, ...]
    effects: tuple[str, ...]
    """Names of the active camera effects."""
    distorted: bool = False
    """Whether a camera has a lens that distorts."""
    lens_note: str = ""
    """See `describe_lenses`."""


def hub_splits(layout: DataLayout) -> tuple[str, ...]:
    """Names of the splits on the hub, for each of `DataLayout.folders`: val is called validation there, unless another split is."""
    names = [split.name for split in layout.splits] or [split_kind(layout.split)]
    return tuple("validation" if name == "val" and "validation" not in names else name for name in names)


def make_card(content: CardContent) -> str:
    """Text of README.md. It leaves out splits without shards, unless none has any: a pattern that matches no file is an error."""
    splits = [split for split in content.splits if split.shards] or content.splits
    views, shards, size = (sum(getattr(split, name) for split in splits) for name in ("views", "shards", "bytes"))
    split, folder = splits[0].name, splits[0].folder
    files = (f"\n  - split: {each.name}\n    path: {each.folder}/shard-*.tar" for each in splits)
    header = "\n".join(
        (
            f"license: {'mit' if content.embedded else 'unknown'}",
            "pretty_name: Synthetic bin picking by synpick-warp",
            "task_categories: [object-detection, image-segmentation, depth-estimation, robotics]",
            "tags: [6d-pose-estimation, bin-picking, synthetic, webdataset, bop]",
            f"size_categories: [{size_category(views)}]",
            f"configs:\n- config_name: default\n  data_files:{''.join(files)}",
            "dataset_info:\n  config_name: default\n  features:",
            *_list_features(_features(content), "  "),
        )
    )
    rows = "\n".join(f"| {each.name} | {each.folder} | {each.views:,} | {each.shards:,} | {each.bytes:,} |" for each in splits)
    licence = "" if content.embedded else _FOREIGN
    return f"""---
{header}
---
# Synthetic bin picking
{content.lens_note}
{views:,} views in {shards:,} webdataset shards of {size:,} bytes in all, made by synpick-warp:
colour, 16-bit depth, 6D poses, boxes and masks as in the BOP challenge. One shard is one camera's scene; `dataset_info.md` has
the conventions and the objects.

| split | folder | views | shards | bytes |
|---|---|---|---|---|
{rows}
{licence}
    datasets.load_dataset("DIR", split="{split}")
    datasets.load_dataset("webdataset", data_dir="DIR/{folder}", data_files="*.tar", split="train")
    webdataset.WebDataset("DIR/{folder}/shard-000000.tar").decode(synpick_warp.webdataset.decode_view)

The first line has the columns' types from this file; the second infers them from the first views, which fails or loses masks if
later scenes have more objects. `datasets` reads 16-bit depth whole (Pillow's mode I;16), but colour layers of 16 bits as 8: cast
these columns to `Image(decode=False)`, and decode their bytes by `decode_view`.
"""


def size_category(views: int) -> str:
    """The hub's size category of a number of examples: n<1K, 1K<n<10K, ..., n>1T."""
    if views < 1000:
        return "n<1K"
    power = min(len(str(views)) - 1, 12)
    if power == 12:
        return "n>1T"
    return f"{_count(power)}<n<{_count(power + 1)}"


def _count(power: int) -> str:
    """Power of ten in short form, such as 10K."""
    return f"{10 ** (power % 3)}{_SIZES[power // 3 - 1]}"


def _features(content: CardContent) -> dict[str, object]:
    """Columns of the card's table with their types: a type's name, a structure or a list."""
    camera = {"cam_K": _NUMBERS, "cam_R_w2c": _NUMBERS, "cam_t_w2c": _NUMBERS, "depth_scale": "float64", "light": _LIGHT}
    if content.distorted:
        camera |= {"cam_dist_model": "string", "cam_dist": _NUMBERS}
    if content.effects:
        camera["effects"] = dict.fromkeys(content.effects, "float64")
    masks = {str(index): _MASK for index in range(content.instances)}
    return {
        f"rgb{content.color_suffix}": "image",
        "depth.png": "image",
        "camera.json": camera,
        "gt.json": {"list": _POSE},
        "gt_info.json": {"list": _INFO},
        **({"mask.json": masks, "mask_visib.json": masks} if content.masks else {}),
        **{f"{name}.png": "image" for name in content.layers},
        "__key__": "string",
        "__url__": "string",
    }


def _list_features(features: dict[str, object], indent: str) -> Iterator[str]:
    """Yield lines of YAML of the features, as `datasets.Features` reads them."""
    for name, kind in features.items():
        yield f'{indent}- name: "{name}"'
        yield from _describe_type(kind, f"{indent}  ")


def _describe_type(kind: object, indent: str) -> Iterable[str]:
    """YAML lines of a feature's type in the dataset card: plain, struct or list."""
    if not isinstance(kind, dict):
        return (f"{indent}dtype: {kind}",)
    if set(kind) != {"list"}:
        return (f"{indent}struct:", *_list_features(kind, indent))
    if isinstance(kind["list"], str):
        return (f"{indent}list: {kind['list']}",)
    return (f"{indent}list:", *_list_features(kind["list"], indent))
