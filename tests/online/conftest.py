"""Streams and bakes of the same small settings: two episodes of boxes."""

from __future__ import annotations

import pytest

from synpick_warp.configs.schema import LAYERS
from synpick_warp.factory import assembly
from tests.worlds.small_worlds import catalog, settings

TINY = {
    "bake__worlds": 2,
    "bake__episodes": 2,
    "cameras__resolution": [64, 36],
    "physics__step": 4e-3,
    "physics__steps_per_tick": 16,
    "physics__substeps": 1,
    "physics__iterations": 6,
    "move__speed": 4.0,
}
LAYERED = TINY | {"render__layers": list(LAYERS)}


@pytest.fixture(scope="module", autouse=True)
def boxes():
    """All objects here are boxes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(assembly, "load_catalog", lambda config, report: catalog())
        yield


def tiny(**overrides: object):
    return settings(**TINY | overrides)
