"""Usable CPU cores and free memory: the affinity mask, caches and swap, and the limits of control groups in both versions."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.hardware.free_memory import free_host_memory
from tests.harness.fuzz import fuzz_examples
from tests.worlds.model_files import put

MASK = 64
"""Cores of the affinity mask in these tests."""


def write(root: Path, files: dict[str, str]) -> Path:
    """Copies of the kernel's interface files (procfs, cgroupfs) by their paths below `root`; returns `root`."""
    for name, text in files.items():
        put(root / name, text)
    return root


@pytest.fixture(autouse=True)
def mask(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(MASK)))


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, MASK),
        ({"proc/self/cgroup": "0::/job\n", "sys/fs/cgroup/job/cpu.max": "max 100000\n"}, MASK),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "200000 100000\n"}, 2),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "150000 100000\n"}, 2),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "10000 100000\n"}, 1),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": "9900000 100000\n"}, MASK),
        # The tightest of nested groups counts.
        (
            {
                "proc/self/cgroup": "0::/a/b\n",
                "sys/fs/cgroup/a/b/cpu.max": "800000 100000\n",
                "sys/fs/cgroup/a/cpu.max": "300000 100000\n",
            },
            3,
        ),
        (
            {
                "proc/self/cgroup": "4:memory:/docker/1\n3:cpu,cpuacct:/docker/1\n",
                "sys/fs/cgroup/cpu/docker/1/cpu.cfs_quota_us": "400000\n",
                "sys/fs/cgroup/cpu/docker/1/cpu.cfs_period_us": "100000\n",
            },
            4,
        ),
        (
            {
                "proc/self/cgroup": "3:cpu:/\n",
                "sys/fs/cgroup/cpu/cpu.cfs_quota_us": "-1\n",
                "sys/fs/cgroup/cpu/cpu.cfs_period_us": "100000\n",
            },
            MASK,
        ),
    ],
)
def test_quotas_of_control_groups_limit_the_cores_of_the_mask(files, cores, tmp_path):
    assert count_cores(write(tmp_path, files)) == cores


MEMINFO = "MemTotal:       1000 kB\nMemAvailable:    800 kB\nSwapFree:        50 kB\n"


@pytest.mark.parametrize(
    ("files", "kibibytes"),
    [
        ({}, 850),
        ({"proc/self/cgroup": "0::/a/b\n", "sys/fs/cgroup/a/memory.max": "max\n", "sys/fs/cgroup/a/memory.current": "1024\n"}, 850),
        (
            {
                "proc/self/cgroup": "0::/a/b\n",
                "sys/fs/cgroup/a/memory.max": f"{600 * 1024}\n",
                "sys/fs/cgroup/a/memory.current": f"{500 * 1024}\n",
                "sys/fs/cgroup/a/memory.stat": f"anon 7\ninactive_file {100 * 1024}\n",
            },
            250,
        ),
        ({"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/memory.max": "2048\n", "sys/fs/cgroup/memory.current": "4096\n"}, 50),
        (
            {
                "proc/self/cgroup": "5:cpu:/x\n4:memory:/docker/1\n",
                "sys/fs/cgroup/memory/memory.limit_in_bytes": f"{300 * 1024}",
                "sys/fs/cgroup/memory/memory.usage_in_bytes": f"{100 * 1024}",
            },
            250,
        ),
    ],
)
def test_free_memory_counts_caches_swap_and_the_limits_of_control_groups(files, kibibytes, tmp_path):
    assert free_host_memory(write(tmp_path, {"proc/meminfo": MEMINFO, **files})) == kibibytes * 1024


@given(
    st.text(alphabet="0123456789 max-²\n", max_size=20),
    st.dictionaries(st.sampled_from(("memory.max", "memory.current", "memory.stat")), st.binary(max_size=40)),
    st.binary(max_size=40),
)
@hypothesis_settings(max_examples=fuzz_examples(50), deadline=None)
def test_any_text_in_the_files_of_control_groups_gives_a_number(tmp_path_factory, quota, files, groups):
    root = write(tmp_path_factory.mktemp("root"), {"proc/meminfo": MEMINFO, "proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": quota})
    assert 1 <= count_cores(root) <= MASK
    (root / "proc/self/cgroup").write_bytes(b"0::/\n" + groups)
    for name, content in files.items():
        (root / "sys/fs/cgroup" / name).write_bytes(content)
    assert 0 <= free_host_memory(root) <= 850 * 1024
