"""Looks of an episode: its own materials of objects, bin and table, in place of those of the assets."""

# pxr's modules are filled when they are loaded, invisible to type checkers.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from pxr import Usd

from synpick_warp.codes import LookPart
from synpick_warp.exporters.usd.parts import add_property, add_surface
from synpick_warp.exporters.usd.types import AssetSurface, drawn_texture, texture_file
from synpick_warp.scenes.assets.appearance import as_color, linear_to_srgb, srgb_to_linear
from synpick_warp.scenes.types import Material
from synpick_warp.system.linear_algebra import DECIMALS, dot

WHITE = (1.0, 1.0, 1.0)
_PARTS = {"Tote": LookPart.BIN, "Bin": LookPart.BIN, "Table": LookPart.TABLE, "Floor": LookPart.BACKGROUND}
"""Part of a scene that a prim shows, by its name."""


def add_looks(stage: Usd.Stage, assets: Mapping[str, str], looks: Mapping[str, Any], surfaces: Mapping[str, AssetSurface]) -> None:
    """Add a material to each prim that references an asset whose look the episode has drawn.

    Args:
        stage: The episode's stage.
        assets: Asset that each prim references, by path.
        looks: Record of the episode's looks; empty: none.
        surfaces: Materials by asset.
    """
    for path, part, look in _drawn(assets, looks):
        if look:
            _add_look(stage, path, part, look, surfaces[assets[path]])


def _drawn(assets: Mapping[str, str], looks: Mapping[str, Any]) -> Iterator[tuple[str, LookPart, Mapping[str, Any]]]:
    """Path, part and look of the prims; a look may be empty."""
    rows = dict(enumerate(looks.get("objects", ()))) | {row["instance"]: row for row in looks.get("distractors", ())}
    names = ("color", "metallic", "roughness", "hue", "brightness")
    for path in assets if looks else ():
        name = path.rpartition("/")[2]
        if name in _PARTS:
            yield path, _PARTS[name], looks[_PARTS[name].name.lower()]
        elif name.rpartition("_")[2].isdigit():
            row = rows.get(int(name.rpartition("_")[2]), {})
            yield path, LookPart.OBJECT, {key: row[key] for key in names if key in row}


def _add_look(stage: Usd.Stage, path: str, part: LookPart, look: Mapping[str, Any], surface: AssetSurface) -> None:
    """Add the material of a prim. Shaders of USD cannot turn the hue of a texture: it is a property of the prim then."""
    given, texture = surface.material, surface.texture
    color, gain, repeats = look.get("color", given.color), look.get("brightness", 1.0), 1.0
    if "texture" in look:
        texture, repeats = texture_file(drawn_texture(part, look["texture"])), 1.0 / look["texture_width"]
        color = look.get("color", WHITE)
    if texture is None:
        color = as_color(linear_to_srgb(gain * dot(hue_rotation(look.get("hue", 0.0)), srgb_to_linear(color))))
        gain = 1.0
    elif "hue" in look:
        add_property(stage.GetPrimAtPath(path), "hue", float(look["hue"]))
    material = Material(color, None, look.get("metallic", given.metallic), look.get("roughness", given.roughness))
    add_surface(stage, f"{path}/Materials/Surface", material, texture and f"assets/{texture}", gain, repeats)


def hue_rotation(degrees: float) -> np.ndarray:
    """Rotation (3, 3) of linear colours about the grey axis, as the renderer's."""
    cosine, sine = np.round([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)) / np.sqrt(3.0)], DECIMALS)
    cross = np.array([[0.0, -sine, sine], [sine, 0.0, -sine], [-sine, sine, 0.0]])
    return cosine * np.eye(3) + (1.0 - cosine) / 3.0 + cross
