"""The training loop: collect, update, record, save; whatever the algorithm and environment."""

from __future__ import annotations

import dataclasses
import os
import time
from pathlib import Path
from typing import Any

import torch

from . import algos, checkpoint
from .algos.mpi import Communicator
from .config import RunConfig
from .envs.vector import ThreadedEnvs
from .errors import input_errors
from .report import Report, require_tensorboard
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
    been cut off; from the start when it was cut off before its first. Raises InputError over
    bad input and DivergenceError when the learner or every episode breaks; the last
    checkpoint stays.
    """
    path = resume or Path(config.run.out or Path("runs") / config.name())
    config = dataclasses.replace(config, folder=path)
    learner, pool = make_algorithm(config, comm)
    try:
        if config.run.tensorboard:
            require_tensorboard()
        run_dir, epoch = RunDir(path), 0
        if resume is not None and run_dir.checkpoint_file.exists():
            epoch = checkpoint.restore(run_dir, config, learner, comm.rank, comm.size)
        if comm.rank == 0 and resume is None:
            RunDir.create(path, config, comm.size)
        elif comm.rank == 0:  # the length of the run may be another
            run_dir.write_config(config, comm.size)
            run_dir.cut_progress(epoch)
        with Report(config, run_dir, learner.env_steps, is_quiet=comm.rank > 0) as report:
            _loop(learner, config, comm, run_dir, epoch, report)
    finally:
        pool.close()
    return path


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
            checkpoint.save(run_dir, config, epoch, states)
            report.epoch({**row, **times})


def _device(name: str) -> str:
    try:
        torch.empty(0, device=name)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"device: found {name!r}, which PyTorch cannot use here ({reason})") from None
    return name
