"""Ahead-of-time compilation of the kernels of a bake, in parallel threads and with progress."""

from __future__ import annotations

from contextlib import AbstractContextManager

import warp as wp

from synpick_warp.codes import Status
from synpick_warp.kernels.render.visibility.wide_bvh import read_binary_bvh_kernel
from synpick_warp.kernels.sim.snapshot import take_snapshot_kernel
from synpick_warp.newton_patches.narrow_phase import slow_builds
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import FrameStream, read_tick
from synpick_warp.system.hardware.kernels import Compiler, build_of, compilation_lock, dry_launches
from synpick_warp.system.progress import Progress


def is_cache_warm(device: wp.Device) -> bool:
    """Whether the kernel cache is warm: it has a kernel that every bake launches, and that is compiled after all others.

    Kernels that other settings need may still be missing.
    """
    return build_of(take_snapshot_kernel, device).is_cached()


def sole_compiler(progress: Progress) -> AbstractContextManager[None]:
    """Lock under which one process at a time compiles; see `compilation_lock`."""
    return compilation_lock(lambda: progress.stage("waiting for another process, which compiles kernels"))


def make_compiler(device: wp.Device | None, progress: Progress) -> Compiler:
    """A compiler that reports "compiling kernels: 14 of 37 modules"; it compiles the kernel of `is_cache_warm` last.

    Without a device it has no such kernel, and only reports what launches compile: a warm cache lacks kernels of other settings.
    """
    last = None if device is None else build_of(take_snapshot_kernel, device)
    return Compiler(lambda ready, total: progress.stage(f"compiling kernels: {ready} of {total} modules"), last)


def submit_slow(compiler: Compiler, device: wp.Device) -> None:
    """Start to compile what every bake needs and takes longest, before worlds are built that launch it."""
    compiler.submit([build_of(read_binary_bvh_kernel, wp.get_device("cpu")), *slow_builds(device)])


def submit_launches(compiler: Compiler, simulation: Simulation, stream: FrameStream | None) -> None:
    """Start to compile what `launch_all` launches.

    Args:
        simulation: Worlds that have not ticked yet. No kernel runs, so that their state stays; contents of scratch arrays may change.
        stream: Renderer and encoders; None: nothing is rendered.
    """
    with dry_launches() as builds:
        launch_all(simulation, stream)
    simulation.clear_graphs()
    compiler.submit(builds)


def launch_all(simulation: Simulation, stream: FrameStream | None) -> None:
    """Launch every kernel of simulation, perception, renderer and encoders once."""
    record = simulation.record
    for _ in range(2):  # The first tick launches kernels one by one and captures graphs; the second launches the graphs.
        simulation.tick()
    if simulation.perception is not None:
        simulation.perception.load_kernels(record.snapshot)
    report = read_tick(record)
    if stream is not None:
        report.status[:, Status.LIVE] = 1
        for views in stream.render(record.snapshot, report):
            len(views)
    wp.synchronize_device(simulation.device)
