"""Worker process of a validation."""

from __future__ import annotations

from synpick_warp.system.ordered_pool import serve_tasks
from synpick_warp.validation.tasks import State, run_task


def main() -> None:
    """Main function of the process: runs tasks on the data set whose folder is the setup message."""
    serve_tasks(State, lambda state, task: run_task(task, state))
