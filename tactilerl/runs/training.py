"""The training loop: collect, update, record, save; whatever the algorithm and environment."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .. import algos
from ..algos.learner import Learner
from ..algos.mpi import Communicator
from ..algos.rollout import FAULTS
from ..envs import scripted, vector
from ..errors import InputError, input_errors, interrupts_in_order
from ..files import locked, pasted
from ..machine import free_cores
from ..terminal.console import paragraph
from ..terminal.epochs import EpochLog, require_tensorboard
from . import evaluation
from .config import FINAL_TEST, RunConfig
from .store import Checkpoint, RunDir

Row = dict[str, Any]
COUNTS = "episodes", *FAULTS, "undone", "updates"  # columns of progress.csv: sums


def make_algorithm(
    config: RunConfig, comm: Communicator
) -> tuple[Learner, vector.Workers]:
    """Return the learner and its workers; InputError when they do not go together."""
    with input_errors():
        start = partial(start_workers, config, comm, config.run.workers)
        return start_learner(config, start, comm)


def start_learner(
    config: RunConfig,
    start: Callable[[], vector.Workers],
    comm: Communicator,
) -> tuple[Learner, vector.Workers]:
    """Return a learner and the workers of `start`; ValueError when they do not go together."""
    run = config.run
    _, algorithm = algos.get(run.algo)
    _require_device(run.device)
    with ExitStack() as started:
        workers = started.enter_context(closing(start()))
        # A toy is played on one core and learned from on two.
        cores = run.workers or free_cores(comm.local_size)
        options = comm, run.seed, run.total_timesteps, run.device, cores
        learner = algorithm(config.learner, workers, *options)
        started.pop_all()
    return learner, workers


def start_workers(
    config: RunConfig, comm: Communicator, n: int | None
) -> vector.Workers:
    """Return `n` environments and who plays in them; by default as many as there are free cores.

    PyTorch computes with one thread from here on, in this process and in theirs.
    """
    one_thread = partial(torch.set_num_threads, 1)
    one_thread()
    return vector.start(config.make_env, n or free_cores(comm.local_size), one_thread)


def train(config: RunConfig, comm: Communicator, summary: str = "") -> Path:
    """Train until the learner's `total_timesteps`; return the run folder.

    A run that is there already goes on from its checkpoint, bit for bit as if it had
    never been cut off. `summary` is shown at the beginning. Raises InputError over bad
    input and DivergenceError when the learner or every episode breaks; the last
    checkpoint stays.
    """
    run_dir = RunDir(
        config.folder or Path(config.run.out or Path("runs") / config.name())
    )
    with input_errors():
        config.validate()
    config = run_dir.settled(config)
    learner, workers = make_algorithm(config, comm)
    with closing(workers):
        with input_errors():
            learner.check()
            events = run_dir.path if config.run.tensorboard else None
            if events:
                require_tensorboard()
        with writing(run_dir, config, comm):
            checkpoint = Checkpoint(run_dir, learner, comm)
            epoch = begin(checkpoint, config)
            notes = [summary, paragraph("resolved", learner.describe())]
            if epoch:
                done = f"after epoch {epoch}, {learner.env_steps:,} steps"
                notes.append(paragraph("resumed", done))
            elif config.scene and comm.rank == 0:
                for note in scripted.notes_of_standing_still(workers.play):
                    notes.append(paragraph("warning", note))
            if learner.env_steps >= learner.total_timesteps:
                advice = "" if config.learner.anneals else "; raise --total-timesteps"
                notes.append(f"  nothing to do{advice}")
            earlier = run_dir.rows() if events else []
            with closing(EpochLog(learner, comm, events, earlier=earlier)) as log:
                log.console.print("\n".join(filter(None, notes)))
                for row in epochs(learner, epoch):
                    row[FINAL_TEST] = _final_test(learner, config.run.n_test_episodes)
                    if comm.rank == 0:
                        run_dir.append(row)
                    checkpoint.save(row["epoch"])
                    log.epoch(row)
    return run_dir.path


def take(run_dir: RunDir, config: RunConfig, held: ExitStack) -> None:
    """Make the folder of a run, if need be, and hold its lock; InputError where it is another's."""
    run_dir.create()
    held.enter_context(locked(run_dir.path))
    run_dir.settled(config)  # another process may have begun it meanwhile


@contextmanager
def writing(run_dir: RunDir, config: RunConfig, comm: Communicator) -> Iterator[None]:
    """Hold the run folder on rank 0; what ends the run says that its last checkpoint stays."""
    with ExitStack() as held:
        if comm.rank == 0:
            take(run_dir, config, held)
        held.enter_context(interrupts_in_order())
        try:
            yield
        except algos.EndlessError as error:
            raise InputError(str(error)) from error
        except (FloatingPointError, OSError, KeyboardInterrupt) as error:
            error.add_note(
                f"the last checkpoint is kept: --resume {pasted(run_dir.path)}{config.again}"
            )
            raise


