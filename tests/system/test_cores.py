"""Usable CPU cores: the affinity mask, and the quotas of control groups in both versions."""

from __future__ import annotations

import os

import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from synpick_warp.system.hardware.cores import count_cores
from tests.harness.fuzz import fuzz_examples
from tests.harness.kernel_files import write

MASK = 64
"""Cores of the affinity mask in these tests."""


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


@given(st.text(alphabet="0123456789 max-²\n", max_size=20))
@hypothesis_settings(max_examples=fuzz_examples(50), deadline=None)
def test_any_text_of_a_quota_gives_a_number_of_cores(tmp_path_factory, text):
    root = write(tmp_path_factory.mktemp("root"), {"proc/self/cgroup": "0::/\n", "sys/fs/cgroup/cpu.max": text})
    assert 1 <= count_cores(root) <= MASK
