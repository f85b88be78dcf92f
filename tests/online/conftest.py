"""Streams and bakes of the same small settings: two episodes of boxes."""

import pytest

from synpick_warp.configs.schema import LAYERS
from tests.builders import STIRRING, boxes
from tests.worlds.small_worlds import settings

TINY = STIRRING | {"bake.worlds": 2, "bake.episodes": 2, "cameras.resolution": [64, 36]}
LAYERED = TINY | {"render.layers": list(LAYERS)}


@pytest.fixture(scope="module", autouse=True)
def all_boxes():
    """All objects here are boxes."""
    with boxes():
        yield


def tiny(**overrides: object):
    return settings(**TINY | {key.replace("__", "."): value for key, value in overrides.items()})
