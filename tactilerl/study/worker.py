"""The process of one run: `python -m tactilerl.study.worker BASE RANKS FLAGS...`.

It holds the run's lock as long as it lives, so that a run whose `study run` was killed is not
begun a second time beside itself. Exit codes are those of `tactilerl train`, and BUSY.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import filelock

from .. import cli
from ..config import LAYOUT_COPY
from .folder import RunFiles

BUSY = 75  # EX_TEMPFAIL: somebody else trains this run
PATIENCE = 2.0  # s; who only looks at a lock has it for an instant


def main(arguments: list[str]) -> int:
    """Train one run, from where it stands."""
    base, ranks, flags = arguments[0], int(arguments[1]), arguments[2:]
    files = RunFiles(Path(base))
    try:
        with filelock.FileLock(files.lock_file, timeout=PATIENCE):
            return _train(files, ranks, flags)
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
    launch = [launcher, "-n", str(ranks), sys.executable, "-m", "tactilerl.cli"]
    return subprocess.run([*launch, *command], check=False).returncode


def _drop_stillborn(files: RunFiles) -> None:
    """Remove a folder whose process died before it had written anything to keep."""
    if files.base.is_dir() and all(
        path.name in (LAYOUT_COPY, ".lock") or path.suffix == ".tmp" for path in files.base.iterdir()
    ):
        shutil.rmtree(files.base)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
