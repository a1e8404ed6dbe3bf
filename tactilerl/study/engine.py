"""Where a study's runs are trained: on this machine, on the ranks of an MPI launch, or by Dask on the
machines of a cluster. Each is an executor of `concurrent.futures`' kind."""

from __future__ import annotations

import concurrent.futures
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

from ..algos import mpi
from ..errors import InputError, extra, input_errors
from ..machine import free_cores
from .records import StudyFiles
from .runner import LOOK, PATIENCE, Ending, RunJob, run_job, threads

BATCH = {
    "slurm": "SLURM",
    "pbs": "PBS",
    "lsf": "LSF",
    "sge": "SGE",
    "htcondor": "HTCondor",
}
DASK = "dask:"
MEMORY = "3GB"  # of a process, as the guide says

Watch = Callable[[list[RunJob], dict[str, Ending]], None]
"""Is told the jobs that run, and how the others ended, by name."""


@dataclass(frozen=True)
class Engine:
    """Where runs are trained, and how many at a time."""

    on: str = "local"
    jobs: int | None = None
    ranks: int = 1
    """Processes of a run."""
    walltime: str | None = None
    memory: str | None = None

    def validate(self) -> None:
        """InputError for an engine that is not known, or flags that are another's."""
        is_batch, is_dask = self.on in BATCH, self.on.startswith(DASK)
        if not (is_batch or is_dask or self.on in ("local", "mpi")):
            allowed = f"local, mpi, dask:ADDRESS, {', '.join(BATCH)}"
            raise InputError(f"--on: found {self.on!r}, allowed: {allowed}")
        if is_batch and not self.jobs:
            raise InputError(f"--on {self.on}: how many jobs to submit? Give --jobs N")
        if self.jobs and not is_batch and self.on != "local":
            raise InputError(
                f"--jobs: found with --on {self.on}, which has as many as there are"
            )
        for flag in ("walltime", "memory"):
            if getattr(self, flag) and not is_batch:
                raise InputError(f"--{flag}: allowed only with --on {', '.join(BATCH)}")

    @contextmanager
    def executor(
        self,
    ) -> Iterator[tuple[concurrent.futures.Executor, Callable[[], int]] | None]:
        """Where jobs are submitted to, and how many it trains at a time now.

        None on the ranks of MPI that do the work; they are done when the first rank is.
        """
        self.validate()
        with input_errors():
            ranks = mpi.world().size
        if self.on == "mpi" or (self.on == "local" and ranks > 1):
            if ranks == 1:
                raise InputError(
                    "--on mpi: found one process; start it with mpirun -n N, N > 1"
                )
            if self.jobs:
                where = f"under mpirun, which trains {ranks - 1} at a time"
                raise InputError(f"--jobs: found {where}; leave it out")
            from mpi4py.futures import MPICommExecutor

            with MPICommExecutor() as pool:
                if pool is None:
                    yield None
                else:
                    yield cast(concurrent.futures.Executor, pool), lambda: ranks - 1
        elif self.on == "local":
            n = self.jobs or max(1, free_cores() // self.ranks)
            with threads(n) as pool:
                yield pool, lambda: n
        else:
            with self._client() as client:
                yield (
                    client.get_executor(pure=False),
                    lambda: sum(client.nthreads().values()),
                )

    def _client(self) -> Any:
        with extra("cluster"):
            from dask.distributed import Client
        try:
            where: Any = self.on.removeprefix(DASK)
            if self.on in BATCH:
                where = self.cluster()
                submit = where.job_cls.submit_command.split()[0]
                if shutil.which(submit) is None:  # Dask would only log it, and wait
                    where.close()
                    raise ValueError(f"found no command {submit!r} on this machine")
                where.scale(jobs=self.jobs)
            connect: Any = Client  # which has no types
            return connect(where)
        except (
            OSError,
            ValueError,
            RuntimeError,
        ) as error:  # no scheduler there, no sbatch here
            raise InputError(f"--on {self.on}: {error}") from error

    def cluster(self) -> Any:
        """The batch system, of which each job is a worker that trains one run at a time. What is not
        said here is taken from dask-jobqueue's own configuration."""
        on_interrupt = signal.getsignal(signal.SIGINT)
        with extra("cluster"):
            import dask
            import dask_jobqueue
        signal.signal(
            signal.SIGINT, on_interrupt
        )  # dask_jobqueue brings a handler that exits

        options: dict[str, Any] = {
            "cores": self.ranks,
            "processes": 1,
            "worker_extra_args": ["--nthreads", "1"],
            "memory": self.memory
            or dask.config.get(f"jobqueue.{self.on}.memory")
            or MEMORY,
        }
        if self.on == "htcondor":  # which has no limit of time
            options["disk"] = dask.config.get("jobqueue.htcondor.disk") or "1GB"
        elif self.walltime:
            is_lsf = (
                self.on == "lsf" and self.walltime.count(":") == 2
            )  # which has no seconds
            options["walltime"] = (
                self.walltime.rpartition(":")[0] if is_lsf else self.walltime
            )
        return getattr(dask_jobqueue, f"{BATCH[self.on]}Cluster")(**options)


def run_all(
    jobs: list[RunJob], pool: concurrent.futures.Executor, watch: Watch
) -> dict[str, Ending]:
    """Run the jobs in order; the endings by name of the run.

    `watch` is called every second and whenever jobs end, with the jobs that run and the endings so
    far. Jobs that somebody else was training are asked for once more at the end, and at once those
    whose scheduler was lost.
    """
    endings: dict[str, Ending] = {}
    for is_first in (True, False):
        batch = [job for job in jobs if is_first or endings[job.run.name] == "busy"]
        if batch and not is_first:
            time.sleep(PATIENCE)
        waiting = {pool.submit(run_job, job): job for job in batch}
        while waiting:
            ended, _ = concurrent.futures.wait(
                waiting, LOOK, concurrent.futures.FIRST_COMPLETED
            )
            for future in ended:
                job = waiting.pop(future)
                if (ending := _ending(future, job)) is None:
                    waiting[pool.submit(run_job, job)] = job
                else:
                    endings[job.run.name] = ending
            watch([job for future, job in waiting.items() if future.running()], endings)
    return endings


def _ending(future: concurrent.futures.Future[Ending], job: RunJob) -> Ending | None:
    """How a job ended; None where nobody knows, because Dask's scheduler has been lost."""
    try:
        return future.result()
    except concurrent.futures.CancelledError:
        return None
    except Exception as error:
        if type(error).__name__ != "KilledWorker":  # Dask's
            raise
        StudyFiles(job.folder).write_failure(
            job.run, f"it ended several workers ({error})"[:300]
        )
        return "failed"
