"""The small data set that evaluations share, and its ground truth. Read only."""

from pathlib import Path

import pytest

import synpick_warp
from synpick_warp.apps.evaluation.truth import Truth, read_truth
from tests.worlds.evaluation_set import write_evaluation_set


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_evaluation_set(tmp_path_factory.mktemp("evaluation") / "synpick")


@pytest.fixture(scope="session")
def truth(folder: Path) -> Truth:
    return read_truth(synpick_warp.open(folder))
