"""The process of one run: `python -m tactilerl.study.worker PARENT BASE RANKS FLAGS...`.

It ends with its parent, and what it started with it. It holds the run's lock as long as it lives, so
that a run whose `study run` was killed is not begun a second time beside itself. Exit codes are those
of `tactilerl train`, and BUSY.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import filelock

from ..commands import cli
from ..runs.config import LAYOUT_COPY
from ..terminal import interrupts
from .folder import PATIENCE, RunFiles

BUSY = 75  # EX_TEMPFAIL: somebody else trains this run


def main(arguments: list[str]) -> int:
    """Train one run, from where it stands."""
    parent, base, ranks, *flags = arguments
    interrupts.end_with(int(parent))
    files = RunFiles(Path(base))
    try:
        with filelock.FileLock(files.lock_file, timeout=PATIENCE):
            return _train(files, int(ranks), flags)
    except filelock.Timeout:
        return BUSY


def _train(files: RunFiles, ranks: int, flags: list[str]) -> int:
    if not files.exists:
        _drop_stillborn(files)
    where = ["--resume" if files.exists else "--out", str(files.base)]
    command = ["train", *flags, *where]
    if ranks == 1:
        return cli.main(command)
    launcher = shutil.which("mpirun") or str(Path(sys.executable).with_name("mpirun"))
    launch = [launcher, "-n", str(ranks), sys.executable, "-m", "tactilerl"]
    return _launched([*launch, *command])


def _launched(command: list[str]) -> int:
    """Exit code of an MPI launch, which is told of every signal that ends us, and ends first."""
    ends = partial(interrupts.end_with, os.getpid())
    child = subprocess.Popen(command, preexec_fn=ends)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, _: child.send_signal(number))
    return child.wait()


def _drop_stillborn(files: RunFiles) -> None:
    """Remove a folder whose process died before it had written anything to keep."""
    if files.base.is_dir() and all(
        path.name in (LAYOUT_COPY, ".lock") or path.suffix == ".tmp" for path in files.base.iterdir()
    ):
        shutil.rmtree(files.base)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
