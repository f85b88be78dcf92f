"""The server of quick bakes, which loads all kernels once."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.harness.bake_server import BakeServer


@pytest.fixture(scope="session")
def server() -> Iterator[BakeServer]:
    with BakeServer() as server:
        yield server
