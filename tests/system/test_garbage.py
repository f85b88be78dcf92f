"""Pausing the garbage collection: it goes on as before, whatever ends the block."""

from __future__ import annotations

import contextlib
import gc

import pytest

from synpick_warp.system.processes.garbage import collection_paused


@pytest.mark.parametrize("before", [True, False])
def test_collection_goes_on_as_before(before):
    try:
        (gc.enable if before else gc.disable)()
        with contextlib.suppress(ZeroDivisionError), collection_paused():
            assert not gc.isenabled()
            raise ZeroDivisionError
        assert gc.isenabled() is before
    finally:
        gc.enable()
