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
MEMINFO = "MemTotal:       1000 kB\nMemAvailable:    800 kB\nSwapFree:        50 kB\n"


def interface(root: Path, groups: str | None, files: dict[str, str]) -> Path:
    """The kernel's interface below `root`, which is returned: memory, the control groups of this process (None: no file), and theirs."""
    put(root / "proc/meminfo", MEMINFO)
    if groups is not None:
        put(root / "proc/self/cgroup", groups)
    for name, text in files.items():
        put(root / "sys/fs/cgroup" / name, text)
    return root


@pytest.fixture(autouse=True)
def mask(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(MASK)))


@pytest.mark.parametrize(
    ("groups", "files", "cores"),
    [
        (None, {}, MASK),
        ("0::/job\n", {"job/cpu.max": "max 100000\n"}, MASK),
        ("0::/\n", {"cpu.max": "200000 100000\n"}, 2),
        ("0::/\n", {"cpu.max": "150000 100000\n"}, 2),
        ("0::/\n", {"cpu.max": "10000 100000\n"}, 1),
        ("0::/\n", {"cpu.max": "9900000 100000\n"}, MASK),
        # The tightest of nested groups counts.
        ("0::/a/b\n", {"a/b/cpu.max": "800000 100000\n", "a/cpu.max": "300000 100000\n"}, 3),
        (
            "4:memory:/docker/1\n3:cpu,cpuacct:/docker/1\n",
            {"cpu/docker/1/cpu.cfs_quota_us": "400000\n", "cpu/docker/1/cpu.cfs_period_us": "100000\n"},
            4,
        ),
        ("3:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, MASK),
    ],
)
def test_quotas_of_control_groups_limit_the_cores_of_the_mask(groups, files, cores, tmp_path):
    assert count_cores(interface(tmp_path, groups, files)) == cores


LIMITED = {"a/memory.max": f"{600 * 1024}\n", "a/memory.current": f"{500 * 1024}\n"}
DOCKER = {"memory/memory.limit_in_bytes": f"{300 * 1024}", "memory/memory.usage_in_bytes": f"{100 * 1024}"}


@pytest.mark.parametrize(
    ("groups", "files", "kibibytes"),
    [
        (None, {}, 850),
        ("0::/a/b\n", {"a/memory.max": "max\n", "a/memory.current": "1024\n"}, 850),
        ("0::/a/b\n", LIMITED | {"a/memory.stat": f"anon 7\ninactive_file {100 * 1024}\n"}, 250),
        ("0::/\n", {"memory.max": "2048\n", "memory.current": "4096\n"}, 50),
        ("5:cpu:/x\n4:memory:/docker/1\n", DOCKER, 250),
    ],
)
def test_free_memory_counts_caches_swap_and_the_limits_of_control_groups(groups, files, kibibytes, tmp_path):
    assert free_host_memory(interface(tmp_path, groups, files)) == kibibytes * 1024


@given(
    st.text(alphabet="0123456789 max-²\n", max_size=20),
    st.dictionaries(st.sampled_from(("memory.max", "memory.current", "memory.stat")), st.binary(max_size=40)),
    st.binary(max_size=40),
)
@hypothesis_settings(max_examples=fuzz_examples(50), deadline=None)
def test_any_text_in_the_files_of_control_groups_gives_a_number(tmp_path_factory, quota, files, groups):
    root = interface(tmp_path_factory.mktemp("root"), "0::/\n", {"cpu.max": quota})
    assert 1 <= count_cores(root) <= MASK
    (root / "proc/self/cgroup").write_bytes(b"0::/\n" + groups)
    for name, content in files.items():
        (root / "sys/fs/cgroup" / name).write_bytes(content)
    assert 0 <= free_host_memory(root) <= 850 * 1024
