"""Executors that a study's jobs are submitted to: threads here, or Dask's on other machines."""

from __future__ import annotations

import asyncio
import concurrent.futures
import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from ..errors import InputError, extra, input_errors, interrupts_in_order
from ..machine import free_cores

DASK = "dask:"
SIDE_BY_SIDE = 6  # batches on a GPU: one alone waits for itself


@contextmanager
def start(
    on: str, jobs: int | None, ranks: int
) -> Iterator[concurrent.futures.Executor]:
    """Start the executor that `--on` names, for runs of so many processes (`ranks`) each.

    Raises InputError where it is not known or cannot be reached, or for flags that are another's.
    """
    if not on.startswith(DASK) and on not in ("local", "gpu"):
        raise InputError(f"--on: found {on!r}, allowed: local, gpu, dask:ADDRESS")
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
    connect: Any = Client  # which has no types
    with input_errors(f"--on {on}"):
        client = connect(on.removeprefix(DASK))
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
