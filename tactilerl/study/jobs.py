"""Train the runs of a study, each in a process of its own: a run that crashes stops no other.

A job is "make this run done": it can be asked for twice, and by anybody who sees the
study's folder. Threads here wait for the processes of their jobs, or workers of Dask's
on other machines do.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import logging
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import filelock

from ..algos.mpi import Communicator
from ..envs import plugins
from ..errors import (
    BAD_INPUT,
    BUSY,
    InputError,
    extra,
    input_errors,
    interrupts_in_order,
)
from ..machine import allow_open_files, free_cores
from ..runs.config import RunConfig
from ..runs.training import make_algorithm
from . import batch
from .grid import Run
from .records import StudyFiles

ATTEMPTS = 2
LOCAL, GPU, DASK, DASK_GPU = "local", "gpu", "dask:", "dask-gpu:"
SIDE_BY_SIDE = 6  # batches on a GPU: one alone waits for itself
LOCK_WAIT = 0.5  # s; who only looks at a lock has it for an instant
INTERRUPTED = 130, -signal.SIGINT, -signal.SIGTERM
LAUNCHER_PREFIXES = ("OMPI_", "PMIX_", "PMI_", "PRTE_", "HYDRA_", "MPI_LOCAL")
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
# The first thing that a run's process does: from then on it ends with its parent.
BEGIN = "import os, sys; from tactilerl.errors import end_with; "
BEGIN += "end_with(int(sys.argv[1])); os.execv(sys.argv[2], sys.argv[2:])"


@dataclass(frozen=True)
class Job:
    """Runs that one process makes done; can be pickled."""

    folder: Path
    """The study's folder; absolute, where other machines are to find it."""
    runs: tuple[Run, ...]
    """One run, or those of a batch."""
    ranks: int = 1
    is_batch: bool = False
    """True if they are trained as a batch, on a GPU."""
    cwd: Path = field(default_factory=Path.cwd)
    """The folder where files that its flags name are looked for."""
    imports: tuple[str, ...] = field(default_factory=lambda: (*plugins.imported,))
    """Modules that are to be imported first."""

    @property
    def arguments(self) -> list[str]:
        """The arguments of `tactilerl` that train it, or go on where it was cut off."""
        names = [run.name for run in self.runs]
        flags = [f"--import={module}" for module in self.imports]
        as_batch = ["--batch"] * self.is_batch
        return ["study", "train", str(self.folder), *names, *flags, *as_batch]


def check(files: StudyFiles, runs: Iterable[Run]) -> None:
    """Raise InputError naming the first run that could not start, or is another one in its folder.

    Makes the environment and the learner of every group that has not begun yet.
    """
    tried = set()
    for run in runs:
        try:
            config, run_dir = run.config(), files.run_dir(run)
            if run_dir.config_file.exists():
                run_dir.settled(config, may_be_shorter=False)
            elif run.place not in tried:
                tried.add(run.place)
                _try(run, config)
        except InputError as error:
            raise InputError(f"run {run.name}: {error}") from error


def _try(run: Run, config: RunConfig) -> None:
    """Raise InputError where a run could not start, or its learner has no tests to be measured by."""
    learner, workers = make_algorithm(config, Communicator())
    with closing(workers), input_errors():
        learner.check()
    if run.measure.startswith("test_") and not learner.n_tests:
        raise InputError(f"measure: found {run.measure}, but the run has no tests")


def is_gpu(on: str) -> bool:
    """Tell whether the place that `--on` names trains batches, on GPUs."""
    return on == GPU or on.startswith(DASK_GPU)


