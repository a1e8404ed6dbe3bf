"""The training loop: collect, update, record, save; whatever the algorithm and environment."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import Any

import torch

from . import algos, checkpoint
from .algos import DivergenceError
from .algos.mpi import Communicator
from .config import RunConfig
from .envs.vector import ThreadedEnvs
from .errors import InputError, input_errors
from .report import Report
from .run_dir import RunDir


def make_algorithm(config: RunConfig, comm: Communicator) -> tuple[algos.Algorithm, ThreadedEnvs]:
    """The learner and its environments; InputError when they do not go together."""
    run = config.run
    _, algorithm = algos.load(run.algo)
    with input_errors():
        config.validate()
        torch.set_num_threads(run.threads)
        device = _device(run.device)
        pool = ThreadedEnvs(config.make_env, run.num_envs, threads=os.cpu_count() or 1)
        learner = algorithm(config.learner, pool, comm, run.seed, run.total_timesteps, device)
    return learner, pool


def train(config: RunConfig, comm: Communicator, resume: Path | None = None) -> Path:
    """Train until `total_timesteps`; returns the run folder.

    With `resume`, goes on from that folder's checkpoint, bit for bit as if the run had never
    been cut off. Raises InputError over bad input and DivergenceError when the learner or
    every episode breaks; the last checkpoint stays.
    """
    learner, pool = make_algorithm(config, comm)
    try:
        if resume is None:
            path = Path(config.run.out or Path("runs") / config.name())
            run_dir, epoch = RunDir(path), 0
            if comm.rank == 0:
                run_dir = RunDir.create(path, config, comm.size)
        else:
            run_dir = RunDir(resume)
            epoch = _restore(run_dir, learner, comm)
        with Report(config, run_dir, epoch, learner.env_steps, is_quiet=comm.rank > 0) as report:
            _loop(learner, config, comm, run_dir, epoch, report)
    finally:
        pool.close()
    return run_dir.path


def _loop(
    learner: algos.Algorithm,
    config: RunConfig,
    comm: Communicator,
    run_dir: RunDir,
    epoch: int,
    report: Report,
) -> None:
    while learner.env_steps < config.run.total_timesteps:
        started = time.perf_counter()
        before = learner.env_steps
        seen = learner.collect()
        collected = time.perf_counter()
        learned = learner.update()
        updated = time.perf_counter()
        epoch += 1
        row = {"epoch": epoch, "env_steps": learner.env_steps, **seen, **learned}
        times: dict[str, Any] = {
            "collect_s": round(collected - started, 4),
            "update_s": round(updated - collected, 4),
            "steps_per_s": round((learner.env_steps - before) / (updated - started), 1),
        }
        states = comm.gather(learner.state_dict())
        if comm.rank == 0:
            run_dir.append_progress({**row, **times})
            checkpoint.save(run_dir.checkpoint_file, epoch, states)
            report.epoch({**row, **times})


def _restore(run_dir: RunDir, learner: algos.Algorithm, comm: Communicator) -> int:
    """Load the checkpoint; the epoch it was written after."""
    epoch, states = checkpoint.load(run_dir.checkpoint_file)
    if len(states) != comm.size:
        raise InputError(
            f"ranks: found {comm.size}, the run was made with {len(states)}; "
            f"start it with mpirun -n {len(states)}"
        )
    try:
        learner.load_state_dict(states[comm.rank])
    except (KeyError, RuntimeError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"{run_dir.checkpoint_file}: from another configuration than config.json ({reason})"
        ) from error
    if comm.rank == 0:
        run_dir.cut_progress(epoch)
    return epoch


def _device(name: str) -> str:
    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device: found {name!r}, which PyTorch cannot use here ({reason})") from None
    return name


def converged(rows: list[dict[str, float]], share: float = 0.1) -> float:
    """Mean success rate over the last `share` of epochs; nan without any."""
    rates = [row["success_rate"] for row in rows]
    tail = rates[-max(1, math.ceil(share * len(rates))) :]
    return sum(tail) / len(tail) if tail else math.nan


__all__ = ["DivergenceError", "converged", "make_algorithm", "train"]
