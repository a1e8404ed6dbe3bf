"""How many cores may this process use? Those it is allowed, within its container's quota of time."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from ..algos.mpi import Communicator


def free_cores(comm: Communicator | None = None, root: Path = Path("/")) -> int:
    """Cores that this process may use without taking one from the other ranks here, if any.

    However busy they are: what a run does by default does not depend on what else runs.
    """
    cores = os.cpu_count() or 1
    own = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else cores
    shared = min(cores, *_quotas(root), math.inf) // (comm or Communicator()).local_size
    return max(1, min(own, int(shared)))


def _quotas(root: Path) -> Iterator[int]:
    """Limits, in cores, of this process's control groups and of those around them (cgroup v1, v2)."""
    listed = root / "proc/self/cgroup"
    for line in listed.read_text().splitlines() if listed.exists() else ():  # not only Linux
        _, controllers, path = line.split(":", 2)
        if controllers and "cpu" not in controllers.split(","):
            continue
        group = root / "sys/fs/cgroup" / ("cpu" if controllers else "") / path.strip("/")
        names = ("cpu.cfs_quota_us", "cpu.cfs_period_us") if controllers else ("cpu.max",)
        for folder in (group, *group.parents):  # in a container the group is mounted at the top
            with suppress(OSError, ValueError):  # no group, or one without a limit: "max"
                quota, period = map(int, " ".join((folder / n).read_text() for n in names).split())
                if quota > 0:  # -1: none
                    yield math.ceil(quota / period)
