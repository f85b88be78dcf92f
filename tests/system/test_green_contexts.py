"""SM partitions of a GPU: placement of kernels, and errors of drivers that do not support them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from synpick_warp.errors import DeviceError
from synpick_warp.system.hardware import green_contexts
from synpick_warp.system.hardware.green_contexts import SmPartition

BLOCKS, SPINS = 4096, 2000
GPU = SimpleNamespace(alias="cuda:0", ordinal=0, sm_count=132)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned index;
    asm volatile("mov.u32 %0, %%smid;" : "=r"(index));
    return static_cast<wp::int32>(index);
#else
    return 0;
#endif
""")
def multiprocessor() -> int:
    """Index of the multiprocessor on which the thread runs."""


@wp.kernel(enable_backward=False)
def count_blocks_kernel(spins: int, blocks_out: wp.array[int]):
    """Histogram of threads over multiprocessors (multiprocessor). Threads spin, so that the grid spreads over all that it may use."""
    x = float(wp.tid())
    for _ in range(spins):
        x = wp.sin(x) + 1.0
    wp.atomic_add(blocks_out, multiprocessor() + wp.min(0, int(x)), 1)


def find_multiprocessors(device: wp.Device, stream: wp.Stream, captured: bool = False) -> set[int]:
    """Multiprocessors that the blocks of a kernel on `stream` run on, or of a graph in which another stream forks to it and joins it."""
    blocks = wp.zeros(2 * device.sm_count, dtype=int, device=device)

    def launch() -> None:
        with wp.ScopedStream(stream, sync_exit=True):
            wp.launch(count_blocks_kernel, dim=32 * BLOCKS, inputs=[SPINS], outputs=[blocks], block_dim=32, device=device)

    launch()
    if captured:
        with wp.ScopedStream(wp.Stream(device), sync_exit=True):
            with wp.ScopedCapture(device) as capture:
                launch()
            blocks.zero_()
            wp.capture_launch(capture.graph)
    found = blocks.numpy()
    assert int(found.sum()) == 32 * BLOCKS
    return set(np.flatnonzero(found).tolist())


@pytest.mark.parametrize("reserved", [8, 24])
def test_kernels_on_a_stream_of_a_partition_leave_the_other_multiprocessors_free(device, reserved):
    if not device.is_cuda:
        pytest.skip("a CPU has no multiprocessors")
    partition = SmPartition(device, reserved)
    assert partition.size + partition.reserved == device.sm_count
    assert partition.reserved >= reserved
    main, kept = (find_multiprocessors(device, partition.make_stream(on_reserved)) for on_reserved in (False, True))
    assert (len(main), len(kept)) == (partition.size, partition.reserved)
    assert not main & kept
    assert find_multiprocessors(device, wp.Stream(device)) == main | kept
    assert find_multiprocessors(device, partition.make_stream(on_reserved=True), captured=True) == kept


def test_more_multiprocessors_than_there_are_cannot_be_reserved(device):
    if not device.is_cuda:
        pytest.skip("a CPU has no multiprocessors")
    with pytest.raises(DeviceError, match="cuDevSmResourceSplitByCount failed"):
        SmPartition(device, 2 * device.sm_count)


SPLIT = ("cuDeviceGet", "cuDeviceGetDevResource", "cuDevSmResourceSplitByCount", "cuDevResourceGenerateDesc", "cuGreenCtxCreate")
"""Driver functions that create a partition, in call order."""


@pytest.fixture
def drive(monkeypatch):
    """Factory that replaces the CUDA driver by a fake with the first functions of SPLIT; the last one returns `code`. Records all calls."""

    def install(functions: int, code: int = 0) -> list[tuple[str, tuple]]:
        calls: list[tuple[str, tuple]] = []
        names = SPLIT[:functions]
        driver = {
            name: lambda *arguments, name=name: calls.append((name, arguments)) or code * (name == names[-1])  # type: ignore[func-returns-value]
            for name in names
        }
        monkeypatch.setattr(green_contexts, "_load_driver", lambda: SimpleNamespace(**driver))
        return calls

    return install


@pytest.mark.parametrize("functions", range(1, len(SPLIT)))
def test_an_old_driver_has_no_partitions(drive, functions):
    drive(functions)
    expected = rf"cuda:0: the driver has no {SPLIT[functions]}: green contexts with streams need CUDA 12\.5"
    with pytest.raises(DeviceError, match=expected):
        SmPartition(GPU, 8)


def test_a_driver_of_cuda_12_4_has_partitions_without_streams(drive):
    drive(len(SPLIT))
    with pytest.raises(DeviceError, match="the driver has no cuGreenCtxStreamCreate"):
        SmPartition(GPU, 8).make_stream()


def test_a_device_that_cannot_be_divided_is_an_error_of_one_line(drive):
    calls = drive(3, code=801)
    with pytest.raises(DeviceError, match=r"^cuda:0: cuDevSmResourceSplitByCount failed with CUDA error 801$"):
        SmPartition(GPU, 24)
    assert [name for name, _ in calls] == list(SPLIT[:3])
    assert calls[-1][1][-1] == 24
