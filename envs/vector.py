"""Workers: environments of one kind in which whole episodes, or anything else, are played side by side.

A job is a function of an environment and a number. What comes out is the job's results
in the order of the numbers, whoever played them and however long each took: the same on
one core and on sixteen, as long as a result depends on nothing but its number. Threads
suffice where the simulator frees the GIL while it steps, as MuJoCo does; elsewhere each
worker is a process.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import ExitStack, closing, contextmanager
from multiprocessing.connection import wait as wait_for
from multiprocessing.util import Finalize
from queue import SimpleQueue
from types import SimpleNamespace
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np

from . import plugins

T = TypeVar("T")
Make = Callable[[], gym.Env[Any, Any]]
IsWanted = Callable[[], bool]
Job = Callable[[gym.Env[Any, Any], int, IsWanted], T]
"""Job of a worker: (env, number, is_wanted) -> result. When `is_wanted` turns false it
may stop and return anything. Picklable, where workers are processes.
"""


class Workers:
    """Environments and who plays in them. Closing them closes all environments."""

    def __init__(self, env: gym.Env[Any, Any], opened: ExitStack | None = None) -> None:
        """Play in `env`, one after the other; `opened` is what has to be closed in the end."""
        self.env, self._opened = env, opened or ExitStack()
        self.observation_space = env.observation_space
        self.action_space = env.action_space
        self._n, self._turn = 1, SimpleNamespace(value=0)
        self._pool: Executor | None = None
        self._play: Callable[..., Any] = _play

    def __len__(self) -> int:
        """Return the number of workers."""
        return self._n

    @property
    def max_episode_steps(self) -> int | None:
        """Number of steps after which an episode is cut off.

        None where the environment does not say.
        """
        limits = [getattr(self.env.unwrapped, "max_episode_steps", None)]
        limit = "_max_episode_steps"  # of a TimeLimit
        if self.env.has_wrapper_attr(limit):
            limits.append(self.env.get_wrapper_attr(limit))
        return min((limit for limit in limits if limit), default=None)

    def compute_reward(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray
    ) -> np.ndarray:
        """Return rewards (n,) of goals (n, goal_size), by the outermost wrapper that computes them.

        Raise ValueError where there is none.
        """
        if not self.env.has_wrapper_attr("compute_reward"):
            raise ValueError("compute_reward: found an environment without it")
        reward = self.env.get_wrapper_attr("compute_reward")
        return np.asarray(reward(achieved_goal, desired_goal, {}))

    def compute_terminated(
        self, achieved_goal: np.ndarray, desired_goal: np.ndarray
    ) -> np.ndarray | None:
        """Return whether goals (n, goal_size) end an episode, (n,); None where nobody says.

        Gymnasium-Robotics' environments say it, some of them for one goal at a time.
        """
        if not self.env.has_wrapper_attr("compute_terminated"):
            return None
        ends = self.env.get_wrapper_attr("compute_terminated")
        pairs = zip(achieved_goal, desired_goal, strict=True)
        return np.array(
            [bool(ends(achieved, desired, {})) for achieved, desired in pairs]
        )

    def play(self, job: Job[T], numbers: Iterable[int]) -> Iterator[T]:
        """Yield the results of `job` for `numbers`, in that order, each as soon as it can be had.

        The workers run ahead. Who has enough stops iterating: what was begun beyond is
        not wanted any more then, and nobody waits for it.
        """
        if self._pool is None:
            for number in numbers:
                yield job(self.env, number, lambda: True)
            return
        self._turn.value += 1
        turn, left = self._turn.value, iter(numbers)
        order = deque[Future[T]]()
        with _death_named():
            try:
                while True:
                    running = [future for future in order if not future.done()]
                    for number in itertools.islice(left, 2 * self._n - len(running)):
                        order.append(self._pool.submit(self._play, job, number, turn))
                    if not order:
                        return
                    if order[0].done():
                        yield order.popleft().result()
                    else:
                        wait(running, return_when=FIRST_COMPLETED)
            finally:
                if self._turn.value == turn:
                    self._turn.value += 1
                for future in order:
                    future.cancel()

    def start_threads(self, envs: Iterable[gym.Env[Any, Any]]) -> None:
        """Play in the environment of this, and in more, in a thread for each."""
        free: SimpleQueue[gym.Env[Any, Any]] = SimpleQueue()
        for env in (self.env, *envs):
            free.put(env)

        def play(job: Job[T], number: int, turn: int) -> T:
            env = free.get()
            try:
                return job(env, number, lambda: self._turn.value == turn)
            finally:
                free.put(env)

        self._n, self._play = free.qsize(), play
        self._pool = self._opened.enter_context(ThreadPoolExecutor(self._n))

    def start_processes(self, n: int, make: Make, set_up: Callable[[], Any]) -> None:
        """Play in `n` processes, each in an environment of its own; they end when this one does.

        `make` and `set_up`, which each calls first, are pickled: functions of a module,
        or `functools.partial` of them; a script that uses this needs its
        ``if __name__ == "__main__"``. What is raised there is raised here.
        """
        # Never forks of this process, which would copy threads' locks and an MPI
        # process's connections. On Linux they are forks of a server that has imported
        # what takes seconds, which is Python's own default from 3.14 on.
        method = "forkserver" if sys.platform == "linux" else "spawn"
        context: Any = multiprocessing.get_context(method)
        context.set_forkserver_preload(["gymnasium", "torch"])  # where installed
        self._n, self._turn = n, context.Value("Q", 0, lock=False)
        args = make, set_up, (*plugins.imported,), self._turn
        pool = ProcessPoolExecutor(n, context, _begin, args)
        self._pool = self._opened.enter_context(pool)
        # They ignore Ctrl-C, which reaches the whole group: this process ends them.
        # Signals can be set in the main thread alone.
        is_main = threading.current_thread() is threading.main_thread()
        before = signal.signal(signal.SIGINT, signal.SIG_IGN) if is_main else None
        with _death_named():
            try:
                begun = [pool.submit(_play, _is_there, 0, 0) for _ in range(n)]
            finally:
                if is_main:
                    signal.signal(signal.SIGINT, before)
            for future in begun:
                future.result()

    def close(self) -> None:
        """Close all environments."""
        self._opened.close()


class WorkerDiedError(ChildProcessError):
    """A worker's process has ended, and nobody asked it to."""


