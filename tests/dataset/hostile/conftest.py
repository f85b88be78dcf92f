"""Fixtures of a finished data set of all formats, baked without simulation, and of merges that write in the test's process."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from synpick_warp.dataset.commit import merge as merging
from synpick_warp.exporters.writing.pool import WriterPool
from tests.harness.scripted_bake import bake, small_settings


@pytest.fixture(scope="module")
def inline() -> Iterator[None]:
    """Merges write in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(merging, "WriterPool", lambda _, size, handle: WriterPool(0, size, handle))
        yield


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished data set."""
    out = tmp_path_factory.mktemp("ready") / "set"
    bake(out, small_settings())
    return out
