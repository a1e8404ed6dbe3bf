"""With which versions was this made? Those of the packages, and the commit of our own source."""

from __future__ import annotations

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TypedDict

from ..envs.simulators import SIMULATORS
from ..version import __version__

HERE = Path(__file__).resolve().parents[1]
PACKAGES = ("torch", "numpy", "gymnasium", "gymnasium-robotics", "mpi4py")


class Origin(TypedDict):
    """From where on a run was made with what."""

    epoch: int
    """The last one that was made with something else."""
    env_steps: int
    versions: dict[str, str]
    commit: str | None
    """Of the repository that our source belongs to, with "-dirty" where files differ from it; None when
    it is installed from a wheel."""


def origin(epoch: int = 0, env_steps: int = 0) -> Origin:
    """What is here now."""
    return {
        "epoch": epoch,
        "env_steps": env_steps,
        "versions": versions(),
        "commit": commit(HERE),
    }


def versions(*more: str) -> dict[str, str]:
    """Of Python, our own, our packages and `more` of them, as far as they are installed."""
    found = {"tactilerl": __version__, "python": platform.python_version()}
    for package in (*PACKAGES, *SIMULATORS, *more):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def difference(before: Origin, now: Origin) -> str:
    """What changed, in words; nothing when nothing did."""
    a, b = before["versions"], now["versions"]
    changed = [
        f"{name} {a.get(name, 'none')} -> {b.get(name, 'none')}"
        for name in {**a, **b}
        if a.get(name) != b.get(name)
    ]
    if before["commit"] != now["commit"]:
        changed.append(
            "commit {} -> {}".format(*(short(r["commit"]) for r in (before, now)))
        )
    return ", ".join(changed)


def short(commit: str | None) -> str:
    """As people write a commit; a "-dirty" stays."""
    name, dash, dirty = (commit or "none").partition("-")
    return f"{name[:12]}{dash}{dirty}"


def commit(folder: Path) -> str | None:
    """The commit of the repository that tracks this package in `folder`, with "-dirty" where files of
    it were changed since.

    None where none does: a virtual environment may lie inside somebody else's repository.
    """
    env = {
        name: value for name, value in os.environ.items() if not name.startswith("GIT_")
    }
    describe = ["describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    found = ""
    for command in (["ls-files", "--error-unmatch", "__init__.py"], describe):
        try:
            result = subprocess.run(
                ["git", "-C", str(folder), *command],
                env=env, capture_output=True, text=True, timeout=5, check=True,
            )  # fmt: skip
        except (OSError, subprocess.SubprocessError):
            return None
        found = result.stdout.strip()
    return found
