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
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import filelock

from ..algos.learner import Learner
from ..algos.mpi import Communicator
from ..envs import layouts, plugins
from ..errors import BAD_INPUT, BUSY, InputError, input_errors
from ..files import no_link
from ..runs.config import RunConfig, from_dict
from ..runs.training import make_algorithm
from ..terminal import interrupts
from ..terminal.console import Tenths
from .grid import Run
from .records import Record, State, StudyFiles

ATTEMPTS = 2
LOOK_EVERY = 5.0  # s between looks at how far runs are
WORKER_WAIT = (
    5.0  # s until busy runs are asked for again: a killed worker's run ends meanwhile
)
INTERRUPTED = 130
LAUNCHER_PREFIXES = ("OMPI_", "PMIX_", "PMI_", "PRTE_", "HYDRA_", "MPI_LOCAL")
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
# The first thing that a run's process does: from then on it ends with its parent.
BEGIN = "import os, sys; from tactilerl.terminal import interrupts; "
BEGIN += "interrupts.end_with(int(sys.argv[1])); os.execv(sys.argv[2], sys.argv[2:])"
Ending = State | Literal["busy", "gone"]
"""Ending of a run. One that is gone was taken out of the study meanwhile."""
Endings = dict[str, Ending]
"""Endings of runs by their names."""
ENDINGS: dict[int, Ending] = {INTERRUPTED: "interrupted", BUSY: "busy"}  # by exit code

_children: set[subprocess.Popen[bytes]] = set()
_stopping = threading.Event()


@dataclass(frozen=True)
class Job:
    """Runs that one process makes done; can be pickled."""

    folder: Path
    """The study's folder; absolute, where other machines are to find it."""
    runs: tuple[Run, ...]
    """One run, or those of batches."""
    ranks: int = 1
    n_batches: int = 0
    """Number of batches that are trained at once on a GPU; 0: a run alone."""
    cwd: Path | None = None
    """The folder where files that its flags name are looked for; None: the current one."""
    imports: tuple[str, ...] = field(default_factory=lambda: (*plugins.imported,))
    """Modules that are to be imported first."""

    @property
    def arguments(self) -> list[str]:
        """The arguments of `tactilerl` that train it, or go on where it was cut off."""
        names = [run.name for run in self.runs]
        flags = [f"--import={module}" for module in self.imports]
        if self.n_batches:
            flags += ["--on", "gpu", "--jobs", str(self.n_batches)]
        return ["study", "train", str(self.folder), *names, *flags]


def check(files: StudyFiles, runs: Iterable[Run]) -> None:
    """Raise InputError naming the first run that could not start, or is another one in its folder.

    Makes the environment and the learner of every group that has not begun yet.
    """
    made = set()
    for run in runs:
        record = files.record(run)
        try:
            config = run.config()
            if record.config:
                _require_same(record, config)
                _require_same_layout(files.run_dir(run).layout_file, config)
            if record.state == "left" and run.place not in made:
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
    if difference := made.difference(wanted):
        hint = "give this study another --out, or move that folder away"
        raise InputError(f"{difference}; {hint}")


def _require_same_layout(copy: Path, config: RunConfig) -> None:
    """Raise InputError where the layout's file says other taxels than the run's `copy` of it."""
    file = config.layout_file
    if not (file and file.is_file() and copy.is_file()):
        return
    with input_errors():
        both = (layouts.load(str(path)).toml() for path in (copy, file))
        made, found = (text.partition("\n")[2] for text in both)
    if made != found:  # but for their descriptions
        raise InputError(
            f"layout {file}: found other taxels than when this run began; put the old file back, or "
            "give this study another --out"
        )


def run_all(
    jobs: Sequence[Job],
    pool: concurrent.futures.Executor,
    on_end: Callable[[Run, Ending], None],
) -> None:
    """Make runs done, in order; `on_end` is told each run and how it ended.

    Prints on standard error how long all of it will take, and every tenth of it; a GPU's batches say
    it themselves. Runs that another process trains are asked for once more at the end.
    """
    look = _Watch([job for job in jobs if not job.n_batches])
    for is_last in (False, True):
        waiting = {pool.submit(make_done, job): job for job in jobs}
        jobs = []
        while waiting:
            done, _ = concurrent.futures.wait(
                waiting, LOOK_EVERY, concurrent.futures.FIRST_COMPLETED
            )
            look([run for job in waiting.values() for run in job.runs])
            for future in done:
                job = waiting.pop(future)
                endings = _endings(future, job)
                busy = [run for run in job.runs if endings[run.name] == "busy"]
                for run in job.runs:
                    if is_last or run not in busy:
                        on_end(run, endings[run.name])
                if busy and not is_last:
                    jobs.append(replace(job, runs=(*busy,)))
        if jobs:
            time.sleep(WORKER_WAIT)


