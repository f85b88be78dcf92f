"""Clear coat and anisotropy of glTF materials; textures count by their means."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.asset_files import Notes
from synpick_warp.scenes.assets.gltf import document as schema
from synpick_warp.scenes.types import Finish
from synpick_warp.system.linear_algebra import DECIMALS

_TOLERANCE = 1e-3
"""Factors may exceed 0..1 by rounding."""
_MAX_ROTATION = 1e4
"""Largest rotation [rad]."""
_ALONG_U = (1.0, 0.5, 1.0)
"""Value of a texture of anisotropy for the direction of growing u, at full strength."""
_TILT = 1e-3
"""Growth of v along -z, relative to that along y, so that it grows on a surface that faces up, too."""


def read_finish(
    extensions: schema.MaterialExtensions, texture: Callable[[schema.TextureInfo], np.ndarray | None], notes: Notes, path: Path
) -> Finish:
    """Clear coat and anisotropy of a material of the file `path`. `texture` decodes an image (H, W, 3) uint8, None: it is missing. What is
    not used is added to `notes`. Raises CatalogError: a value is out of range."""
    coat, brushed = extensions.clearcoat, extensions.anisotropy
    given = {name: getattr(coat, name) for name in ("clearcoatFactor", "clearcoatRoughnessFactor")}
    for name, value in (given | {"anisotropyStrength": brushed.anisotropyStrength}).items():
        if not -_TOLERANCE <= value <= 1.0 + _TOLERANCE:
            raise CatalogError(f"{path}: {name} is {value:g}; allowed: 0 to 1; correct the material")
    if not abs(brushed.anisotropyRotation) <= _MAX_ROTATION:
        raise CatalogError(
            f"{path}: anisotropyRotation is {brushed.anisotropyRotation:g}; allowed: up to {_MAX_ROTATION:.0f}; correct the material"
        )

    def mean(info: schema.TextureInfo | None, what: str, default: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> np.ndarray:
        """Mean of a texture (3), 0 to 1."""
        notes.ignored += [] if info is None else [f"the texture of {what} but for its mean"]
        image = None if info is None else texture(info)
        return np.array(default) if image is None else image.reshape(-1, 3).mean(axis=0) / 255.0

    values = [0.0, 0.0, 0.0, 0.0]
    if coat.clearcoatFactor > 0.0:
        values[0] = coat.clearcoatFactor * mean(coat.clearcoatTexture, "clearcoat")[0]
        values[1] = coat.clearcoatRoughnessFactor * mean(coat.clearcoatRoughnessTexture, "clearcoat roughness")[1]
        notes.ignored += [] if coat.clearcoatNormalTexture is None else ["the normal map of clearcoat"]
    if brushed.anisotropyStrength > 0.0:
        x, y, share = mean(brushed.anisotropyTexture, "anisotropy", _ALONG_U)
        values[2:] = brushed.anisotropyStrength * share, brushed.anisotropyRotation + np.arctan2(y - 0.5, x - 0.5).round(DECIMALS)
    factor, roughness, strength = (float(np.clip(value, 0.0, 1.0)) for value in values[:3])
    return Finish(factor, roughness if factor else 0.0, strength, float(values[3]) if strength else 0.0)


@np.errstate(invalid="ignore")
def brush_coordinates(vertices: np.ndarray, given: np.ndarray | None) -> np.ndarray:
    """Texture coordinates (V, 2), v up, of an anisotropic material without textures: those `given`, v down. Without them u is around the y
    axis, which is up in glTF, and v along it: highlights stretch horizontally, and along x on a surface that faces up. They are scaled to
    0.25..0.75, which changes no direction, so that they stay in the part's block of a texture atlas."""
    x, y, z = vertices.T
    uv = np.stack([np.arctan2(x, z).round(DECIMALS), y - _TILT * z], axis=1) if given is None else given * (1.0, -1.0)
    return 0.5 + 0.25 * uv / np.abs(uv).max(axis=0, initial=np.finfo(np.float64).tiny)
