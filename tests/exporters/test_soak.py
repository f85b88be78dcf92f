"""Memory and open files of the writers stay constant (leak test)."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

TICKS = 100
"""A short soak; `python -m tests.harness.soak` runs 10,000. One writer, so that it has run every type of task by half time."""


@pytest.mark.slow(minutes=1)
def test_memory_and_open_files_stay_constant():
    command = [sys.executable, "-m", "tests.harness.soak", "--ticks", str(TICKS), "--writers", "1"]
    process = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True)
    samples = json.loads(process.stdout)
    late = slice(len(samples["memory"]) // 2, None)
    assert len(set(samples["files"][late])) == 1
    assert max(samples["memory"][late]) < 1.02 * min(samples["memory"][late])
