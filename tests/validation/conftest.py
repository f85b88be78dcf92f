"""Fixtures of small data sets to validate: of boxes, rendered analytically, as scenes and shards."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from synpick_warp.apps.validation.registry import Violation
from synpick_warp.apps.validation.run import Summary, ValidationOptions, validate
from tests.harness import scripted_bake
from tests.worlds import box_views

WIDTH, HEIGHT = 200, 150


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A correct data set: an episode of two frames in three cameras, with masks, COCO annotations, shards and picks. Read only."""
    out = tmp_path_factory.mktemp("validation") / "set"
    config = scripted_bake.settings(1, ("bop", "shards", "picks"))
    cameras = dataclasses.replace(config.cameras, resolution=(WIDTH, HEIGHT))
    bop = dataclasses.replace(config.bop, split="train", color_format="png", masks=True, coco=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scripted_bake, "_LENSES", box_views.cameras(WIDTH, HEIGHT))
        scripted_bake.bake(out, dataclasses.replace(config, cameras=cameras, bop=bop), picks=True)
    return out


@pytest.fixture
def copy(good: Path, tmp_path: Path) -> Path:
    """A copy of the correct data set, to be damaged."""
    return Path(shutil.copytree(good, tmp_path / "set"))


@pytest.fixture(scope="session")
def check() -> Callable[..., list[Violation]]:
    """Validate a folder in this process, rendering every view again."""

    def run(folder: Path, **options: object) -> list[Violation]:
        return list(validate(folder, ValidationOptions(**({"sample": None, "threads": 1} | options)), Summary()))

    return run
