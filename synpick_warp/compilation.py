"""Ahead-of-time compilation of the kernels that a bake launches, beside each other and with their number known."""

from __future__ import annotations

import warp as wp

from synpick_warp.codes import Status
from synpick_warp.kernels.sim.snapshot import take_snapshot_kernel
from synpick_warp.progress import Progress
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import FrameStream, TickReader
from synpick_warp.system.kernels import DryLaunches, compile_modules, variant_of


def is_compiled(device: wp.Device) -> bool:
    """Whether a bake has run on this machine before, by a kernel that every bake launches."""
    return variant_of(take_snapshot_kernel, device).is_cached()


def compile_launches(simulation: Simulation, stream: FrameStream | None, progress: Progress) -> int:
    """Compile and load what `launch_all` launches and the kernel cache lacks.

    Args:
        simulation: New worlds; afterwards they are as new again, but for contents of scratch arrays.
        stream: Renderer and encoders; None: nothing is rendered.
        progress: Receives "compiling kernels: 14 of 37 modules".

    Returns:
        The number of compiled modules.
    """
    with DryLaunches() as dry:
        launch_all(simulation, stream)
    simulation.forget_graphs()
    return compile_modules(dry.variants, lambda ready, count: progress.stage(f"compiling kernels: {ready} of {count} modules"))


def launch_all(simulation: Simulation, stream: FrameStream | None) -> None:
    """Launch every kernel of simulation, perception, renderer and encoders once."""
    record = simulation.records[0]
    for _ in range(2):  # A GPU runs the first tick kernel by kernel, and captures the graph of the second.
        simulation.tick(record)
    if simulation.perception is not None:
        simulation.perception.load_kernels(record.snapshot)
    reader = TickReader(record)
    reader.start()
    report = reader.wait()
    if stream is not None:
        report.status[:, Status.LIVE] = 1
        for views in stream.render(record.snapshot, report):
            len(views)
    wp.synchronize_device(simulation.device)
