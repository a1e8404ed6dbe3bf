"""Train the runs of a study, each in a process of its own: a run that crashes stops no other.

A job is "make this run done": it can be asked for twice, and by anybody who sees the study's folder.
Where jobs run is the matter of an executor of `concurrent.futures`' kind.
"""

from __future__ import annotations

import concurrent.futures
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Literal

import filelock
import numpy as np

from ..algos.learner import Learner
from ..algos.mpi import Communicator
from ..envs import hands, layouts, plugins
from ..errors import BAD_INPUT, BUSY, InputError, input_errors
from ..files import no_link
from ..runs.config import RunConfig, from_dict
from ..runs.training import make_algorithm
from ..terminal import interrupts
from ..terminal.console import Tenths
from .grid import Run
from .records import Record, StudyFiles

ATTEMPTS = 2
LOOK_EVERY = 2.0  # s between looks at how far runs are
WORKER_WAIT = (
    5.0  # s until busy runs are asked for again: a killed worker's run ends meanwhile
)
INTERRUPTED = (130, -signal.SIGINT)
LAUNCHER_PREFIXES = ("OMPI_", "PMIX_", "PMI_", "PRTE_", "HYDRA_", "MPI_LOCAL")
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
# The first thing that a run's process does: from then on it ends with its parent.
BEGIN = "import os, sys; from tactilerl.terminal import interrupts; "
BEGIN += "interrupts.end_with(int(sys.argv[1])); os.execv(sys.argv[2], sys.argv[2:])"
Ending = Literal["done", "failed", "busy", "interrupted", "gone"]
"""Ending of a job. A run that is gone was taken out of the study meanwhile."""

_children: set[subprocess.Popen[bytes]] = set()
_stopping = threading.Event()


@dataclass(frozen=True)
class Job:
    """A run that is to be done; can be pickled."""

    folder: Path
    """The study's folder; absolute, where other machines are to find it."""
    run: Run
    ranks: int = 1
    cwd: Path | None = None
    """The folder where files that its flags name are looked for; None: the current one."""
    imports: tuple[str, ...] = field(default_factory=lambda: (*plugins.imported,))
    """Modules that are to be imported first."""

    shows_progress: ClassVar[bool] = False
    """True if its process prints to the terminal, and not to the log."""

    @property
    def arguments(self) -> list[str]:
        """The arguments of `tactilerl` that train it, or go on where it was cut off."""
        modules = [f"--import={module}" for module in self.imports]
        return ["study", "train", str(self.folder), self.run.name, *modules]


def check(files: StudyFiles, runs: Iterable[Run], makes: bool = True) -> None:
    """Raise InputError naming the first run that could not start, or is another one in its folder.

    Where it `makes` them, with the environment and the learner of every group that has not begun yet.
    """
    made = set()
    for run in runs:
        record = files.record(run)
        try:
            config = run.config()
            if record.config:
                _require_same(record, config)
                _require_same_layout(files.run_dir(run).layout_file, config)
            if makes and record.state == "left" and run.place not in made:
                made.add(run.place)
                learner, workers = make_algorithm(config, Communicator())
                with closing(workers), input_errors():
                    learner.check()
                is_tested = type(learner).test is not Learner.test
                if run.measure.startswith("test_") and not is_tested:
                    raise InputError(
                        f"measure: found {run.measure}, but {config.run.algo} has no tests"
                    )
        except InputError as error:
            raise InputError(f"run {run.name}: {error}") from error


def _require_same(record: Record, wanted: RunConfig) -> None:
    """Raise InputError where a run was made with other values, or would be cut."""
    made = from_dict(record.config)
    steps, found = made.run.total_timesteps, wanted.run.total_timesteps
    if found < steps:
        raise InputError(
            f"total_timesteps: found {found}, allowed {steps} or more: a run can be extended, not cut"
        )
    if found > steps and "total_timesteps" not in record.run.flags:
        raise InputError(
            f"total_timesteps: found {found}, by default, and {steps} in this run; give it in the "
            "study file"
        )
    if difference := made.difference(wanted.identity()):
        hint = "give this study another --out, or move that folder away"
        raise InputError(f"{difference}; {hint}")


def _require_same_layout(copy: Path, config: RunConfig) -> None:
    """Raise InputError where the layout's file says other taxels than the run's `copy` of it."""
    file = config.layout_file
    if not (file and file.is_file() and copy.is_file()):
        return
    with input_errors():
        hand = hands.get(config.run.env)
        made, found = (layouts.load(str(path)).place(hand) for path in (copy, file))
    was, now = (
        np.column_stack([taxels.positions, taxels.radii, taxels.thresholds])
        for taxels in (made, found)
    )
    if made.links != found.links or not np.allclose(was, now, rtol=0.0, atol=1e-6):
        raise InputError(
            f"layout {file}: found other taxels than when this run began; put the old file back, or "
            "give this study another --out"
        )


def run_all(
    jobs: Sequence[Job],
    pool: concurrent.futures.Executor,
    on_end: Callable[[Job, Ending], None],
) -> None:
    """Make runs done, in order; `on_end` is told each job and how it ended.

    Prints on standard error how long all of it will take, and every tenth of it. Runs that another
    process trains are asked for once more at the end.
    """
    look = _Watch(jobs)
    for is_last in (False, True):
        waiting = {pool.submit(make_done, job): job for job in jobs}
        busy = []
        while waiting:
            done, _ = concurrent.futures.wait(
                waiting, LOOK_EVERY, concurrent.futures.FIRST_COMPLETED
            )
            look([job.run for job in waiting.values()])
            for future in done:
                job = waiting.pop(future)
                ending = _ending(future, job)
                if ending == "busy" and not is_last:
                    busy.append(job)
                else:
                    on_end(job, ending)
        if busy:
            time.sleep(WORKER_WAIT)
        jobs = busy