@contextmanager
def _death_named() -> Iterator[None]:
    try:
        yield
    except BrokenExecutor as error:
        raise WorkerDiedError("a worker's process has died") from error


# In a worker's process: its environment, or the error with which it could not be made,
# and the turn.
_here = SimpleNamespace(env=None, error=None, turn=None)


def _begin(
    make: Make, set_up: Callable[[], Any], modules: tuple[str, ...], turn: Any
) -> None:
    """Make the environment of a worker's process."""

    def end_with_parent() -> None:
        wait_for([multiprocessing.parent_process().sentinel])  # type: ignore[union-attr]
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    _here.turn = turn
    try:
        set_up()
        plugins.import_modules(modules)
        _here.env = make()
        Finalize(None, _here.env.close, exitpriority=0)
    except Exception as error:
        _here.error = error


def _is_there(*_: Any) -> None:
    """Do nothing but to answer, as a job."""


def _play(job: Job[T], number: int, turn: int) -> T:
    """Return the result of a job in a worker's process, or raise what survives the way back."""
    try:
        if _here.error is not None:
            raise _here.error
        return job(_here.env, number, lambda: _here.turn.value == turn)
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            raise RuntimeError(f"{type(error).__name__}: {error}") from None
        raise


def start(make: Make, workers: int = 1, set_up: Callable[[], Any] = bool) -> Workers:
    """Start up to `workers` workers with an environment each.

    An environment's ``side_by_side`` says how it may be played in: "threads",
    "processes", or "in turn" where more workers would cost more than they bring. One
    that does not say gets processes, for it may share state with its likes.
    """
    with ExitStack() as opened:
        env = opened.enter_context(closing(make()))
        kind = getattr(env.unwrapped, "side_by_side", "processes")
        played_in = Workers(env, opened)
        if workers > 1 and kind == "threads":
            more = (opened.enter_context(closing(make())) for _ in range(workers - 1))
            played_in.start_threads(more)
        elif workers > 1 and kind == "processes":
            played_in.start_processes(workers, make, set_up)
        played_in._opened = opened.pop_all()
        return played_in
