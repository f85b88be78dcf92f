"""Cells with cameras of their own: rows of [[camera]] tables, and bakes of boxes that are stirred under them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from synpick_warp.configs.cell.cameras import CameraRow
from synpick_warp.configs.files.table_lists import read_rows
from synpick_warp.configs.schema import Config
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.system.progress import SilentProgress
from synpick_warp.testing.exporters import digests
from tests.builders import STIRRING, boxes, run
from tests.worlds.small_worlds import settings

Point = Sequence[float]


def make_camera(
    name: str, position: Point = (0.0, 0.0, 1.2), look_at: Point = (0.0, 0.0, 0.0), up: Point = (0.0, 1.0, 0.0), **given: object
) -> CameraRow:
    """A camera of 96 x 72 px that looks down at the bin; `given`: other keys of its table, with values as TOML has them."""
    pose = {"position": list(position), "look_at": list(look_at), "up": list(up)}
    (row,) = read_rows("camera", CameraRow, [{"name": name, "resolution": [96, 72], "pose": pose} | given], "in a test")
    return row


SIDE = {"position": (0.0, -0.4, 1.1), "look_at": (0.0, 0.0, 0.1)}
"""Place of a camera beside the bin."""


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> list[list[float]]:
    return [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]


def cell_config(cameras: tuple[CameraRow, ...], **given: object) -> Config:
    """Settings of boxes that are stirred under cameras."""
    return replace(settings(**STIRRING | given), camera=cameras)


def bake_cell(out: Path, config: Config, shard: tuple[int, int] = (0, 1)) -> None:
    """Bake boxes."""
    with boxes():
        run_bake(config, out, SilentProgress(), shard)


def check_valid(folder: Path) -> None:
    """A data set is whole, and `validate` finds no error in it."""
    assert run("verify", folder).code == 0
    ran = run("validate", folder)
    assert (ran.code, "0 errors" in ran.out) == (0, True), ran


def check_same(ours: Path, theirs: Path) -> None:
    """Two data sets have the same bytes, but for their settings."""
    assert {name for name, _ in digests(ours).items() ^ digests(theirs).items()} <= {"config.toml"}


CELL = (
    make_camera(
        "drawn",
        **SIDE,
        matrix=camera_matrix(82.5, 82.38, 49.14, 35.25),
        distortion=[-0.12, 0.08, 0.0005, -0.0003, 0.0],
        jitter={
            "position": {"normal": [0.0, 0.01]},
            "rotation": {"uniform": [-1.0, 1.5]},
            "focal_length": {"choice": [-0.02, 0.03], "weights": [1, 3]},
            "center": {"normal": [0.5, 1.0]},
        },
    ),
    make_camera("still", fov=40.0),
    make_camera("hand", (0.12, 0.02, 0.4), (0.02, 0.0, -0.1), fov=70.0, fixed_to="gripper"),
)
"""Drawn anew by each episode behind a lens, still, and carried by the gripper."""
