"""Train many runs of a study as one batch, on a GPU: worlds side by side, networks stacked.

Taxels move nothing, so runs share their physics that differ in nothing but layout,
touch, taxels' faults, seed and numbers of their learners. Each has its own folder, as
if it had been trained alone.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .. import algos
from ..algos import batch as learners
from ..algos.mpi import Communicator
from ..envs import tasks, vector
from ..envs.batch import BatchEnv, require, shared
from ..errors import BUSY, BusyError, InputError, input_errors
from ..runs import evaluation, training
from ..runs.config import FINAL_TEST, RunConfig
from ..runs.store import Checkpoint
from ..terminal.console import about, console
from .grid import Run
from .records import StudyFiles

DEVICE = "cuda"  # in tests "loop": MuJoCo in a loop on the CPU
MAX_WORLDS = 16_384  # of a batch, and of its tests
MAX_REPLAY = 16_000_000_000  # bytes of a batch, which has all episodes on the GPU
STEP_BYTES = 2_500  # of a step with 139 taxels at four times
NO_MEMORY = "out of memory", "Failed to allocate"  # in the errors of PyTorch and Warp
SAVE_EVERY = 60.0  # s
SPARE = 1.25  # worlds for episodes that end early


def require_device() -> None:
    """Raise InputError naming what is missing for `--on gpu`."""
    with input_errors("--on gpu"):
        require(DEVICE)


# -- the study's side ------------------------------------------------------------------------


def n_worlds(config: RunConfig) -> int:
    """Return how many worlds a run plays in: an epoch's or cycle's episodes at once."""
    learner, scene = config.learner, config.scene
    assert scene is not None
    if hasattr(learner, "n_rollouts"):
        return int(learner.n_rollouts)
    longest = scene.max_episode_steps or tasks.TASKS[scene.task].max_episode_steps
    return math.ceil(SPARE * learner.steps_per_epoch / (longest / 2))


def form(runs: Sequence[Run]) -> tuple[list[tuple[Run, ...]], list[tuple[Run, str]]]:
    """Return the runs that are trained together, batch by batch, and the others with the reason."""
    groups, others = defaultdict[Any, list[Run]](list), list[tuple[Run, str]]()
    for run in runs:
        try:
            groups[_common(run.config())].append(run)
        except ValueError as error:
            others.append((run, str(error)))
    batches = list[tuple[Run, ...]]()
    for members in groups.values():
        n_batches = math.ceil(len(members) / _room(members))
        parts = np.array_split(np.array(members, object), n_batches)  # of one size
        batches += [(*part,) for part in parts]
    return batches, others


def _room(runs: Sequence[Run]) -> int:
    """Return how many of these runs a batch has room for."""
    config = runs[0].config()
    room = MAX_WORLDS // n_worlds(config)
    if hasattr(config.learner, "buffer_size"):
        longest = max(run.config().run.total_timesteps for run in runs)
        kept = min(2 * longest, config.learner.buffer_size)
        room = min(room, MAX_REPLAY // (kept * STEP_BYTES))
    return max(1, room)


def _common(config: RunConfig) -> Any:
    """Return what runs of a batch have in common; ValueError for one that can be in none."""
    if config.scene is None:
        raise ValueError(f"env: found {config.run.env}, allowed a hand")
    if algos.get(config.run.algo)[1] not in learners.BATCHED:
        raise ValueError(f"algo: found {config.run.algo}, which has no batched form")
    run, scene = config.run, shared(config.scene)
    return run.env, run.n_test_episodes, learners.alike(config.learner), scene


# -- a batch's process -----------------------------------------------------------------------


def train(files: StudyFiles, runs: Sequence[Run]) -> int:
    """Train runs of a study as a batch, or go on from their last checkpoints; return the exit code."""
    require_device()
    batches, others = form(runs)
    for run, reason in others:
        raise InputError(f"run {run.name}: {reason}")
    if len(batches) != 1:
        raise InputError(
            f"--batch: found {len(batches)} batches in these runs, allowed 1"
        )
    with ExitStack() as held:
        try:
            return _Training(files, batches[0], held).train()
        except (RuntimeError, InputError) as error:
            if not any(sign in str(error) for sign in NO_MEMORY):
                raise
            console.print(
                f"a batch has stopped: {str(error)[:100]}; run the study again with fewer batches at a "
                "time (--jobs 1)"
            )
            return BUSY


@dataclass
class _Member:
    """A run of a batch, and where its table stands."""

    run: Run
    checkpoint: Checkpoint
    epoch: int
    rows: list[training.Row] = field(default_factory=list)
    """Rows that are not in its table yet."""


class _Training:
    """The runs of a batch, their files, and the batch that learns."""

    def __init__(self, files: StudyFiles, runs: Sequence[Run], held: ExitStack) -> None:
        self.files, self.members = files, list[_Member]()
        alone, configs = Communicator(), list[RunConfig]()
        for run in runs:
            run_dir = files.run_dir(run)
            config = run.config().choose({"out": str(run_dir.path)})
            with self._fails_alone(run):
                config = run_dir.settled(config)
                training.take(run_dir, config, held)
            configs.append(config)
        first, n = configs[0], n_worlds(configs[0])
        self.name = f"{Path(first.run.env).stem} {first.run.algo}"
        self.n_test_episodes = first.run.n_test_episodes
        console.print(
            f"batch {self.name}: {len(runs)} runs, {n * len(runs):,} worlds; where kernels are not in "
            "the cache yet, they are compiled, which takes two to three minutes"
        )
        device = DEVICE if DEVICE == "loop" else torch.cuda.get_device_name()
        about = {"runs": len(runs), "device": device}
        algorithm = algos.get(first.run.algo)[1]
        with input_errors():
            env = self._worlds(configs, n)
            for run, config, single in zip(runs, configs, env.singles, strict=True):
                options = config.run.seed, config.run.total_timesteps, env.device
                one = algorithm(config.learner, vector.Workers(single), alone, *options)
                checkpoint = Checkpoint(files.run_dir(run), one, alone)
                with self._fails_alone(run):
                    epoch = training.begin(checkpoint, config, about)
                self.members.append(_Member(run, checkpoint, epoch))
        singles = [one.checkpoint.learner for one in self.members]
        # Tests have more episodes than a cycle, so they have worlds of their own.
        n_tests = max(self.n_test_episodes, singles[0].n_tests)
        n_tests = min(n_tests, MAX_WORLDS // len(runs))
        test_env = self._worlds(configs, n_tests) if n_tests > n else None
        self.learner = learners.BATCHED[algorithm](singles, env, test_env)
        self.saved = time.monotonic()

    @contextmanager
    def _fails_alone(self, run: Run) -> Iterator[None]:
        """Record that a run cannot be gone on with, so that the others can without it."""
        try:
            yield
        except InputError as error:
            if not isinstance(error, BusyError):
                self.files.write_failure(run, str(error))
            raise

    @staticmethod
    def _worlds(configs: Sequence[RunConfig], n: int) -> BatchEnv:
        """Return `n` worlds for each run."""
        groups: Any = [(config.place[1], n) for config in configs]
        return BatchEnv(configs[0].place[0], groups, DEVICE, autoreset=False)

    def train(self) -> int:
        """Train until all runs have their steps, or have failed; return the exit code."""
        while self.learner.active:
            self.epoch()
            if time.monotonic() - self.saved > SAVE_EVERY:
                self.save()
        self.save()
        return int(bool(self.learner.failures))

    def epoch(self) -> None:
        """Play one epoch of each active run and learn from it, as `training` does; print a line."""
        learner, begin = self.learner, time.perf_counter()
        singles, n_tests = learner.learners, self.n_test_episodes
        before = {i: singles[i].env_steps for i in learner.active}
        collected, learned, seconds = training.cycles(
            learner, lambda: bool(learner.active)
        )
        tests, spent = learner.test(before), time.perf_counter() - begin
        played = before.keys() - learner.failures
        ended = played - {*learner.active} if n_tests else ()
        key = evaluation.task(None).key
        finals = learner.play_best(dict.fromkeys(ended, key), n_tests)
        # A run's share of the batch's time, so that the sum over runs is what was
        # spent.
        shares = [each / len(before) for each in seconds]
        latest = list[training.Row]()
        for i in played:
            one, steps = self.members[i], singles[i].env_steps
            one.epoch += 1
            said, read = (
                [each[i] for each in rows if i in each] for rows in (collected, learned)
            )
            speed = (steps - before[i]) / spent
            row = training.table_row(said, read, shares, tests.get(i, {}), speed)
            final = finals[i]["success_rate"] if i in finals else ""
            row = {"epoch": one.epoch, "env_steps": steps, **row, FINAL_TEST: final}
            one.rows.append(row)
            latest.append(row)
        if latest:
            self.show(latest)

    def show(self, latest: Sequence[training.Row]) -> None:
        """Print a line about all runs, of which some have new rows."""
        success = np.mean([row["success_rate"] for row in latest])
        speed = sum(row["steps_per_s"] for row in latest)
        singles = self.learner.learners
        steps = sum(one.env_steps for one in singles)
        total = sum(one.total_timesteps for one in singles)
        console.print(
            f"[{self.name}] {len(singles)} runs, steps {steps:,}/{total:,}, {speed:,.0f} steps/s, "
            f"success {success:.0%}, {about(max(0, total - steps) / speed)} left"
        )

    def save(self) -> None:
        """Write the rows and states of runs that went on since the last time."""
        for i, reason in self.learner.failures.items():
            self.files.write_failure(self.members[i].run, f"stopped: {reason}")
        for i, one in enumerate(self.members):
            if one.rows and i not in self.learner.failures:
                one.checkpoint.run_dir.append(*one.rows)
                one.checkpoint.save(one.epoch)
                one.rows.clear()
        self.saved = time.monotonic()
