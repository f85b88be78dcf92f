"""Control groups (cgroups) of this process: the kernel's limits for containers, services and batch jobs, in versions 1 and 2."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

_GROUPS = Path("sys/fs/cgroup")


def list_control_groups(controller: str, root: Path) -> Iterator[tuple[int, Path]]:
    """List the groups that limit this process: version (1 or 2) and folder of each, from its own group up to the root of the hierarchy.

    A container sees its own group as the root. Folders may not exist.

    Args:
        controller: "memory" or "cpu".
        root: Folder in which /proc and /sys lie; tests pass another one.
    """
    for line in read_text(root / "proc/self/cgroup").splitlines():
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        parts = [part for part in path.split("/") if part not in ("", "..")]
        if controllers == "":  # Version 2 has one hierarchy for all controllers.
            version, folder = 2, root / _GROUPS
        elif controller in controllers.split(","):
            version, folder = 1, root / _GROUPS / controller
        else:
            continue
        for depth in range(len(parts), -1, -1):
            yield version, folder.joinpath(*parts[:depth])


def read_text(path: Path) -> str:
    """Read a file of the kernel's interface (procfs, cgroupfs); empty text if it cannot be read."""
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError):
        return ""
