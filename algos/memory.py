"""How much memory may this process still take? What is free, within its container's limit."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import psutil

# Limit, use, and the part of the use that Linux gives back when it is short (memory.stat).
VERSIONS = (
    ("", "memory.max", "memory.current", "inactive_file"),  # cgroup v2
    ("memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),  # v1
)


def available(root: Path = Path("/")) -> int:
    """Bytes that are free on this machine and within every limit (cgroup v1, v2) on this process."""
    return min([psutil.virtual_memory().available, *_left(root)])


def _left(root: Path) -> Iterator[int]:
    """What is left of the limits of this process's groups and of those around them."""
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:  # not Linux
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        for controller, *names in VERSIONS:
            if controller not in controllers.split(","):
                continue
            top = root / "sys/fs/cgroup" / controller
            group = top / path.strip("/")  # in a container the group itself may be mounted at the top
            for folder in (group, *group.parents):
                left = _left_in(folder, *names)
                if left is not None:
                    yield left
                if folder == top:
                    break


def _left_in(folder: Path, limit: str, use: str, kind: str) -> int | None:
    """Bytes left in one group; None where it has no limit."""
    try:
        allowed, used = ((folder / name).read_text().strip() for name in (limit, use))
        stat = dict(line.split() for line in (folder / "memory.stat").read_text().splitlines())
    except OSError:
        return None
    if allowed == "max":
        return None
    return max(0, int(allowed) - int(used) + int(stat.get(kind, 0)))
