"""Train many runs of a study as one batch, on a GPU: worlds side by side, networks stacked.

Taxels move nothing, so runs share their physics that differ in nothing but layout, touch, taxels'
faults, seed and numbers of their learners. Each has its own folder, as if it had been trained alone.
"""

from __future__ import annotations

import itertools
import math
import os
import signal
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import filelock
import numpy as np
import torch
from gymnasium.vector import AutoresetMode

from .. import algos, machine
from ..algos import batch as learners
from ..algos.mpi import Communicator
from ..algos.policy import flat_size
from ..envs import layouts, tasks
from ..envs.batch import BY_GROUP, BatchEnv, require_batched
from ..errors import BUSY, InputError, extra, input_errors
from ..runs import evaluation, training
from ..runs.config import FINAL_TEST, RunConfig
from ..runs.store import Checkpoint
from ..terminal.console import console
from ..terminal.epochs import duration
from . import executors, jobs
from .grid import Run
from .records import StudyFiles

DEVICE = "TACTILERL_BATCH_DEVICE"  # of tests: "loop", MuJoCo in a loop on the CPU
PROCESSES = (
    "TACTILERL_BATCH_PROCESSES"  # that train batches: their number, if not three
)
MAX_WORLDS = 16_384  # of a batch
SAVE_EVERY, SHOW_EVERY = 60.0, 10.0  # s
GRACE = 10.0  # s; then whoever is told to end goes without the epoch that it is in
SWITCH_EVERY = 5e-4  # s, between threads: what they wait for is the GPU
SPARE = 1.25  # worlds for episodes that end early
WORLD_BYTES = 300_000  # of physics: contacts, constraints and what they are solved with
WEIGHT_COPIES = 10  # weights, gradients, Adam's moments, an actor to go back to


def device() -> str:
    """Return the device that batches are trained on here."""
    return os.environ.get(DEVICE, "cuda")


def require_device() -> None:
    """Raise InputError naming what is missing for `--on gpu`."""
    if device() == "loop":
        return
    with extra("gpu"):
        for name in ("mujoco_warp", "warp"):
            if find_spec(name) is None:
                raise ModuleNotFoundError(f"No module named '{name}'", name=name)
    if not torch.cuda.is_available():
        raise InputError(
            f"--on gpu: found no GPU that PyTorch {torch.__version__} can use here; it takes an NVIDIA "
            "GPU, its driver, and PyTorch for CUDA (https://pytorch.org/get-started)"
        )


@dataclass(frozen=True)
class Batch(jobs.Job):
    """Runs that are trained together; `run` is the first of them."""

    runs: tuple[Run, ...] = ()
    name: str = ""
    side_by_side: int = executors.SIDE_BY_SIDE
    """Number of batches that its process trains at once, where these runs make several."""
    shows_progress = True

    @property
    def arguments(self) -> list[str]:
        """The arguments of `tactilerl` that train them."""
        before, names = super().arguments, (run.name for run in self.runs)
        return [
            *before[:3],
            *names,
            *before[4:],
            "--on",
            "gpu",
            "--jobs",
            str(self.side_by_side),
        ]

    def of(self, names: set[str]) -> Batch:
        """Return the part of it that has these runs."""
        left = tuple(run for run in self.runs if run.name in names)
        return replace(self, run=left[0] if left else self.run, runs=left)

    @cached_property
    def configs(self) -> list[RunConfig]:
        """The runs' configurations."""
        return [run.config() for run in self.runs]

    @property
    def worlds(self) -> int:
        """Number of worlds of each run."""
        return n_worlds(self.configs[0])

    @property
    def nbytes(self) -> float:
        """About the memory that it takes on the device, in bytes."""
        config = self.configs[0]
        scene: Any = config.scene
        with closing(config.make_env()) as env:
            width = flat_size(env.observation_space)
        sizes = [width, *config.learner.hidden, 1]
        weights = sum(a * b for a, b in itertools.pairwise(sizes))
        steps = scene.max_episode_steps or tasks.TASKS[scene.task].max_episode_steps
        per_run = 2 * weights * 4 * WEIGHT_COPIES
        per_run += self.worlds * (
            WORLD_BYTES + 4 * 4 * steps * (width + sum(config.learner.hidden))
        )
        if hasattr(
            config.learner, "buffer_size"
        ):  # episodes may be half as long as they can be
            kept = min(config.run.total_timesteps, config.learner.buffer_size)
            per_run += (
                2 * kept * 4 * width
                + config.learner.n_batches * config.learner.batch_size * 12 * width
            )
        return per_run * len(self.runs)