class _Watch:
    """Say how long the runs of a study will take, by the steps in their tables.

    The clock starts when the first of them has made an epoch: until then processes start.
    """

    def __init__(self, jobs: Sequence[Job]) -> None:
        """Look at where `jobs` begin."""
        runs = [run for job in jobs for run in job.runs]
        self._goals = {run.name: run.config().run.total_timesteps for run in runs}
        self._files = StudyFiles(jobs[0].folder if jobs else Path())
        self._done = self._steps(runs)
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
        rows = self._files.record(run).rows
        return int(rows[-1]["env_steps"]) if rows else 0


def _endings(future: concurrent.futures.Future[Endings], job: Job) -> Endings:
    """Return how runs ended; those that ended several of Dask's workers have failed."""
    try:
        return future.result()
    except Exception as error:
        if type(error).__name__ != "KilledWorker":  # Dask's
            raise
        for run in job.runs:
            reason = f"it ended several workers ({error})"[:300]
            StudyFiles(job.folder).write_failure(run, reason)
        return {run.name: "failed" for run in job.runs}


def make_done(job: Job) -> Endings:
    """Train runs to their end, and return how each of them ended; a failure is tried once more.

    What has ended, or what another process trains, is left as it is.
    """
    files, endings = StudyFiles(job.folder), Endings()
    with ExitStack() as held:
        for run in job.runs:
            try:
                lock = filelock.FileLock(files.beside(run, "lock"), timeout=0)
                held.enter_context(lock)
                state = files.record(run).state
            except filelock.Timeout:
                state = "running"
            endings[run.name] = "busy" if state == "running" else state
        unended = ("left", "interrupted")
        left = tuple(run for run in job.runs if endings[run.name] in unended)
        return endings | (_train(files, replace(job, runs=left)) if left else {})


def _train(files: StudyFiles, job: Job) -> Endings:
    log, code, begin = files.beside(job.runs[0], "log"), 1, 0
    left = job.runs
    for _ in range(ATTEMPTS):
        begin = log.stat().st_size if log.exists() else 0
        code = _process(log, replace(job, runs=left))
        left = tuple(run for run in left if not files.record(run).has_ended)
        # None of these exit codes is mended by a second attempt.
        if not left or code in (0, BAD_INPUT, BUSY, INTERRUPTED):
            break
    endings, names = Endings(), {run.name for run in files.study().runs()}
    for run in job.runs:
        if run not in left:
            endings[run.name] = files.record(run).state
        elif code in ENDINGS:
            endings[run.name] = ENDINGS[code]
        elif run.name not in names:
            endings[run.name] = "gone"
        else:
            files.write_failure(run, reason(code, log, begin))
            endings[run.name] = "failed"
    return endings


def _process(log_file: Path, job: Job) -> int:
    """Run a job's process to its end; return the exit code."""
    command = [sys.executable, "-m", "tactilerl", *job.arguments]
    if job.ranks > 1:
        beside = str(Path(sys.executable).with_name("mpirun"))
        command = [shutil.which("mpirun") or beside, "-n", str(job.ranks), *command]
    with open(log_file, "ab", opener=no_link) as log:
        child = subprocess.Popen(
            [sys.executable, "-c", BEGIN, str(os.getpid()), *command],
            stdin=subprocess.DEVNULL,
            stdout=None if job.n_batches else log,
            stderr=log,
            env=_environment(),
            cwd=job.cwd,
        )
    _children.add(child)
    if _stopping.is_set():  # since the last look
        child.terminate()
    try:
        code = child.wait()
    finally:
        _children.discard(child)
    return INTERRUPTED if _stopping.is_set() or code == -signal.SIGINT else code


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
