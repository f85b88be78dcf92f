"""Compilation ahead of launches: dry launches run nothing and name modules; these are compiled once, in threads."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import warp as wp

from synpick_warp.system import kernels
from synpick_warp.system.kernels import DryLaunches, ModuleBuild, build_of, compilation_lock, compile_modules

MODULES = 3


def make_kernel(factor: float) -> wp.Kernel:
    """A kernel in a module of its own."""
    constant = wp.constant(factor)

    @wp.kernel(module="unique")
    def scale_kernel(values: wp.array[float]):
        values[wp.tid()] *= constant

    return scale_kernel


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    """A kernel cache of this test's own."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    return tmp_path


def test_dry_launches_run_nothing_and_list_what_they_would_load(device, empty_cache):
    scale = make_kernel(3.0)
    values = wp.ones(4, dtype=float, device=device)
    load = wp.Module.load
    with DryLaunches() as dry:
        for block in (64, 128, 64):
            wp.launch(scale, dim=4, inputs=[values], device=device, block_dim=block)
        wp.launch(scale, dim=4, inputs=[values], device=device)
    assert wp.Module.load is load
    np.testing.assert_array_equal(values.numpy(), 1.0)
    blocks = (64, 128, 256) if device.is_cuda else (1,)
    assert list(dry.builds) == [ModuleBuild(scale.module, device.alias, block) for block in blocks]
    assert build_of(scale, device) == list(dry.builds)[-1]
    assert list(empty_cache.iterdir()) == []
    wp.launch(scale, dim=4, inputs=[values], device=device)
    np.testing.assert_array_equal(values.numpy(), 3.0)


def test_modules_that_the_cache_lacks_are_compiled_once_and_counted(device, empty_cache):
    scales = [make_kernel(5.0 + index) for index in range(MODULES)]
    builds = [build_of(scale, device) for scale in scales]
    assert not any(build.is_cached() for build in builds)
    reports = []
    assert compile_modules(builds, lambda *counts: reports.append(counts)) == MODULES
    assert reports == [(ready, MODULES) for ready in range(MODULES + 1)]
    assert all(build.is_cached() for build in builds)
    binaries = kernels.list_binaries()
    assert len(binaries) == MODULES
    assert compile_modules(builds, lambda *counts: reports.append(counts)) == 0
    values = wp.ones(4, dtype=float, device=device)
    for scale in scales:
        wp.launch(scale, dim=4, inputs=[values], device=device)
    np.testing.assert_array_equal(values.numpy(), 5.0 * 6.0 * 7.0)
    assert (len(reports), kernels.list_binaries()) == (MODULES + 1, binaries)


def test_a_compiler_that_fails_is_told(device, empty_cache, monkeypatch):
    builds = [build_of(make_kernel(9.0 + index), device) for index in range(MODULES)]

    def fail(*_: object, **__: object) -> None:
        raise RuntimeError("no space left")

    monkeypatch.setattr(wp.Module, "load", fail)
    with pytest.raises(RuntimeError, match="no space left"):
        compile_modules(builds, lambda *_: None)


HOLDER = """
import sys, warp as wp
from synpick_warp.system.kernels import compilation_lock
wp.config.kernel_cache_dir = sys.argv[1]
with compilation_lock(lambda: None):
    print("locked", flush=True)
    sys.stdin.read()
"""


def test_one_process_compiles_and_the_others_wait_for_it(empty_cache):
    """The other process ends, and with it its lock, when this one says that it waits."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(empty_cache)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdin
        assert other.stdout
        assert other.stdout.readline() == "locked\n"
        waited = []
        with compilation_lock(lambda: waited.append(other.stdin.close())):  # type: ignore[union-attr]
            assert len(waited) == 1
    with compilation_lock(lambda: waited.append(None)):
        assert len(waited) == 1


def test_a_cache_that_cannot_be_locked_is_used_unlocked(tmp_path, monkeypatch):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "missing"))
    with compilation_lock(lambda: pytest.fail("nobody holds it")):
        pass
    assert not (tmp_path / "missing").exists()
