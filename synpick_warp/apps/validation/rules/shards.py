"""Rules about webdataset shards and the imagewise layout; their annotations and images also meet the rules of scenes and views."""

from __future__ import annotations

from synpick_warp.apps.validation.registry import Findings, rule
from synpick_warp.apps.validation.scene_files import KeyedScene
from synpick_warp.apps.validation.subjects import ViewSubject
from synpick_warp.dataset.bop.keyed import KEY, KeyedFolder
from synpick_warp.dataset.bop.layout import KEYED, KEYS

MAX_VIEWS = 1000
"""Most views of a shard, as in BOP's webdataset layout."""


@rule(KeyedFolder, "shard-index", "list the keys of each shard again, or restore the shard")
def check_index(folder: KeyedFolder) -> Findings:
    """key_to_shard.json maps every key SSSSSS_IIIIII to the index of the shard that contains it, and no others."""
    keys, fault = folder.keys
    if fault:
        yield folder.listing.name(KEYS), fault
    if keys is None:
        return
    places = {key: shard for shard, found in folder.members.items() if isinstance(found, set) for key in found}
    damaged = {shard for shard, found in folder.members.items() if isinstance(found, str)}
    for key, index in keys.items():
        shard = f"shard-{index:06d}.tar"
        if not KEY.fullmatch(key):
            yield folder.listing.name(KEYS), f'key "{key[:40]}" is not SCENE_IMAGE of six digits each'
        elif shard not in folder.members:
            yield folder.listing.name(KEYS), f"key {key}: there is no {shard}"
        elif shard not in damaged and places.get(key) != shard:
            yield folder.listing.name(KEYS), f"key {key} is in {places.get(key, 'no shard')}, not in {shard}"
    for key in sorted(places.keys() - keys.keys()):
        yield folder.listing.name(KEYS), f"key {key} of {places[key]} is missing"


@rule(KeyedFolder, "shard-files", "write the shard again, without links or other files")
def check_shards(folder: KeyedFolder) -> Findings:
    """Shards are tar files of regular members named KEY.CONTENT, with at most 1000 views each."""
    for shard, found in folder.members.items():
        if isinstance(found, str):
            yield folder.listing.name(shard), found
        elif len(found) > MAX_VIEWS:
            yield folder.listing.name(shard), f"{len(found)} views"
    for name in sorted(folder.listing.files) if not folder.shards else ():
        if not KEYED.fullmatch(name) and name != KEYS:
            yield folder.listing.name(name), "a file name that is not KEY.CONTENT"


@rule(ViewSubject, "mask-entries", "write one entry for each ground-truth index")
def check_entries(view: ViewSubject) -> Findings:
    """KEY.mask.json and KEY.mask_visib.json have run lengths of every instance."""
    if isinstance(view.scene.files, KeyedScene):
        for kind, masks in view.masks.items():
            faults = {file for file, _ in view.faults}
            for index, mask in enumerate(masks):
                file = view.scene.files.file(kind, view.image, index)
                if mask is None and file not in faults:
                    yield file, f"missing; there are {len(masks)} instances"
