"""Camera files (camera.json), and the card dataset_info.md of data sets without the formats bop and shards, which write their own."""

import json
from collections.abc import Mapping
from pathlib import Path

from synpick_warp.configs.cell.cameras import lens_map
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.scenes.types import Camera

_INTRINSICS = ("`camera.json` has the intrinsics of all cameras", "`camera_NAME.json` has the intrinsics of each camera")
"""Where intrinsics are: of cameras with the same ones, and of cameras listed one by one."""
CAMERA_FILE, NOTES_FILE = "camera.json", "dataset_info.md"


def note_files(layout: DataLayout) -> tuple[Path, ...]:
    """Files that `write_notes` writes, relative to the data set; none if the format bop or shards writes its own."""
    return () if {"bop", "shards"} & set(layout.formats) else tuple(map(Path, (CAMERA_FILE, *camera_files(layout), NOTES_FILE)))


def camera_files(layout: DataLayout) -> tuple[str, ...]:
    """Names of one file per camera, like camera.json, if the settings list cameras one by one ([[camera]] tables); else none."""
    return tuple(f"camera_{name}.json" for name in layout.names) if layout.is_listed else ()


def write_cameras(out: Path, layout: DataLayout, cameras: tuple[Camera, ...], depth_scale: float) -> None:
    """Write camera.json (the first camera) and `camera_files`: size, intrinsics [px], mm per depth unit; distortion and shutter if any."""
    for name, camera in ((CAMERA_FILE, cameras[0]), *zip(camera_files(layout), cameras, strict=False)):
        (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
        content = {"width": camera.width, "height": camera.height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "depth_scale": depth_scale}
        (out / name).write_text(json.dumps(content | camera.sensor, indent=2) + "\n", encoding="ascii")


def describe_sizes(layout: DataLayout, cameras: tuple[Camera, ...]) -> str:
    """Text fragment on image sizes: one for all cameras, or each with its camera's name."""
    if not layout.is_listed:
        return f"{cameras[0].width} x {cameras[0].height} pixels"
    return ", ".join(f"{camera.width} x {camera.height} ({camera.name})" for camera in cameras) + " pixels"


def describe_lenses(settings: ExportSettings) -> str:
    """Warning at the top of data set cards: images are rectified (`bop.rectified`), or those of some cameras distorted; else empty."""
    if settings.bop.rectified:
        return """
**Pictures are rectified** (`bop.rectified`): those of pinhole cameras with the same `cam_K`, without the distortion of the
calibrations. Undistort real pictures to the same matrix, as `cv2.undistort(picture, K, coefficients)` does.
"""
    rig = settings.rig
    bent = ", ".join(name for name, row in zip(rig.names, rig.rows, strict=True) if lens_map(row) is not None)
    text = f"""
**Pictures are distorted** by the lens of {bent}: points are projected into them by `cam_K` with `cam_dist` (OpenCV's
coefficients of `cam_dist_model`), not by `cam_K` alone. For readers that know no distortion, bake with `bop.rectified = true`.
"""
    return text if bent else ""


def write_notes(out: Path, settings: ExportSettings, names: Mapping[int, str], cameras: tuple[Camera, ...]) -> list[Path]:
    """Write `note_files`, replacing existing ones; returns their paths. `names` are those of the objects by obj_id."""
    places = note_files(settings.layout)
    if places:
        write_cameras(out, settings.layout, cameras, settings.bop.depth_scale)
        (out / NOTES_FILE).write_text(_describe(settings, names, cameras), encoding="utf-8", newline="\n")
    return list(places)


def _describe(settings: ExportSettings, names: Mapping[int, str], cameras: tuple[Camera, ...]) -> str:
    """Text of dataset_info.md: conventions, cameras and objects."""
    bake = settings.bake
    objects = "\n".join(f"| {index} | {name} |" for index, name in sorted(names.items()))
    poses = "\n".join(f"| {index} | {_row(one.rotation.ravel())} | {_row(one.translation)} |" for index, one in enumerate(cameras))
    lenses, pictures = describe_lenses(settings), describe_sizes(settings.layout, cameras)
    return f"""# A SynPick data set
{lenses}
Made by synpick-warp (mode {", ".join(settings.modes)}, seed {bake.seed}, {len(cameras)} cameras, formats
{", ".join(sorted(bake.formats))}). Frames are {settings.physics.tick_time:g} s apart.

- Pictures have {pictures}{"" if lenses else " and no lens distortion"}; {_INTRINSICS[settings.layout.is_listed]}.
  The centre of pixel (row, column) is (column + 0.5, row + 0.5): for OpenCV and Open3D, whose pixel centres have whole
  coordinates, subtract 0.5 from cx and cy. Cameras have x right, y down, z forward.
- The world is the {settings.bins[0].noun}'s frame: centre of its inner floor, z up, metres.
- `config.toml` has all settings, `episodes.jsonl` a line an episode, `attempts.jsonl` one for each attempt to pick.

| camera | world to camera, row-major | translation [m] |
|---|---|---|
{poses}

| obj_id | name |
|---|---|
{objects}
"""


def _row(values: object) -> str:
    """Numbers as comma-separated text, rounded to 1e-9 and to nine digits, without -0."""
    return ", ".join(f"{value:.9g}" for value in (0.0 + round(float(value), 9) for value in values))  # type: ignore[attr-defined]
