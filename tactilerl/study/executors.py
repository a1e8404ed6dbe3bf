"""Executors that a study's jobs are submitted to: threads here, or Dask on a cluster's machines."""

from __future__ import annotations

import asyncio
import concurrent.futures
import logging
import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ..errors import InputError, extra, interrupts_in_order
from ..machine import free_cores

BATCH = {
    "slurm": "SLURM",
    "pbs": "PBS",
    "lsf": "LSF",
    "sge": "SGE",
    "htcondor": "HTCondor",
}
DASK = "dask:"
SIDE_BY_SIDE = 6  # batches on a GPU: one alone waits for itself


@contextmanager
def start(
    on: str, jobs: int | None, ranks: int, walltime: str | None, memory: str | None
) -> Iterator[concurrent.futures.Executor]:
    """Start the executor that `--on` names, for runs of so many processes (`ranks`) each.

    Raises InputError where it is not known or cannot be reached, or for flags that are another's.
    """
    is_batch = on in BATCH
    if not (is_batch or on.startswith(DASK) or on in ("local", "gpu")):
        allowed = f"local, gpu, dask:ADDRESS, {', '.join(BATCH)}"
        raise InputError(f"--on: found {on!r}, allowed: {allowed}")
    if is_batch and not jobs:
        raise InputError(f"--on {on}: how many jobs to submit? Give --jobs N")
    if (walltime or memory) and not is_batch:
        raise InputError(f"--walltime, --memory: allowed only with {', '.join(BATCH)}")
    if on == "gpu" and ranks > 1:
        raise InputError(f"--ranks-per-run: found {ranks}, allowed 1 with --on gpu")
    if on in ("local", "gpu"):
        usual = SIDE_BY_SIDE if on == "gpu" else max(1, free_cores() // ranks)
        pool = concurrent.futures.ThreadPoolExecutor(jobs or usual)
        try:
            yield pool  # threads, which wait for the processes of their jobs
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
        return
    with extra("cluster"):
        from dask.distributed import Client
    try:
        where: Any = on.removeprefix(DASK)
        if is_batch:
            where = cluster(on, ranks, walltime, memory)
            submit = where.job_cls.submit_command.split()[0]
            if shutil.which(submit) is None:  # Dask would only log it, and wait
                where.close()
                raise ValueError(f"found no command {submit!r} on this machine")
            where.scale(jobs=jobs)
        connect: Any = Client  # which has no types
        client = connect(where)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise InputError(f"--on {on}: {error}") from error
    # It would log tracebacks of what is said below in one line.
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)
    with client, interrupts_in_order():
        try:
            yield client.get_executor(pure=False)
        except (concurrent.futures.CancelledError, asyncio.CancelledError) as error:
            raise OSError(
                f"--on {on}: Dask's scheduler has gone; runs keep their last epochs, and go on when "
                "the study is run again"
            ) from error


def cluster(on: str, ranks: int, walltime: str | None, memory: str | None) -> Any:
    """Return the batch system, of which each job is a worker that trains one run at a time.

    dask-jobqueue's own configuration says the rest.
    """
    on_interrupt = signal.getsignal(signal.SIGINT)
    with extra("cluster"):
        import dask_jobqueue
    signal.signal(signal.SIGINT, on_interrupt)  # dask_jobqueue's own would exit
    options: dict[str, Any] = {"walltime": walltime} if walltime else {}
    return getattr(dask_jobqueue, f"{BATCH[on]}Cluster")(
        cores=ranks,
        processes=1,
        worker_extra_args=["--nthreads", "1"],
        memory=memory,
        **options,
    )
