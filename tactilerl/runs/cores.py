"""How many cores may this process use?"""

from __future__ import annotations

import os

from ..algos.mpi import Communicator


def free_cores(comm: Communicator | None = None) -> int:
    """Cores that this process may use, within its container's quota (joblib), without taking one from
    the other ranks here, if any.

    However busy they are: what a run does by default does not depend on what else runs.
    """
    from joblib import cpu_count  # which takes a while

    shared = (os.cpu_count() or 1) // (comm or Communicator()).local_size
    return max(1, min(cpu_count(), shared))
