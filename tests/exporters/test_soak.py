"""The writers of all formats keep neither memory nor open files of what they have written."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

TICKS = 100
"""A short soak; `python -m tests.reference.soak` makes 10,000. One writer, so that it has done all kinds of work by half time."""


def test_memory_and_open_files_stay_as_they_are():
    command = [sys.executable, "-m", "tests.harness.soak", "--ticks", str(TICKS), "--writers", "1"]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    late = slice(len(found["memory"]) // 2, None)
    assert len(set(found["files"][late])) == 1
    assert max(found["memory"][late]) < 1.02 * min(found["memory"][late])
