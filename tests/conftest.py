"""What all tests share."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import settings

from synpick_warp.device import pick_device, start_warp

ROOT = Path(__file__).resolve().parent.parent
REAL_DATA = ROOT.parent / "shared" / "data"
"""Real objects and lights, where somebody has put them beside the checkout; tests that want them are skipped elsewhere."""

# Examples follow from the test's name, so that two runs do the same; compiling a kernel may take any time.
settings.register_profile("house", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("house")


def pytest_configure() -> None:
    """Start Warp before the first test, so that its messages stay out of captured output."""
    start_warp()


@pytest.fixture(scope="session")
def device():
    """The processor: tests must pass on machines without a GPU, and to the bit."""
    return pick_device("cpu")


@pytest.fixture(scope="session")
def real_models() -> Path:
    """Folder of the 21 YCB-Video objects in BOP's layout."""
    return _real("ycbv_models")


@pytest.fixture(scope="session")
def real_lights() -> Path:
    """Folder of Radiance maps and sIBL sets."""
    return _real("hdri")


def _real(name: str) -> Path:
    folder = REAL_DATA / name
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}")
    return folder