class _Watch:
    """Say how long the runs of a study will take, by the steps in their tables.

    The clock starts when the first of them has made an epoch: until then processes start.
    """

    def __init__(self, jobs: Sequence[Job]) -> None:
        """Look at where `jobs` begin."""
        goals = dict[Any, int]()
        for job in jobs:
            if job.run.place not in goals:
                goals[job.run.place] = job.run.config().run.total_timesteps
        self._goals = {job.run.name: goals[job.run.place] for job in jobs}
        self._files = StudyFiles(jobs[0].folder if jobs else Path())
        self._seen = dict[str, tuple[int, int]]()
        self._done = self._steps([job.run for job in jobs])
        self._tenths: Tenths | None = None

    def __call__(self, waiting: Sequence[Run]) -> None:
        """Print what there is to say while these runs have not ended."""
        steps, goal = self._steps(waiting), sum(self._goals.values())
        new, self._done = steps - self._done, steps
        if self._tenths and new > 0:
            self._tenths(new)
        elif 0 < new < goal - steps:
            self._tenths = Tenths("", goal - steps)

    def _steps(self, waiting: Sequence[Run]) -> int:
        """Return how many steps are made; what is not `waiting` any more has its whole length."""
        made = {run.name: self._made(run) for run in waiting}
        return sum(min(made.get(run, goal), goal) for run, goal in self._goals.items())

    def _made(self, run: Run) -> int:
        """Return the steps in a run's table, which is read again only after it has grown."""
        try:
            size = self._files.run_dir(run).table.stat().st_size
        except FileNotFoundError:
            return 0
        if self._seen.get(run.name, (-1, 0))[0] != size:
            rows = self._files.record(run).rows
            self._seen[run.name] = size, int(rows[-1]["env_steps"]) if rows else 0
        return self._seen[run.name][1]


def _ending(future: concurrent.futures.Future[Ending], job: Job) -> Ending:
    """Return how a job ended; one that ended several of Dask's workers has failed."""
    try:
        return future.result()
    except Exception as error:
        if type(error).__name__ != "KilledWorker":  # Dask's
            raise
        reason = f"it ended several workers ({error})"[:300]
        StudyFiles(job.folder).write_failure(job.run, reason)
        return "failed"


def make_done(job: Job) -> Ending:
    """Train one run to its end; a failure is tried once more.

    What has ended, or what another process trains, is left as it is.
    """
    files = StudyFiles(job.folder)
    try:
        with filelock.FileLock(files.beside(job.run, "lock"), timeout=0):
            state = files.record(job.run).state
            if state == "running":
                return "busy"
            return state if state in ("done", "failed") else _train(files, job)
    except filelock.Timeout:
        return "busy"


def _train(files: StudyFiles, job: Job) -> Ending:
    log, code, begin = files.beside(job.run, "log"), 1, 0
    for _ in range(ATTEMPTS):
        begin = log.stat().st_size if log.exists() else 0
        code = run_process(log, job)
        if _stopping.is_set() or code in INTERRUPTED:
            return "interrupted"
        if code == BUSY:
            return "busy"
        if code in (0, BAD_INPUT):  # which a second attempt cannot mend
            break
    if code == 0 and files.record(job.run).state == "done":
        return "done"
    if job.run.name not in {run.name for run in files.study().runs()}:
        return "gone"
    files.write_failure(job.run, reason(code, log, begin))
    return "failed"


def run_process(log_file: Path, job: Job) -> int:
    """Run a job's process to its end; return the exit code."""
    return INTERRUPTED[0] if _stopping.is_set() else _process(log_file, job)


def _process(log_file: Path, job: Job) -> int:
    command = [sys.executable, "-m", "tactilerl", *job.arguments]
    if job.ranks > 1:
        beside = str(Path(sys.executable).with_name("mpirun"))
        command = [shutil.which("mpirun") or beside, "-n", str(job.ranks), *command]
    with open(log_file, "ab", opener=no_link) as log:
        child = subprocess.Popen(
            [sys.executable, "-c", BEGIN, str(os.getpid()), *command],
            stdin=subprocess.DEVNULL,
            stdout=None if job.shows_progress else log,
            stderr=log,
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
    """Return the environment of a run: one thread, and no rank of the launch that started the study."""
    inherited = {
        name: value
        for name, value in os.environ.items()
        if name.startswith("OMPI_ALLOW_RUN_AS_ROOT")
        or not name.startswith(LAUNCHER_PREFIXES)
    }
    return inherited | dict.fromkeys(THREADS, "1")


def reason(code: int, log_file: Path, begin: int) -> str:
    """Return in a line why a run failed: the signal, or the last thing in its log after `begin`."""
    if code < 0:
        return f"killed by signal {-code} ({signal.strsignal(-code)})"
    text = log_file.read_bytes()[begin:].decode("utf-8", errors="replace")
    lines = [line for line in text.splitlines() if line.strip()]
    ours = [line for line in lines if line.startswith("tactilerl: ")]
    last = [*lines, *ours][-1:] or [""]
    return f"{last[0].removeprefix('tactilerl: ').strip()[:300]} (exit code {code})"


@contextmanager
def threads(n: int) -> Iterator[concurrent.futures.Executor]:
    """Start `n` jobs at a time on this machine: a job waits for its process, so threads do.

    Ctrl-C ends the runs in order, and so does SIGTERM, which batch systems send before they kill.
    """

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        with concurrent.futures.ThreadPoolExecutor(n) as pool, interrupts.in_order():
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
        signal.signal(signal.SIGTERM, before)
