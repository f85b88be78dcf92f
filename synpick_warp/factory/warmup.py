"""Ahead-of-time compilation of all kernels that a bake or stream launches, into Warp's kernel cache.

Collision shapes go into their cache on the way.
"""

import time
from dataclasses import dataclass

import warp as wp

from synpick_warp.configs.schema import Config
from synpick_warp.exporters.registry import Needs
from synpick_warp.factory.assembly import build_smallest, launch_all, make_compiler, sole_compiler, submit_launches, submit_slow
from synpick_warp.kernels.render.images.ground_truth import gather_cameras_kernel
from synpick_warp.newton_patches.narrow_phase import take_shipped
from synpick_warp.scenes.collision.shapes import default_cache_dir
from synpick_warp.system.hardware import kernels
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import Progress


@dataclass(frozen=True)
class WarmUp:
    """Result of a warm-up."""

    compiled: int
    """Number of modules that were compiled; the others were in the cache, or are shipped."""
    seconds: float
    """Duration [s]."""


def check_caches() -> None:
    """Raise CacheError unless kernels and collision shapes can be kept: a warm-up into a temporary cache is lost at its end."""
    caches = (
        ("kernel", kernels.kernel_cache(wp.config.version), kernels.KERNEL_VARIABLE),
        ("shape", default_cache_dir() if kernels.user_cache() else None, kernels.USER_VARIABLE),
    )
    for name, folder, variable in caches:
        reason = "the user has no home" if folder is None else kernels.find_fault(folder)
        if reason is not None:
            raise kernels.CacheError(
                f"the {name} cache {folder or '~/.cache'} cannot be written ({reason}), so that a warm-up would be lost; "
                f"set {variable} to a folder that can be written"
            )


def warm_up(config: Config, progress: Progress) -> WarmUp:
    """Compile the kernels of a bake or stream with these settings, then run two ticks and one rendering in the fewest worlds of the device;
    errors as of `synpick_warp.bake`.

    Nothing is written but caches. Kernels depend on the settings only by which of them are used (mode, renderer, layers, formats)."""
    started = time.perf_counter()
    needs = Needs.of(config)
    device = pick_device(config.bake.device)
    with sole_compiler(progress):
        take_shipped(device)
        before = kernels.list_binaries()
        with make_compiler(device, progress) as compiler:
            submit_slow(compiler, device, config)
            compiler.submit([kernels.build_of(gather_cameras_kernel, device)])  # The one module that only the online stream needs.
            factory = build_smallest(config, device, progress)
            stream = factory.stream if needs.views else None
            submit_launches(compiler, factory.simulation, stream)
        launch_all(factory.simulation, stream)
    return WarmUp(len(kernels.list_binaries() - before), time.perf_counter() - started)
