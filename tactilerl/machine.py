"""The cores that a process may use here, and the versions that it runs with."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any

from .envs.simulators import SIMULATORS
from .version import __version__

PACKAGES = ["torch", "numpy", "gymnasium", "gymnasium-robotics", "mpi4py"]
PACKAGES += ["mujoco-warp", "warp-lang"]
WorkerCount = Annotated[int, "[1, 256]"] | None
"""Number of episodes that are played side by side; None: as many as there are free
cores."""


def free_cores(local_ranks: int = 1) -> int:
    """Return how many cores this process may use, at least 1, beside the other MPI ranks here.

    A container's quota counts, but is not divided among ranks. Other processes do not
    count: what a run does by default does not depend on what else runs.
    """
    from joblib import cpu_count  # slow to import

    return max(1, min(cpu_count(), (os.cpu_count() or 1) // local_ranks))


def allow_open_files() -> None:
    """Let this process, and those that it starts, open as many files as the user may; Linux only."""
    if sys.platform == "linux":
        import resource

        _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


def origin() -> dict[str, Any]:
    """Return what a run is made with here and now: versions, and our source's commit.

    The commit ends in "-dirty" where files differ from it; it is None where there is no
    repository.
    """
    commit = _commit(Path(__file__).resolve().parent)
    return {"versions": _versions(), "commit": commit}


@cache
def _versions() -> dict[str, str]:
    """Return the versions of Python, this package and those it uses, where installed."""
    result = {"tactilerl": __version__, "python": platform.python_version()}
    for package in (*PACKAGES, *SIMULATORS):
        try:
            result[package] = version(package)
        except PackageNotFoundError:
            continue
    return result


@cache
def _commit(folder: Path) -> str | None:
    """Return the commit of the repository that tracks this package in `folder`.

    It ends in "-dirty" where tracked files were changed; None where no repository
    tracks the package.
    """
    git = ["git", "-C", str(folder)]
    # A virtual environment may lie inside a repository that does not track it.
    is_tracked = ["ls-files", "--error-unmatch", "__init__.py"]
    describe = ["describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        for command in (is_tracked, describe):
            output = subprocess.check_output(
                [*git, *command], stderr=subprocess.DEVNULL, text=True
            )
    except (OSError, subprocess.SubprocessError):
        return None
    return output.strip()