def n_worlds(config: RunConfig) -> int:
    """Return how many worlds a run plays in: an epoch's or cycle's episodes at once."""
    scene, learner = config.scene, config.learner
    if hasattr(learner, "n_rollouts"):
        return int(learner.n_rollouts)
    assert scene is not None
    longest = scene.max_episode_steps or tasks.TASKS[scene.task].max_episode_steps
    return math.ceil(SPARE * learner.steps_per_epoch / (longest / 2))


def form(
    folder: Path, runs: Sequence[Run]
) -> tuple[list[Batch], list[tuple[Run, str]]]:
    """Return batches of the runs that can be trained in one, and the others with the reason."""
    groups, others = defaultdict[Any, list[Run]](list), list[tuple[Run, str]]()
    for run in runs:
        config = run.config()
        try:
            groups[_common(config)].append(run)
        except ValueError as error:
            others.append((run, str(error)))
    batches = list[Batch]()
    for members in groups.values():
        config = members[0].config()
        size = max(1, MAX_WORLDS // n_worlds(config))
        for i in range(0, len(members), size):
            part = tuple(members[i : i + size])
            name = f"{Path(config.run.env).stem} {config.run.algo}"
            name += f" {len(batches) + 1}" if name in {b.name for b in batches} else ""
            batches.append(Batch(folder, part[0], cwd=Path.cwd(), runs=part, name=name))
    return batches, others


def _common(config: RunConfig) -> Any:
    """Return what runs of a batch have in common; ValueError for one that can be in none."""
    if config.scene is None:
        raise ValueError(f"env: found {config.run.env}, allowed a hand")
    _, algorithm = algos.get(config.run.algo)
    if algorithm not in learners.BATCHED:
        raise ValueError(f"algo: found {config.run.algo}, which has no batched form")
    require_batched([config.scene])
    scene = {k: v for k, v in vars(config.scene).items() if k not in BY_GROUP}
    run = config.run.env, config.run.n_test_episodes
    return run, learners.alike(config.learner), (*scene.items(),)


# -- the study's side ------------------------------------------------------------------------


def show(batches: Sequence[Batch]) -> None:
    """Print what is trained together, and what memory it takes."""
    for batch in batches:
        n, gigabytes = len(batch.runs), batch.nbytes / 1e9
        console.print(
            f"batch {batch.name}: {n} runs, {n * batch.worlds:,} worlds, about {gigabytes:.1f} GB"
        )
    if device() == "loop" or not batches:
        return
    free, _ = torch.cuda.mem_get_info()
    largest = sum(
        sorted((batch.nbytes for batch in batches), reverse=True)[
            : executors.SIDE_BY_SIDE
        ]
    )
    console.print(f"  of {free / 1e9:.1f} GB free on {torch.cuda.get_device_name()}")
    if largest > free:
        console.print(
            "note: this may be more than there is; give --jobs 1, or a part of the study"
        )


def run_all(
    batches: Sequence[Batch], pool: Executor, side_by_side: int | None, on_end: Any
) -> None:
    """Make the runs of all batches done; `on_end` is told each run and how it ended.

    Threads of a process take turns in Python, and processes on the GPU: so there are some of each.
    """
    n = side_by_side or executors.SIDE_BY_SIDE
    n_processes = min(n, int(os.environ.get(PROCESSES, 3)))
    parts, futures = list[Batch](), list[Future[list[jobs.Ending]]]()
    for k in range(min(n_processes, len(batches))):
        runs = [run for batch in batches[k::n_processes] for run in batch.runs]
        part = replace(batches[k], runs=(*runs,), side_by_side=-(-n // n_processes))
        parts.append(part)
        futures.append(pool.submit(_make_done, part))
    for part, future in zip(parts, futures, strict=True):
        for run, ending in zip(part.runs, future.result(), strict=True):
            on_end(replace(part, run=run), ending)


def _make_done(batch: Batch) -> list[jobs.Ending]:
    """Train the runs of batches that have not ended, in a process; say how each ended."""
    files, log = (
        StudyFiles(batch.folder),
        StudyFiles(batch.folder).beside(batch.run, "log"),
    )
    begin = log.stat().st_size if log.exists() else 0
    with ExitStack() as held:
        busy = {run.name for run in batch.runs if not _is_held(files, run, held)}
        mine = [run for run in batch.runs if run.name not in busy]
        code = jobs.run_process(log, replace(batch, runs=tuple(mine))) if mine else 0
        endings = dict[str, jobs.Ending]()
        for run in mine:
            state = files.record(run).state
            if state not in ("done", "failed"):
                if code in jobs.INTERRUPTED:
                    state = "interrupted"
                elif code == BUSY:
                    state = "busy"  # type: ignore[assignment]
                else:
                    files.write_failure(run, jobs.reason(code, log, begin))
                    state = "failed"
            endings[run.name] = state  # type: ignore[assignment]
    return [endings.get(run.name, "busy") for run in batch.runs]


def _is_held(files: StudyFiles, run: Run, held: ExitStack) -> bool:
    try:
        held.enter_context(filelock.FileLock(files.beside(run, "lock"), timeout=0))
    except filelock.Timeout:
        return False
    return files.record(run).state != "running"


# -- a batch's process -----------------------------------------------------------------------


class _Seat:
    """Show a learner the spaces that its run has in the batch, in place of workers."""

    def __init__(self, env: BatchEnv, group: int) -> None:
        self.observation_space = env.group_observation_spaces[group]
        self.action_space = env.single_action_space
        self.max_episode_steps, self._reward = (
            env.max_episode_steps,
            env.task.compute_reward,
        )

    def __len__(self) -> int:
        return 1

    def compute_reward(self, achieved_goal: Any, desired_goal: Any) -> Any:
        return np.asarray(self._reward(achieved_goal, desired_goal))

    def compute_terminated(self, achieved_goal: Any, desired_goal: Any) -> None:
        """Say nothing: no task of ours does."""


class _Training:
    """The runs of a batch, their files, and the batch that learns."""

    def __init__(self, batch: Batch, files: StudyFiles, held: ExitStack) -> None:
        self.batch, self.files = batch, files
        self.run_dirs = [files.run_dir(run) for run in batch.runs]
        configs = list[RunConfig]()
        for config, run_dir in zip(batch.configs, self.run_dirs, strict=True):
            config = config.choose({"out": str(run_dir.path)})
            configs.append(run_dir.settled(config))
            held.enter_context(training.writing(run_dir, configs[-1], Communicator()))
        where, n = device(), batch.worlds
        if where != "loop":
            console.print(
                f"[{batch.name}] building; where kernels are not in the cache yet, they are compiled, "
                "which takes two to three minutes"
            )
        with input_errors():
            groups = [(config.place[1], n) for config in configs]
            env = BatchEnv(configs[0].place[0], groups, where, AutoresetMode.DISABLED)  # type: ignore[arg-type]
            self.env = held.enter_context(closing(env))
            singles = [self._single(config, i) for i, config in enumerate(configs)]
        pairs = zip(self.run_dirs, configs, singles, strict=True)
        self.checkpoints = [
            Checkpoint(d, c, one, Communicator()) for d, c, one in pairs
        ]
        self.epochs = [training.begun(checkpoint) for checkpoint in self.checkpoints]
        where = torch.cuda.get_device_name() if where != "loop" else where
        about = {"runs": len(configs), "worlds": env.num_envs, "device": where}
        origin = {**machine.origin(), "batch": about}
        for run_dir, config, one, epoch in zip(
            self.run_dirs, configs, singles, self.epochs, strict=True
        ):
            run_dir.cut(epoch, most=None)
            now = {**origin, "epoch": epoch, "env_steps": one.env_steps}
            run_dir.write_config(config, 1, origin=now)
        self.learner = learners.BATCHED[type(singles[0])](singles, env)
        self.rows: list[list[training.Row]] = [[] for _ in singles]
        self._n_test_episodes = configs[0].run.n_test_episodes
        self.saved = self.shown = self.begin = time.monotonic()
        self.steps = self._steps = sum(one.env_steps for one in singles)
        self._labels = [_label(config) for config in configs]
        self._success = [math.nan] * len(singles)
        for checkpoint, epoch in zip(self.checkpoints, self.epochs, strict=True):
            if not epoch:
                checkpoint.save(0)
        if device() != "loop":
            torch.cuda.synchronize()  # what was built is ready for other streams

    def _single(self, config: RunConfig, group: int) -> Any:
        run = config.run
        _, algorithm = algos.get(run.algo)
        options = Communicator(), run.seed, run.total_timesteps
        return algorithm(config.learner, _Seat(self.env, group), *options)

    def train_in_thread(self, free: threading.Semaphore, stop: threading.Event) -> None:
        """Train on a stream of its own; release `free` then, and stop all others on errors."""
        stream = torch.cuda.Stream() if device() != "loop" else None  # type: ignore[no-untyped-call]
        try:
            with torch.cuda.stream(stream):
                self.train(stop)
        except BaseException:
            stop.set()
            raise
        finally:
            free.release()

    def train(self, stop: threading.Event) -> None:
        """Train until all runs have their steps, or have failed; or until it is told to stop."""
        while any(self.learner.active):
            self.epoch(stop)
            if (
                stop.is_set()
            ):  # in the middle of an epoch, which a checkpoint would not be
                for run_dir, rows in zip(self.run_dirs, self.rows, strict=True):
                    run_dir.append(*rows)
                return
            if time.monotonic() - self.saved > SAVE_EVERY:
                self.save()
        self.final_test()
        self.save()
        self.show(is_last=True)

    def epoch(self, stop: threading.Event) -> None:
        """Play one epoch of each active run and learn from it, as `training` does with one."""
        learner, begin = self.learner, time.perf_counter()
        before = [one.env_steps for one in learner.learners]
        collected: list[list[training.Row]] = [[] for _ in before]
        learned: list[list[training.Row]] = [[] for _ in before]
        collect_s = update_s = 0.0
        for _ in range(learner.cycles_per_epoch):
            if stop.is_set() or not any(active := learner.active):
                break
            start = time.perf_counter()
            episodes = learner.collect()
            middle = time.perf_counter()
            updates = learner.update()
            collect_s += middle - start
            update_s += time.perf_counter() - middle
            for i, is_on in enumerate(active):
                if is_on and i not in learner.failures:
                    collected[i].append(episodes[i])
                    learned[i].append(updates[i])
            self.show()
        if stop.is_set():
            return
        tests = learner.test([bool(part) for part in collected])
        seconds = time.perf_counter() - begin
        for i, (one, parts) in enumerate(zip(learner.learners, collected, strict=True)):
            if not parts:
                continue
            self.epochs[i] += 1
            self._success[i] = parts[-1]["success_rate"]
            row = {"epoch": self.epochs[i], "env_steps": one.env_steps}
            row |= training.merged(parts, [part["episodes"] for part in parts])
            row |= training.merged(learned[i], [1] * len(parts))
            row |= tests.get(i, {})
            # A run's share of the batch's time, so that the sum over runs is what was spent.
            times = {"collect_s": collect_s, "update_s": update_s}
            row |= {k: round(v / len(before), 4) for k, v in times.items()}
            row["steps_per_s"] = round((one.env_steps - before[i]) / seconds, 1)
            row[FINAL_TEST] = ""
            self.rows[i].append(row)

    def final_test(self) -> None:
        """Test the runs that have ended, as `training` does with one; their last rows have waited."""
        if n := self._n_test_episodes:
            waiting = [i for i in range(len(self.rows)) if self._waits(i)]
            key = evaluation.task(None).key
            tests = self.learner.play_best(dict.fromkeys(waiting, key), n)
            for i, test in tests.items():
                self.rows[i][-1][FINAL_TEST] = test["success_rate"]

    def _waits(self, i: int) -> bool:
        """Return whether a run has ended and is still to be tested."""
        one, rows = self.learner.learners[i], self.rows[i]
        has_ended = bool(rows) and one.env_steps >= one.total_timesteps
        return bool(self._n_test_episodes) and has_ended and rows[-1][FINAL_TEST] == ""

    def save(self) -> None:
        """Write the rows and states of runs that went on since the last time."""
        for i, reason in self.learner.failures.items():
            self.files.write_failure(self.batch.runs[i], f"stopped: {reason}")
        for i, rows in enumerate(self.rows):
            if not rows or self._waits(i):
                continue
            self.run_dirs[i].append(*rows)
            self.learner.write(i)
            self.checkpoints[i].save(rows[-1]["epoch"])
            rows.clear()
        self.saved = time.monotonic()

    def show(self, is_last: bool = False) -> None:
        """Print a line about all runs, if the last is some seconds old."""
        now, ones = time.monotonic(), self.learner.learners
        if now - self.shown < SHOW_EVERY and not is_last:
            return
        steps, total = (
            sum(getattr(one, name) for one in ones)
            for name in ("env_steps", "total_timesteps")
        )
        speed = (steps - self._steps) / max(now - self.shown, 1e-9)
        self._steps, self.shown = steps, now
        spent, done = now - self.begin, steps - self.steps
        left = duration(spent * max(0, total - steps) / done) if done else "?"
        groups = defaultdict[str, list[float]](list)
        for label, success in zip(self._labels, self._success, strict=True):
            if not math.isnan(success):
                groups[label].append(success)
        rates = ", ".join(
            f"{name} {np.mean(values):.0%}" for name, values in groups.items()
        )
        text = f"[{self.batch.name}] {len(ones)} runs, steps {steps:,}/{total:,}, "
        text += f"{speed:,.0f} steps/s, "
        text += (
            f"success: {rates or 'not known yet'}, "
            if not is_last
            else f"success: {rates}, "
        )
        whole = (
            f"in {duration(spent)}, {done / spent:,.0f} steps/s"
            if is_last
            else f"ETA {left}"
        )
        console.print(text + whole)


def train(files: StudyFiles, runs: Sequence[Run], side_by_side: int) -> int:
    """Train runs of a study as batches, or go on from their last checkpoints; return the exit code.

    So many batches are trained at a time, each in a thread and on a stream of its own.
    """
    require_device()
    batches, others = form(files.path, runs)
    for run, reason in others:
        raise InputError(f"run {run.name}: {reason}")
    before, trainings, futures = (
        sys.getswitchinterval(),
        list[_Training](),
        list[Future[None]](),
    )
    free, stop = threading.Semaphore(side_by_side), threading.Event()
    sys.setswitchinterval(SWITCH_EVERY)
    if threading.current_thread() is threading.main_thread():  # to end in order
        signal.signal(signal.SIGTERM, partial(_end_soon, stop))
    try:
        with ExitStack() as held, ThreadPoolExecutor(side_by_side) as pool:
            try:
                for batch in batches:  # others train while the next is built
                    free.acquire()
                    if stop.is_set():
                        break
                    trainings.append(_Training(batch, files, held))
                    futures.append(
                        pool.submit(trainings[-1].train_in_thread, free, stop)
                    )
                for future in as_completed(futures):
                    future.result()
            except BaseException:
                stop.set()
                raise
    finally:
        sys.setswitchinterval(before)
    return int(any(one.learner.failures for one in trainings))


def _end_soon(stop: threading.Event, *_: Any) -> None:
    """End in order, or at the last saved checkpoints where that takes too long."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    timer = threading.Timer(GRACE, os._exit, [jobs.INTERRUPTED[0]])
    timer.daemon = True
    timer.start()
    stop.set()
    raise KeyboardInterrupt


def _label(config: RunConfig) -> str:
    scene: Any = config.scene
    return (
        f"layout {layouts.short(scene.layout)}" if scene.touch == "on" else "no touch"
    )