def begin(
    checkpoint: Checkpoint, config: RunConfig, batch: dict[str, Any] | None = None
) -> int:
    """Restore a run's state and return the epoch after which it goes on; save what begins, at 0.

    `batch` says in config.json of which batch it is part. InputError where the goal was
    made smaller, and the run is beyond it already.
    """
    run_dir, learner, comm = checkpoint.run_dir, checkpoint.learner, checkpoint.comm
    epoch = 0
    if run_dir.checkpoint_file.exists():
        epoch, goal = checkpoint.restore(), learner.total_timesteps
        planned = run_dir.read_config().run.total_timesteps
        if epoch and goal < min(learner.env_steps, planned):
            raise InputError(
                f"total_timesteps: found {goal:,} for a run that has made {learner.env_steps:,} "
                "steps, allowed more: they count from the run's beginning"
            )
    elif run_dir.rows():
        raise InputError(
            f"{run_dir.checkpoint_file}: missing, but the run has made progress; put it back, or "
            "begin another run with another --out"
        )
    if comm.rank == 0:
        run_dir.cut(epoch)
        steps = learner.env_steps
        run_dir.write_config(config, comm.size, epoch, steps, batch)
    if not epoch:
        checkpoint.save(0)
    return epoch


def epochs(learner: Learner, epoch: int) -> Iterator[Row]:
    """Learn until `total_timesteps`, from after `epoch` on; yield each epoch's row of the table."""
    while learner.env_steps < learner.total_timesteps:
        epoch += 1
        begin, before = time.perf_counter(), learner.env_steps
        played = cycles(learner, lambda: learner.env_steps < learner.total_timesteps)
        test = learner.test()
        speed = (learner.env_steps - before) / (time.perf_counter() - begin)
        row = {"epoch": epoch, "env_steps": learner.env_steps}
        yield row | table_row(*played, test, speed)


def _final_test(learner: Learner, n: int) -> float | str:
    """Return the success rate of the first `n` episodes that `evaluate` plays, "" before the end.

    Rank 0 plays them.
    """
    if not n or learner.comm.rank > 0 or learner.env_steps < learner.total_timesteps:
        return ""
    played = learner.workers.play(evaluation.task(learner.policy()), range(n))
    return float(np.mean([episode.success for episode in played]))


def cycles(
    learner: Any, goes_on: Callable[[], bool]
) -> tuple[list[Any], list[Any], list[float]]:
    """Let a learner collect and update; return what both say, and the seconds that they take.

    An epoch has as many cycles as the algorithm's, but none begins beyond the run's
    length, where what is annealed is zero: the first is always played.
    """
    collected, learned, seconds = list[Any](), list[Any](), [0.0, 0.0]
    while not collected or (len(collected) < learner.cycles_per_epoch and goes_on()):
        start = time.perf_counter()
        collected.append(learner.collect())
        middle = time.perf_counter()
        learned.append(learner.update())
        seconds[0] += middle - start
        seconds[1] += time.perf_counter() - middle
    return collected, learned, seconds


def table_row(
    collected: Sequence[Row],
    learned: Sequence[Row],
    seconds: Sequence[float],
    test: Row,
    speed: float,
) -> Row:
    """Return a row of the progress table for an epoch's cycles."""
    return {
        **merged(collected, [row["episodes"] for row in collected]),
        **merged(learned, [1] * len(learned)),
        **test,
        "collect_s": round(seconds[0], 4),
        "update_s": round(seconds[1], 4),
        "steps_per_s": round(speed, 1),
    }


def merged(rows: Sequence[Row], weights: list[float]) -> Row:
    """Return one row for an epoch's cycles: counts are added, everything else is averaged.

    Averages are over the cycles that have a value.
    """
    merged = {}
    for key in rows[0]:
        values = np.array([row[key] for row in rows])
        is_known = ~np.isnan(values)
        if key in COUNTS:
            merged[key] = values.sum().item()
        elif is_known.any():
            shares = np.array(weights)[is_known]
            merged[key] = float(np.average(values[is_known], weights=shares))
        else:
            merged[key] = math.nan
    return merged


def _require_device(device: str) -> None:
    """Raise ValueError where PyTorch cannot compute."""
    try:
        torch.zeros(1, device=device).cpu()  # "meta" holds no numbers
    except Exception as error:  # each device answers with errors of its own
        reason = str(error).partition("\n")[0]
        raise ValueError(f"device: found {device!r}, not usable ({reason})") from None