@contextmanager
def executor(
    on: str, jobs: int | None, ranks: int
) -> Iterator[concurrent.futures.Executor]:
    """Start the executor that `--on` names, for runs of so many processes (`ranks`) each.

    Raises InputError where it is not known or cannot be reached, a worker has no GPU that
    it needs, or for flags that are another's.
    """
    if not on.startswith((DASK, DASK_GPU)) and on not in (LOCAL, GPU):
        allowed = f"{LOCAL}, {GPU}, {DASK}ADDRESS, {DASK_GPU}ADDRESS"
        raise InputError(f"--on: found {on!r}, allowed: {allowed}")
    if is_gpu(on) and ranks > 1:
        raise InputError(f"--ranks-per-run: found {ranks}, allowed 1 on a GPU")
    if on in (LOCAL, GPU):
        usual = SIDE_BY_SIDE if on == GPU else max(1, free_cores() // ranks)
        pool = concurrent.futures.ThreadPoolExecutor(jobs or usual)
        try:
            yield pool
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
        return
    if jobs is not None:
        raise InputError(
            f"--jobs: found {jobs} with --on {on}, where each of Dask's workers has one"
        )
    with extra("cluster"):
        from dask.distributed import Client
    connect: Any = Client  # which has no types
    with input_errors(f"--on {on}"):
        try:
            client = connect(on.partition(":")[2])
        except TypeError as error:  # such as tls:// without certificates
            raise InputError(str(error)) from error
    # It would log tracebacks of what is said below in one line.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    with client, interrupts_in_order():
        try:
            if is_gpu(on):
                tried = client.run(batch.require_device, on_error="return")
                for worker, found in tried.items():
                    if found is not None:
                        raise InputError(f"--on {on}: worker {worker}: {found}")
            yield client.get_executor(pure=False)
        except (concurrent.futures.CancelledError, asyncio.CancelledError) as error:
            raise OSError(
                f"--on {on}: Dask's scheduler has gone; runs keep their last epochs, and go on when "
                "the study is run again"
            ) from error


def run_all(
    jobs: Iterable[Job],
    pool: concurrent.futures.Executor,
    on_end: Callable[[Run], None],
) -> None:
    """Make runs done, in order; `on_end` is told each run that ended, whatever became of it."""
    waiting = {pool.submit(make_done, job): job for job in jobs}
    for future in concurrent.futures.as_completed(waiting):
        job, error = waiting[future], future.exception()
        is_deadly = type(error).__name__ == "KilledWorker"  # several of Dask's died
        if error is not None and not is_deadly:
            raise error
        for run in job.runs:
            if is_deadly:
                StudyFiles(job.folder).write_failure(run, f"not run: {error}")
            on_end(run)


def make_done(job: Job) -> None:
    """Train runs to their end; one that fails is tried once more, and then recorded as failed.

    What has ended, or what another process trains, is left as it is.
    """
    files, runs = StudyFiles(job.folder), list[Run]()
    allow_open_files()  # a lock for each run, here and in its own process
    with ExitStack() as held:
        for run in job.runs:
            with suppress(filelock.Timeout):
                lock = filelock.FileLock(files.beside(run, "lock"), timeout=LOCK_WAIT)
                held.enter_context(lock)
                if not files.record(run).has_ended:
                    runs.append(run)
        if runs:
            _train(files, replace(job, runs=(*runs,)))


def _train(files: StudyFiles, job: Job) -> None:
    log = files.beside(job.runs[0], "log")
    attempts = ATTEMPTS
    while attempts:
        begin = log.stat().st_size if log.exists() else 0
        code = _process(log, job)
        left = [run for run in job.runs if not files.record(run).has_ended]
        if not left or code in (BUSY, *INTERRUPTED):
            return
        if len(left) == len(job.runs):  # of a batch, some may have ended
            # Of bad input, a second attempt mends nothing.
            attempts = 0 if code in (0, BAD_INPUT) else attempts - 1
        job = replace(job, runs=(*left,))
    for run in job.runs:
        files.write_failure(run, reason(code, log, begin))


def _process(log_file: Path, job: Job) -> int:
    """Run a job's process to its end; return the exit code."""
    command = [sys.executable, "-m", "tactilerl", *job.arguments]
    if job.ranks > 1:
        beside = str(Path(sys.executable).with_name("mpirun"))
        command = [shutil.which("mpirun") or beside, "-n", str(job.ranks), *command]
    with open(log_file, "ab") as log:
        done = subprocess.run(
            [sys.executable, "-c", BEGIN, str(os.getpid()), *command],
            stdin=subprocess.DEVNULL,
            stdout=None if job.is_batch else log,
            stderr=log,
            env=_environment(),
            cwd=job.cwd,
        )
    return done.returncode


def _environment() -> dict[str, str]:
    """Return the environment of a run: one thread, and no rank of the launch that started the study."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(LAUNCHER_PREFIXES) or "ALLOW_RUN_AS_ROOT" in name
    }
    return kept | dict.fromkeys(THREADS, "1")


def reason(code: int, log_file: Path, begin: int) -> str:
    """Return in a line why a run failed: the signal, or the last thing in its log after `begin`."""
    if code < 0:
        return f"killed by signal {-code} ({signal.strsignal(-code)})"
    text = log_file.read_bytes()[begin:].decode(errors="replace").strip()
    lines = text.splitlines() or [""]
    ours = [line for line in lines if line.startswith("tactilerl: ")]
    last = [*lines, *ours][-1].removeprefix("tactilerl: ")
    return f"{last[:300]} (exit code {code})"
