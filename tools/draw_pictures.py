"""Generator of the documentation's pictures: layers of a view, an animated pick, grids of training views, a robot cell (CELL.md).

Bakes (simulates and renders) four small data sets of embedded objects under embedded environment maps, and runs the first code blocks of
configs/CELL.md, in a temporary folder; takes some minutes on a GPU, and hours on a CPU.

    python -m tools.draw_pictures                     # into tools/pictures/
    python -m tools.draw_pictures --out DIR --device cuda:0
"""

import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from PIL import Image as PillowImage

import synpick_warp
from synpick_warp.apps.viz.drawing import FONT, color_depth, draw_layer, instance_color, put_text, write_picture
from synpick_warp.dataset.reading import Episode
from synpick_warp.dataset.view import View
from synpick_warp.errors import SynpickError
from tools.options import fail, make_parser

PICTURES = Path(__file__).resolve().parent / "pictures"
PAGE = PICTURES.parents[1] / "configs" / "CELL.md"
STRIP, PICK, TABLES, USED, CELL = "strip.jpg", "pick.gif", "tables.jpg", "used.jpg", "cell.jpg"
COMMON = {"bake.worlds": 1, "bake.episodes": 1, "bop.split": "train", "bop.color_format": "png", "bop.coco": False}
STRIP_SETTINGS = COMMON | {
    "bake.mode": "move",
    "arrangement.counts": {"bracket": 40},
    "move.speed": 0.8,
    "cameras.resolution": [960, 540],
    "cameras.positions": [[0.0, 0.0, 2.0]],
    "cameras.ups": [[0.0, 1.0, 0.0]],
    "render.layers": ["normals", "flow"],
}
PICK_SETTINGS = COMMON | {
    "bake.mode": "pick",
    "bake.worlds": 2,
    "bake.episodes": 2,
    "arrangement.counts": {"bracket": 40},
    "pick.failures": 1,
    "gripper.kind": "suction_array",
    "gripper.cups": [[0.0, -0.013], [0.0, 0.013]],
    "gripper.cup_width": 0.018,
    "gripper.finger_width": 0.05,
    "suction.radius": 0.007,
    # The first camera is the one that perception uses; the second is drawn.
    "cameras.resolution": [800, 450],
    "cameras.fov": 34.0,
    "cameras.positions": [[0.0, 0.0, 1.6], [0.38, -0.52, 0.92]],
    "cameras.ups": [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
}
TABLE_COLUMNS = 4
"""Columns of the grid of training views."""
TABLE_SETTINGS = {"bake.worlds": 8, "bake.episodes": 8, "bop.coco": False}
"""One episode for each of the eight cameras of `tabletop-train`."""
USED_SETTINGS = {"bake.mode": "still", "still.views": 0, "bake.worlds": 8, "bake.episodes": 8, "bop.coco": False, "render.coarse_paths": 8}
USED_SETTINGS |= {"cameras.resolution": [480, 270], "cameras.positions": [[0.0, -0.8, 1.8]], "cameras.ups": [[0.0, 0.0, 1.0]]}
BAKES = (
    ("strip", "bracket-bin", STRIP_SETTINGS),
    ("pick", "bracket-bin", PICK_SETTINGS),
    ("tables", "tabletop-train", TABLE_SETTINGS),
    ("used", "bracket-bin", USED_SETTINGS),
)
"""Folder, preset and settings of each bake."""
PANEL = (480, 270)
"""Width and height of an image in the strip [px]."""
CAPTION_SCALE = 0.5
CELL_WIDTH, STEPS = 1000, 3
"""Width of the picture of the cell [px], and number of code blocks of the page that make it: its files, a mesh, the rendered cell."""
GIF_WIDTH, GIF_COLORS, GIF_STRIDE, FRAME_RATE = 400, 96, 2, 15
"""Width [px], palette size, episode frames per GIF frame, and frame rate of episodes [Hz]: the GIF has 7.5 Hz, in real time."""
LEAD_OUT = 6
"""Frames after the end of the attempt."""

Image = np.ndarray
"""(H, W, 3) uint8, blue first."""


def main(arguments: list[str] | None = None) -> int:
    """Bake, draw, write; returns the exit code."""
    parser = make_parser(__doc__, "device")
    parser.add_argument("--out", type=Path, default=PICTURES, help="folder of the pictures (default: tools/pictures)")
    options = parser.parse_args(arguments)
    device = {"bake.device": options.device}
    try:
        with tempfile.TemporaryDirectory() as folder:
            for name, preset, settings in BAKES:
                synpick_warp.bake(preset, Path(folder) / name, settings | device)
            baked = {name: list(synpick_warp.open(Path(folder) / name).values()) for name, _, _ in BAKES}
            print(write_picture(options.out / STRIP, draw_strip(*baked["strip"])))
            print(write_animation(options.out / PICK, draw_pick(baked["pick"][-1])))
            print(write_picture(options.out / TABLES, draw_training_views(baked["tables"])))
            print(write_picture(options.out / USED, draw_training_views(baked["used"])))
            print(write_picture(options.out / CELL, draw_cell(Path(folder))))
    except SynpickError as error:
        return fail("draw_pictures", error)
    return 0


def draw_strip(episode: Episode) -> Image:
    """Two rows of panels: colour, depth, visible masks, amodal masks, normals and flow of the view with the most motion."""
    view = max(episode.views(camera=0), key=lambda view: float(np.nansum(np.abs(view.layer("flow")))))
    panels = {
        "RGB": view.rgb[..., ::-1],
        "depth": color_depth(view.depth),
        "instances": draw_masks(view, view.masks),
        "amodal masks": draw_masks(view, view.amodal_masks, outline=True),
        "normals": draw_layer("normals", view.layer("normals"))[1],
        "optical flow": draw_layer("flow", view.layer("flow"))[1],
    }
    small = [captioned(cv2.resize(panel, PANEL, interpolation=cv2.INTER_AREA), name) for name, panel in panels.items()]
    return np.concatenate([np.concatenate(small[:3], axis=1), np.concatenate(small[3:], axis=1)])


def draw_masks(view: View, masks: np.ndarray, outline: bool = False) -> Image:
    """Masks in their instances' colours over the darkened grey image; with `outline` half transparent with contours, for overlaps."""
    gray = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY)
    picture = np.repeat((gray // 3)[..., None], 3, axis=2)
    for instance, mask in zip(view.instance_ids.tolist(), masks, strict=True):
        color = np.array(instance_color(instance), np.uint8)
        if outline:
            contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            picture[mask] = picture[mask] // 2 + color // 4
            cv2.drawContours(picture, contours, -1, color.tolist(), 3, cv2.LINE_AA)
        else:
            picture[mask] = color
    return picture


def captioned(image: Image, text: str) -> Image:
    """The image with its name on a dark ground in the lower left corner."""
    picture = np.ascontiguousarray(image)
    (width, height), _ = cv2.getTextSize(text, FONT, CAPTION_SCALE, 1)
    picture[-height - 14 :, : width + 16] //= 4
    put_text(picture, text, (8, picture.shape[0] - 8), CAPTION_SCALE, (255, 255, 255))
    return picture


def draw_training_views(episodes: list[Episode]) -> Image:
    """Grid of views: the first frame of each episode, seen by the camera with the episode's index, or the only one."""
    views = [episode.view(0, camera=camera % len(episode.cameras)).rgb[..., ::-1] for camera, episode in enumerate(episodes)]
    rows = [np.concatenate(views[first : first + TABLE_COLUMNS], axis=1) for first in range(0, len(views), TABLE_COLUMNS)]
    return np.concatenate(rows)


def draw_pick(episode: Episode) -> list[Image]:
    """Frames of the episode's first successful attempt, seen from the side. Raises SynpickError: no attempt succeeded."""
    attempt = next((attempt for attempt in episode.attempts if attempt["picked"]), None)
    if attempt is None:
        raise SynpickError("no attempt of the episode picked anything; choose another seed")
    last = min(attempt["end_frame"] + LEAD_OUT, len(episode))
    frames = [episode.view(frame, camera=1).rgb for frame in range(attempt["frame"], last, GIF_STRIDE)]
    height = round(GIF_WIDTH * frames[0].shape[0] / frames[0].shape[1])
    return [cv2.resize(frame, (GIF_WIDTH, height), interpolation=cv2.INTER_AREA)[..., ::-1] for frame in frames]


def draw_cell(folder: Path) -> Image:
    """Render the robot cell of the documentation: the first STEPS code blocks of the page, run in `folder`, write CELL/cell.png. Raises
    SynpickError if a block fails."""
    command, root = f'synpick-warp() {{ {shlex.quote(sys.executable)} -m synpick_warp "$@"; }}\n', str(PAGE.parents[1])
    for language, text in re.findall(r"```(bash|python)\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[:STEPS]:
        program = [sys.executable, "-c", text] if language == "python" else ["bash", "-e", "-c", command + text]
        done = subprocess.run(program, cwd=folder, env=os.environ | {"PYTHONPATH": root}, capture_output=True, text=True)
        if done.returncode:
            raise SynpickError(f"a block of {PAGE.name} failed: {done.stderr.strip().splitlines()[-1:]}")
    with PillowImage.open(folder / "CELL" / "cell.png") as image:
        picture = np.array(image.convert("RGB"))[..., ::-1]
    return cv2.resize(picture, (CELL_WIDTH, round(CELL_WIDTH * picture.shape[0] / picture.shape[1])), interpolation=cv2.INTER_AREA)


def write_animation(path: Path, frames: list[Image]) -> Path:
    """Write frames as an endlessly looping GIF with one palette, that of the middle frame."""
    pictures = [PillowImage.fromarray(np.ascontiguousarray(frame[..., ::-1])) for frame in frames]
    palette = pictures[len(pictures) // 2].quantize(GIF_COLORS)
    first, *rest = (picture.quantize(palette=palette, dither=PillowImage.Dither.NONE) for picture in pictures)
    path.parent.mkdir(parents=True, exist_ok=True)
    first.save(path, save_all=True, append_images=rest, duration=round(1000 * GIF_STRIDE / FRAME_RATE), loop=0, optimize=True)
    return path


if __name__ == "__main__":
    sys.exit(main())
