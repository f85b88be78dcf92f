"""Environment maps for USD: EXR files, and the parameters of dome and distant lights."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import OpenEXR

from synpick_warp.errors import OutputError
from synpick_warp.exporters.usd.types import StageLight
from synpick_warp.scenes.environment import (
    BACKGROUND_ROWS,
    LUMINANCE,
    MAX_SUN_TANGENT,
    WHITE_VALUE,
    draw_sun_disc,
    map_directions,
    replace_sun,
    resize_map,
    sun_fraction,
)
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.system.linear_algebra import dot


def light_file(index: int) -> str:
    """Path of an environment map in the asset library."""
    return f"lights/light_{index:03d}.exr"


def make_stage_light(index: int, light: EnvironmentMap, exposure: float) -> StageLight:
    """Describe an environment map, by its index in the bake, as lights of a stage; the intensity reproduces the renderer's automatic
    exposure times `exposure`."""
    radiance, irradiance, radius_tangent = separate_sun(light)
    directions, solid = map_directions(len(radiance))
    upward = np.maximum(directions[..., 2], 0.0) * solid
    white = np.einsum("ij,ijc->c", upward, radiance)
    azimuth = polar = 0.0
    sun: tuple[float, float, float] | None = None
    if light.sun is not None and irradiance.any():
        x, y, z = light.sun.direction
        azimuth, polar = np.degrees(np.arctan2(y, x)), np.degrees(np.arccos(np.clip(z, -1.0, 1.0)))
        white = white + max(z, 0.0) * irradiance
        sun = (float(irradiance[0]), float(irradiance[1]), float(irradiance[2]))
    factor = exposure * WHITE_VALUE * np.pi / max(float(dot(white, LUMINANCE)), 1e-9)
    angle = float(2.0 * np.degrees(np.arctan(radius_tangent)))
    return StageLight(light.name, light_file(index), float(factor), float(azimuth), float(polar), sun, angle)


def write_light_maps(library: Path, lights: tuple[EnvironmentMap, ...]) -> None:
    """Write all maps as EXR files into the asset library; `lights/` must exist.

    By OpenEXR's convention, longitude grows to the left in the image and is 0 at its centre; it equals our azimuth. USD's core supports
    EXR, PNG and JPEG textures; Radiance maps (.hdr) are supported by some renderers only. Raises OutputError.
    """
    for index, light in enumerate(lights):
        image, path = np.ascontiguousarray(separate_sun(light)[0][:, ::-1], dtype=np.float32), library / light_file(index)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "envmap": OpenEXR.ENVMAP_LATLONG}
        try:
            OpenEXR.File(header, {"RGB": image}).write(str(path))
        except RuntimeError as error:
            raise OutputError(f"cannot write {path}: {' '.join(str(error).split())}; free space or rights there") from error


def separate_sun(light: EnvironmentMap) -> tuple[np.ndarray, np.ndarray, float]:
    """Separate an environment map and its sun so that no light counts twice, by the same rule as the renderer.

    The sun has the colour given with the map. Its luminance is the given one or that of the bright region it replaces, whichever is larger.
    Returns the map (H, 2H, 3) without that region, or with a disc in its place if the sun is wide; the sun's irradiance (3), zero if it has
    none or is that disc; tangent of its angular radius.
    """
    sun = light.sun
    if sun is None:
        return light.radiance, np.zeros(3), 0.0
    radiance = light.radiance.astype(np.float64)
    coarse = resize_map(radiance, BACKGROUND_ROWS)
    _, direction, irradiance, radius_tangent = replace_sun(coarse, sun)
    # The fraction of a coarse texel applies to all fine texels within it, so that the same light is removed.
    fraction = sun_fraction(coarse, direction).astype(np.float32)
    rows = len(radiance)
    method = cv2.INTER_AREA if rows <= BACKGROUND_ROWS else cv2.INTER_NEAREST
    fine = cv2.resize(fraction, (2 * rows, rows), interpolation=method).astype(np.float64)
    rest = radiance * (1.0 - fine)[..., None]
    if radius_tangent > MAX_SUN_TANGENT:
        return rest + draw_sun_disc(fine > 0.0, direction, irradiance, radius_tangent), np.zeros(3), radius_tangent
    return rest, irradiance, radius_tangent
