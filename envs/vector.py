"""Workers: environments of one kind in which whole episodes, or anything else, are played side by side.

A job is a function of an environment and a number. What comes out is the job's results in the
order of the numbers, whoever played them and however long each took: the same on one core and
on sixteen, as long as a result depends on nothing but its number. Threads suffice where the
simulator frees the GIL while it steps, as MuJoCo does; elsewhere each worker is a process.
"""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, suppress
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np

from . import plugins

T = TypeVar("T")
Make = Callable[[], gym.Env[Any, Any]]
IsWanted = Callable[[], bool]
Job = Callable[[gym.Env[Any, Any], int, IsWanted], T]
"""Job of a worker: (env, number, is_wanted) -> result. When `is_wanted` turns false it may stop and
return anything. Picklable, where workers are processes.
"""


class Workers:
    """Environments and who plays in them. Closing them closes all environments."""

    def __init__(
        self,
        players: Sequence[Player],
        env: gym.Env[Any, Any],
        opened: ExitStack | None = None,
    ) -> None:
        """Take players, and an environment that answers what does not depend on an episode.

        A player may play in `env`. `opened` is what has to be closed in the end.
        """
        self.env, self._players, self._opened = env, players, opened or ExitStack()
        self.observation_space = env.observation_space
        self.action_space = env.action_space
        # One thread each, so that a player ends what it is at before it begins anything else.
        self._threads = [
            self._opened.enter_context(ThreadPoolExecutor(1)) for _ in players
        ]

    def __len__(self) -> int:
        """Return the number of workers."""
        return len(self._players)

    @property
    def max_episode_steps(self) -> int | None:
        """Number of steps after which an episode is cut off.

        None where the environment does not say.
        """
        limits = [getattr(self.env.unwrapped, "max_episode_steps", None)]
        limits.append(getattr(self.env.spec, "max_episode_steps", None))
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

        The workers run ahead. Who has enough stops iterating: what was begun beyond is not wanted
        any more then, and nobody waits for it.
        """
        if len(self._players) == 1 and isinstance(self._players[0], LocalPlayer):
            for number in numbers:
                yield self._players[0].play(job, number, lambda: True)
            return
        left, lock, is_over = iter(numbers), threading.Lock(), threading.Event()
        futures: SimpleQueue[Future[T] | None] = (
            SimpleQueue()
        )  # in order; None: there are no more

        def work(player: Player) -> None:
            while not is_over.is_set():
                with lock:
                    if (number := next(left, None)) is None:
                        break
                    futures.put(future := Future[T]())
                try:
                    result = player.play(job, number, lambda: not is_over.is_set())
                    future.set_result(result)
                except BaseException as error:  # else future.result() never returns
                    future.set_exception(error)
            futures.put(None)

        for player, thread in zip(self._players, self._threads, strict=True):
            thread.submit(work, player)
        try:
            while (future := futures.get()) is not None:
                yield future.result()
        finally:
            is_over.set()

    def close(self) -> None:
        """Close all environments."""
        self._opened.close()


class LocalPlayer:
    """Plays in an environment of this process."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        """Take the environment."""
        self.env = env

    def play(self, job: Job[T], number: int, is_wanted: IsWanted) -> T:
        """Return the result of a job."""
        return job(self.env, number, is_wanted)


class WorkerDiedError(OSError):
    """A worker's process has ended, and nobody asked it to."""


