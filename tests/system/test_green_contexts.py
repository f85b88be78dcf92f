"""Partitions of a GPU: where kernels run, and what happens where a GPU cannot be divided."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import warp as wp

from synpick_warp.errors import DeviceError
from synpick_warp.system import green_contexts
from synpick_warp.system.green_contexts import SmPartition

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
    """Count the threads of each multiprocessor (multiprocessor); each thread takes a while."""
    x = float(wp.tid())
    for _ in range(spins):
        x = wp.sin(x) + 1.0
    wp.atomic_add(blocks_out, multiprocessor() + wp.min(0, int(x)), 1)


@pytest.mark.parametrize("reserved", [8, 24])
def test_kernels_on_a_stream_of_a_partition_leave_the_other_multiprocessors_free(device, reserved):
    if not device.is_cuda:
        pytest.skip("a CPU has no multiprocessors")
    partition = SmPartition(device, reserved)
    assert partition.size + partition.reserved == device.sm_count
    assert partition.reserved >= reserved
    blocks = wp.zeros(2 * device.sm_count, dtype=int, device=device)
    with wp.ScopedStream(partition.make_stream(), sync_exit=True):
        wp.launch(count_blocks_kernel, dim=32 * BLOCKS, inputs=[SPINS], outputs=[blocks], block_dim=32, device=device)
    used = int((blocks.numpy() > 0).sum())
    assert int(blocks.numpy().sum()) == 32 * BLOCKS
    assert used == partition.size
    wp.launch(count_blocks_kernel, dim=32 * BLOCKS, inputs=[SPINS], outputs=[blocks], block_dim=32, device=device)
    assert int((blocks.numpy() > 0).sum()) == device.sm_count


def test_more_multiprocessors_than_there_are_cannot_be_reserved(device):
    if not device.is_cuda:
        pytest.skip("a CPU has no multiprocessors")
    with pytest.raises(DeviceError, match="cuDevSmResourceSplitByCount failed"):
        SmPartition(device, 2 * device.sm_count)


def test_an_old_driver_has_no_partitions(monkeypatch):
    monkeypatch.setattr(green_contexts, "_load_driver", lambda: SimpleNamespace(cuDeviceGet=lambda *_: 0))
    with pytest.raises(DeviceError, match=r"cuda:0: the driver has no cuDeviceGetDevResource: green contexts need CUDA 12\.4"):
        SmPartition(GPU, 8)
    assert SmPartition.leaving(GPU, 0.2) is None


def test_a_device_that_cannot_be_divided_has_no_partitions(monkeypatch):
    calls = []
    names = ("cuDeviceGet", "cuDeviceGetDevResource", "cuDevSmResourceSplitByCount")
    driver = {name: lambda *arguments, name=name: calls.append((name, arguments)) or 801 * (name == names[2]) for name in names}
    monkeypatch.setattr(green_contexts, "_load_driver", lambda: SimpleNamespace(**driver))
    assert SmPartition.leaving(GPU, 2.0 / 11.0) is None
    assert [name for name, _ in calls] == list(names)
    assert calls[-1][1][-1] == 24
