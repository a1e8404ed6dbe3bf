"""How much memory may this process still take? What is free, within its container's limit."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import psutil

# Limit, use, and the part of the use that Linux gives back when it is short (memory.stat).
VERSIONS = {
    "": ("memory.max", "memory.current", "inactive_file"),  # cgroup v2
    "memory": ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),  # v1
}


def available(root: Path = Path("/")) -> int:
    """Bytes that are free on this machine and within every limit (cgroup v1, v2) on this process."""
    return min([psutil.virtual_memory().available, *_left(root)])


def _left(root: Path) -> Iterator[int]:
    """What is left of the limits of this process's groups and of those around them."""
    listed = root / "proc/self/cgroup"
    for line in listed.read_text().splitlines() if listed.exists() else ():  # not only Linux
        _, controllers, path = line.split(":", 2)
        for controller in VERSIONS.keys() & controllers.split(","):
            limit, use, kind = VERSIONS[controller]
            group = root / "sys/fs/cgroup" / controller / path.strip("/")
            for folder in (group, *group.parents):  # in a container the group is mounted at the top
                with suppress(OSError, ValueError):  # no group, or one without a limit: "max"
                    allowed, used = (int((folder / name).read_text()) for name in (limit, use))
                    stat = (folder / "memory.stat").read_text().split()
                    given_back = dict(zip(stat[::2], stat[1::2], strict=True)).get(kind, 0)
                    yield max(0, allowed - used + int(given_back))