class RemotePlayer:
    """Plays in an environment of a process of its own, which ends when this one does.

    `make` and `set_up`, which the process calls first, are pickled: functions of a module, or
    `functools.partial` of them; a script that uses this needs its ``if __name__ == "__main__"``.
    What is raised there is raised here; a process that dies is a WorkerDiedError.
    """

    def __init__(self, make: Make, set_up: Callable[[], Any]) -> None:
        """Start the process, which answers when its environment is made."""
        # Never forks of this process, which would copy threads' locks and an MPI process's
        # connections. On Linux they are forks of a server that has imported what takes seconds, which
        # is Python's own default from 3.14 on.
        method = "forkserver" if sys.platform == "linux" else "spawn"
        context: Any = multiprocessing.get_context(method)
        context.set_forkserver_preload(["gymnasium", "torch"])  # where installed
        self._connection, there = context.Pipe()
        args = there, make, set_up, plugins.imported
        self._process = context.Process(target=_serve, args=args, daemon=True)
        # It ignores Ctrl-C, which reaches the whole group: this process ends the others. Signals can
        # be set in the main thread alone.
        is_main = threading.current_thread() is threading.main_thread()
        before = signal.signal(signal.SIGINT, signal.SIG_IGN) if is_main else None
        try:
            self._process.start()
        finally:
            if is_main:
                signal.signal(signal.SIGINT, before)
        there.close()  # so that the end of the process is an end of file here
        self._job: Any = None

    def play(self, job: Job[T], number: int, is_wanted: IsWanted) -> T:
        """Return the result of a job, which is sent only where it differs from the last."""
        message, self._job = (None if job is self._job else job, number), None
        result: T = self.answer(message, is_wanted)
        self._job = job  # and not where it raised
        return result

    def answer(self, to: Any = None, is_wanted: IsWanted = lambda: True) -> Any:
        """Send `to` to the process, unless it is None, and return its answer.

        Before anything is sent, the answer is None when the environment is made. Raise the exception
        that the process answers, and WorkerDiedError where it has died.
        """
        try:
            if to is not None:
                self._connection.send(to)
            while not self._connection.poll(0.05):
                if not is_wanted():
                    self._connection.send(None)
                    break
            answer = self._connection.recv()
        except (EOFError, ConnectionError) as error:
            raise WorkerDiedError("a worker's process has died") from error
        if isinstance(answer, Exception):
            raise answer
        return answer

    def close(self) -> None:
        """End the process."""
        self._connection.close()
        self._process.join()


Player = LocalPlayer | RemotePlayer


def _serve(
    connection: Connection[Any, Any],
    make: Make,
    set_up: Callable[[], Any],
    modules: Sequence[str],
) -> None:
    """Live as a worker's process: do the job it was sent last for the numbers it is sent.

    None means that the number in play is not wanted any more; when it comes too late, it means
    nothing.
    """
    with suppress(EOFError, ConnectionError), ExitStack() as opened:

        def opened_env() -> gym.Env[Any, Any]:
            set_up()
            plugins.import_modules(modules)
            return opened.enter_context(closing(make()))

        job: Any = None
        env = _tried(opened_env)
        connection.send(env if isinstance(env, Exception) else None)
        while True:
            if (message := connection.recv()) is not None:
                job, number = message[0] or job, message[1]
                connection.send(_tried(job, env, number, lambda: not connection.poll()))


def _tried(compute: Callable[..., Any], *args: Any) -> Any:
    """Return what it returns, or an exception that survives the way to the other process."""
    try:
        return compute(*args)
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            return RuntimeError(f"{type(error).__name__}: {error}")
        return error


def start(make: Make, workers: int = 1, set_up: Callable[[], Any] = bool) -> Workers:
    """Start up to `workers` workers with an environment each.

    An environment's ``side_by_side`` says how it may be played in: "threads", "processes", or
    "in turn" where more workers would cost more than they bring. One that does not say gets
    processes, for it may share state with its likes.
    """
    with ExitStack() as opened:
        env = opened.enter_context(closing(make()))
        kind = getattr(env.unwrapped, "side_by_side", "processes")
        if workers == 1:
            kind = "in turn"
        players: list[Player] = [LocalPlayer(env)]
        if kind == "threads":
            more = (opened.enter_context(closing(make())) for _ in range(workers - 1))
            players += map(LocalPlayer, more)
        elif kind == "processes":
            processes = (RemotePlayer(make, set_up) for _ in range(workers))
            remote = [opened.enter_context(closing(process)) for process in processes]
            for player in remote:  # they start side by side
                player.answer()
            players = [*remote]
        return Workers(players, env, opened.pop_all())
