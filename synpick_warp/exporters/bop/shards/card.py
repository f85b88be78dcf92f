"""Dataset card of shards: README.md with the YAML header that the Hugging Face hub, its viewer and the package `datasets` read.

The header declares each split's files, as key_to_shard.json lies beside them, and the columns' types: inferred ones come from the first
views, and miss masks of scenes with more objects, or find nothing but null where a later scene has a light's direction.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from synpick_warp.configs.cell.rig import lens_map
from synpick_warp.configs.dataset import DataLayout, ExportSettings, split_kind
from synpick_warp.exporters.writing.notes import describe_lenses

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


class SplitContent(NamedTuple):
    """What the dataset card says of a split: name on the hub, folder of its shards, numbers of views and shards, their size [B]."""

    name: str
    folder: str
    views: int
    shards: int
    bytes: int


def hub_splits(layout: DataLayout) -> tuple[str, ...]:
    """Names of the splits on the hub, for each of `DataLayout.folders`: val is called validation there, unless another split is."""
    names = [split.name for split in layout.splits] or [split_kind(layout.split)]
    return tuple("validation" if name == "val" and "validation" not in names else name for name in names)


def make_card(settings: ExportSettings, contents: Sequence[SplitContent]) -> str:
    """Text of README.md. It leaves out splits without shards, unless none has any: a pattern that matches no file is an error."""
    # Objects and light maps that are not synpick-warp's have licences of their own.
    embedded = not (settings.bake.models or settings.bake.lights)
    splits = [split for split in contents if split.shards] or contents
    views, shards, size = (sum(getattr(split, name) for split in splits) for name in ("views", "shards", "bytes"))
    split, folder = splits[0].name, splits[0].folder
    files = (f"\n  - split: {each.name}\n    path: {each.folder}/shard-*.tar" for each in splits)
    header = "\n".join(
        (
            f"license: {'mit' if embedded else 'unknown'}",
            "pretty_name: Synthetic bin picking by synpick-warp",
            "task_categories: [object-detection, image-segmentation, depth-estimation, robotics]",
            "tags: [6d-pose-estimation, bin-picking, synthetic, webdataset, bop]",
            f"size_categories: [{size_category(views)}]",
            f"configs:\n- config_name: default\n  data_files:{''.join(files)}",
            "dataset_info:\n  config_name: default\n  features:",
            *_list_features(_features(settings), "  "),
        )
    )
    rows = "\n".join(f"| {each.name} | {each.folder} | {each.views:,} | {each.shards:,} | {each.bytes:,} |" for each in splits)
    licence = "" if embedded else _FOREIGN
    return f"""---
{header}
---
# Synthetic bin picking
{describe_lenses(settings)}
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
    power = len(str(views)) - 1
    if power < 3:
        return "n<1K"
    low, high = (f"{10 ** (each % 3)}{_SIZES[min(each, 12) // 3 - 1]}" for each in (power, power + 1))
    return f"{low}<n<{high}" if power < 12 else "n>1T"


def _features(settings: ExportSettings) -> dict[str, object]:
    """Columns of the card's table with their types: a type's name, a structure or a list."""
    camera = {"cam_K": _NUMBERS, "cam_R_w2c": _NUMBERS, "cam_t_w2c": _NUMBERS, "depth_scale": "float64", "light": _LIGHT}
    if any(lens_map(row) is not None for row in settings.rig.rows):
        camera |= {"cam_dist_model": "string", "cam_dist": _NUMBERS}
    if settings.effects:
        camera["effects"] = dict.fromkeys(settings.effects, "float64")
    masks = {str(index): _MASK for index in range(settings.objects)}
    return {
        f"rgb.{settings.bop.color_format}": "image",
        "depth.png": "image",
        "camera.json": camera,
        "gt.json": {"list": _POSE},
        "gt_info.json": {"list": _INFO},
        **({"mask.json": masks, "mask_visib.json": masks} if settings.bop.masks else {}),
        **{f"{name}.png": "image" for name in settings.render.layers},
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
