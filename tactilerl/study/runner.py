"""Runs the runs of a study: on this machine's cores, or on the ranks of an MPI launch.

Both are executors of `concurrent.futures`' kind. A job waits for the process of its run, so threads
are enough here; a run that crashes takes nobody with it.
"""

from __future__ import annotations

import concurrent.futures
import os
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast

from ..algos import mpi
from ..errors import BAD_INPUT, BUSY, input_errors
from ..runs.files import no_link
from ..terminal import interrupts
from .folder import Outcome, RunFiles

ATTEMPTS = 2
LOOK = 1.0  # s between looks at what runs
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
class Job:
    """All that the process of a run is told; can be pickled."""

    base: Path
    """`RunFiles.base`"""
    arguments: list[str]
    total_timesteps: int
    ranks: int = 1


Watch = Callable[[list[Job], dict[Path, Ending]], None]
"""Is told the jobs that run, and how the others ended."""


def run_job(job: Job) -> Ending:
    """Train one run to its end, in a process of its own; a failure is tried once more.

    What another process trains is left to it.
    """
    files, code, begin = RunFiles(job.base), 1, 0
    try:
        for _ in range(ATTEMPTS):
            begin = files.log_file.stat().st_size if files.log_file.exists() else 0
            code = INTERRUPTED[0] if _stopping.is_set() else _process(files, job)
            if _stopping.is_set() or code in INTERRUPTED:
                return "interrupted"
            if code == BUSY:
                return "busy"
            if code in (0, BAD_INPUT):
                break
        outcome = Outcome("done", job.total_timesteps)
        if code:
            outcome = Outcome("failed", job.total_timesteps, _reason(code, files.log_file, begin))
        files.write_outcome(outcome)
        return outcome.state
    except OSError as error:
        error.add_note(f"run {job.base.name}")
        raise


def _process(files: RunFiles, job: Job) -> int:
    command = [sys.executable, "-m", "tactilerl", "train", *job.arguments, "--out", str(job.base)]
    if job.ranks > 1:
        launcher = shutil.which("mpirun") or str(Path(sys.executable).with_name("mpirun"))
        command = [launcher, "-n", str(job.ranks), *command]
    with open(files.log_file, "ab", opener=no_link) as log:
        child = subprocess.Popen(
            [sys.executable, "-c", BEGIN, str(os.getpid()), *command],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=_environment(),
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
    allowed = {k: v for k, v in os.environ.items() if k.startswith("OMPI_ALLOW_RUN_AS_ROOT")}
    return kept | allowed | dict.fromkeys(THREADS, "1")


def _reason(code: int, log_file: Path, begin: int) -> str:
    """Why a run failed, in a line: the signal, or the last thing that it said itself, which is in the
    log from `begin` on."""
    if code < 0:
        names = {each.value: each.name for each in signal.Signals}
        return f"killed by {names.get(-code, f'signal {-code}')}"
    log = log_file.read_bytes()[begin:].decode("utf-8", errors="replace")
    lines = log.splitlines()
    own = [line for line in lines if line.startswith("tactilerl: ")]
    said = own or [line for line in lines if line.strip()] or [""]
    return f"{said[-1].removeprefix('tactilerl: ').strip()[:300]} (exit code {code})"


@contextmanager
def executor(jobs: int) -> Iterator[concurrent.futures.Executor | None]:
    """Where jobs are submitted to: the other ranks of an MPI launch, or `jobs` threads.

    None on the ranks that do the work; they are done when the first rank is.
    """
    with input_errors():
        is_launch = mpi.world().size > 1
    if is_launch:
        from mpi4py.futures import MPICommExecutor

        with MPICommExecutor() as ranks:
            yield cast(concurrent.futures.Executor | None, ranks)
        return
    try:
        with concurrent.futures.ThreadPoolExecutor(jobs) as pool, _stopped_by_signals():
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


def run_all(jobs: list[Job], pool: concurrent.futures.Executor, watch: Watch) -> dict[Path, Ending]:
    """Run the jobs in order; the endings by `Job.base`.

    `watch` is called every second and whenever jobs end, with the jobs that run and the
    endings so far. Jobs that somebody else was training are asked for once more at the end.
    """
    endings: dict[Path, Ending] = {}
    for is_first in (True, False):
        batch = [job for job in jobs if is_first or endings[job.base] == "busy"]
        waiting = {pool.submit(run_job, job): job for job in batch}
        while waiting:
            ended, _ = concurrent.futures.wait(waiting, LOOK, concurrent.futures.FIRST_COMPLETED)
            for future in ended:
                endings[waiting.pop(future).base] = future.result()
            watch([job for future, job in waiting.items() if future.running()], endings)
    return endings
