"""Trains the runs of a study, each in a process of its own: a run that crashes takes nobody with it.

A job is "make this run done": it can be asked for twice, and by anybody who sees the study's folder.
"""

from __future__ import annotations

import concurrent.futures
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import filelock

from ..envs import plugins
from ..errors import BAD_INPUT, BUSY
from ..files import no_link
from ..terminal import interrupts
from .grid import Run
from .records import StudyFiles

ATTEMPTS = 2
LOOK = 1.0  # s between looks at what runs
PATIENCE = 5.0  # s until what others train is asked for again; a killed worker's run ends meanwhile
INTERRUPTED = (130, -signal.SIGINT)
LAUNCHER_PREFIXES = ("OMPI_", "PMIX_", "PMI_", "PRTE_", "HYDRA_", "MPI_LOCAL")
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
# What a process of a run does first: from then on it ends with its parent, by whatever name it goes.
BEGIN = "import os, sys; from tactilerl.terminal import interrupts; "
BEGIN += "interrupts.end_with(int(sys.argv[1])); os.execv(sys.argv[2], sys.argv[2:])"
Ending = Literal["done", "failed", "busy", "interrupted"]

_children: set[subprocess.Popen[bytes]] = set()
_stopping = threading.Event()


@dataclass(frozen=True)
class RunJob:
    """A run that is to be done; can be pickled."""

    folder: Path
    """Of the study; absolute, where other machines are to find it."""
    run: Run
    ranks: int = 1
    cwd: Path | None = None
    """Where files that its flags name are looked for; None: here."""
    imports: tuple[str, ...] = field(default_factory=lambda: (*plugins.imported,))
    """Modules that are to be imported first."""

    def command(self, *program: str, launcher: str = "mpirun") -> list[str]:
        """What trains it by this `program`, and goes on where it was cut off."""
        out = StudyFiles(self.folder).run_dir(self.run).path
        command = [*program, "train", *self.run.arguments, "--out", str(out)]
        modules = dict.fromkeys((*self.imports, *self.run.modules))
        command += [f"--import={module}" for module in modules]
        return (
            [launcher, "-n", str(self.ranks), *command] if self.ranks > 1 else command
        )


def run_job(job: RunJob) -> Ending:
    """Train one run to its end; a failure is tried once more. What has ended or what another process
    trains is left as it is."""
    files = StudyFiles(job.folder)
    try:
        with filelock.FileLock(files.beside(job.run, "lock"), timeout=0):
            state = files.record(job.run).state
            if state == "running":
                return "busy"
            return state if state in ("done", "failed") else _train(files, job)
    except filelock.Timeout:
        return "busy"
    except OSError as error:
        error.add_note(f"run {job.run.name}")
        raise


def _train(files: StudyFiles, job: RunJob) -> Ending:
    log, code, begin = files.beside(job.run, "log"), 1, 0
    for _ in range(ATTEMPTS):
        begin = log.stat().st_size if log.exists() else 0
        code = INTERRUPTED[0] if _stopping.is_set() else _process(log, job)
        if _stopping.is_set() or code in INTERRUPTED:
            return "interrupted"
        if code == BUSY:
            return "busy"
        if code in (0, BAD_INPUT):  # which a second attempt cannot mend
            break
    if code == 0 and files.record(job.run).state == "done":
        return "done"
    files.write_failure(job.run, _reason(code, log, begin))
    return "failed"


def _process(log_file: Path, job: RunJob) -> int:
    launcher = shutil.which("mpirun") or str(Path(sys.executable).with_name("mpirun"))
    command = job.command(sys.executable, "-m", "tactilerl", launcher=launcher)
    with open(log_file, "ab", opener=no_link) as log:
        child = subprocess.Popen(
            [sys.executable, "-c", BEGIN, str(os.getpid()), *command],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=_environment(),
            cwd=job.cwd,
        )
    _children.add(child)
    if _stopping.is_set():  # since the last look
        child.terminate()
    try:
        return child.wait()
    finally:
        _children.discard(child)


def _environment() -> dict[str, str]:
    """One thread a run; and it is no rank of the launch that started the study."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(LAUNCHER_PREFIXES)}
    allowed = {
        k: v for k, v in os.environ.items() if k.startswith("OMPI_ALLOW_RUN_AS_ROOT")
    }
    return kept | allowed | dict.fromkeys(THREADS, "1")


def _reason(code: int, log_file: Path, begin: int) -> str:
    """Why a run failed, in a line: the signal, or the last thing that it said itself, which is in the
    log from `begin` on."""
    if code < 0:
        names = {each.value: each.name for each in signal.Signals}
        return f"killed by {names.get(-code, f'signal {-code}')}"
    lines = log_file.read_bytes()[begin:].decode("utf-8", errors="replace").splitlines()
    own = [line for line in lines if line.startswith("tactilerl: ")]
    said = own or [line for line in lines if line.strip()] or [""]
    return f"{said[-1].removeprefix('tactilerl: ').strip()[:300]} (exit code {code})"


@contextmanager
def threads(n: int) -> Iterator[concurrent.futures.Executor]:
    """`n` jobs at a time on this machine: a job waits for its process, so threads are enough."""
    try:
        with concurrent.futures.ThreadPoolExecutor(n) as pool, _stopped_by_signals():
            try:
                yield pool
            except BaseException:  # end the runs' processes; each keeps its last epoch
                _stopping.set()
                pool.shutdown(wait=False, cancel_futures=True)
                for child in list(_children):
                    child.terminate()
                raise
    finally:
        _stopping.clear()


@contextmanager
def _stopped_by_signals() -> Iterator[None]:
    """Ctrl-C ends the runs in order, and so does SIGTERM, which batch systems send before they kill."""

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        with interrupts.in_order():
            yield
    finally:
        signal.signal(signal.SIGTERM, before)
