"""Workers: environments of one kind in which whole episodes, or anything else, are played side by side.

A task is a function of an environment and a number. What comes out is the tasks' results in the
order of their numbers, whoever played them and however long each took: the same on one core and
on sixteen, as long as a task depends on nothing but its number. Threads suffice where the
simulator frees the GIL while it steps, as MuJoCo does; elsewhere each worker is a process.
"""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, SpawnContext
from queue import SimpleQueue
from typing import Any, Protocol, TypeVar

import gymnasium as gym
import numpy as np

Make = Callable[[], gym.Env[Any, Any]]
IsWanted = Callable[[], bool]
T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


class Task(Protocol[T_co]):
    """What a worker does; picklable, where workers are processes."""

    def __call__(self, env: gym.Env[Any, Any], number: int, is_wanted: IsWanted) -> T_co:
        """The result for `number`. When `is_wanted` turns false it may stop and return anything."""


class Workers:
    """Environments and who plays in them. Closing them closes all environments."""

    def __init__(
        self, players: Sequence[Player], env: gym.Env[Any, Any], opened: ExitStack | None = None
    ) -> None:
        """`env` answers what does not depend on an episode; a player may play in it. `opened` is
        what has to be closed in the end."""
        self.env = env
        self._players, self._opened = players, opened or ExitStack()
        self._threads = ThreadPoolExecutor(len(players))
        self._idle: SimpleQueue[Player] = SimpleQueue()  # each ends what it is at before it begins more
        for player in players:
            self._idle.put(player)

    def __len__(self) -> int:
        return len(self._players)

    @property
    def observation_space(self) -> gym.Space[Any]:
        """Of each environment."""
        return self.env.observation_space

    @property
    def action_space(self) -> gym.Space[Any]:
        """Of each environment."""
        return self.env.action_space

    @property
    def max_episode_steps(self) -> int | None:
        """Steps after which an episode is cut off; None where the environment does not say."""
        limits = [getattr(self.env.unwrapped, "max_episode_steps", None)]
        limits += [self.env.spec.max_episode_steps] if self.env.spec else []
        limit = "_max_episode_steps"  # of a TimeLimit around an environment that is not registered
        limits += [self.env.get_wrapper_attr(limit)] if self.env.has_wrapper_attr(limit) else []
        return min((limit for limit in limits if limit), default=None)

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray) -> np.ndarray:
        """Rewards (n,) of goals (n, goal_size), by the outermost wrapper that has an opinion;
        ValueError where there is none."""
        if not self.env.has_wrapper_attr("compute_reward"):
            raise ValueError("compute_reward: found none, allowed environments that have it")
        reward = self.env.get_wrapper_attr("compute_reward")
        return np.asarray(reward(achieved_goal, desired_goal, {}))

    def play(self, task: Task[T], numbers: Iterable[int]) -> Iterator[T]:
        """Results of `task` for `numbers`, in that order, each as soon as it can be had.

        The workers run ahead. Who has enough stops iterating: what was begun beyond is not wanted
        any more then, and nobody waits for it.
        """
        if len(self._players) == 1 and isinstance(self._players[0], LocalPlayer):
            for number in numbers:
                yield self._players[0].play(task, number, lambda: True)
            return
        numbers, is_over, lock = iter(numbers), threading.Event(), threading.Lock()
        begun: deque[Future[T]] = deque()

        def begin() -> None:
            with lock:
                number = None if is_over.is_set() else next(numbers, None)
                if number is not None:
                    begun.append(self._threads.submit(play, number))

        def play(number: int) -> T:
            player = self._idle.get()
            try:
                return player.play(task, number, lambda: not is_over.is_set())
            finally:
                self._idle.put(player)
                begin()  # before this one is known to be done, so that the last is known to be the last

        try:
            for _ in self._players:
                begin()
            while begun:
                yield begun.popleft().result()
        finally:
            is_over.set()

    def close(self) -> None:
        """End the workers and close every environment."""
        self._threads.shutdown()
        self._opened.close()


class Player(Protocol):
    """One worker's hands: an environment here, or a process with one."""

    def play(self, task: Task[T], number: int, is_wanted: IsWanted) -> T:
        """The task's result."""


class LocalPlayer:
    """Plays in an environment of this process."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self.env = env

    def play(self, task: Task[T], number: int, is_wanted: IsWanted) -> T:
        return task(self.env, number, is_wanted)


class WorkerDiedError(OSError):
    """A worker's process has ended, and nobody asked it to."""


class RemotePlayer:
    """Plays in an environment of a process of its own, which ends when this one does.

    `make` and `set_up`, which the process calls first, are pickled: functions of a module, or
    `functools.partial` of them; a script that uses this needs its ``if __name__ == "__main__"``.
    What is raised there is raised here; a process that dies is a WorkerDiedError.
    """

    def __init__(self, make: Make, set_up: Callable[[], None]) -> None:
        context = _processes()
        self._connection, there = context.Pipe()
        self._process = context.Process(target=_serve, args=(there, make, set_up), daemon=True)
        with _ignore_interrupts():  # Ctrl-C reaches the whole group: this process ends the others
            self._process.start()
        there.close()  # so that the end of the process is an end of file here
        self._task: Any = None

    def wait_until_ready(self) -> None:
        """Return when the environment is made; raises what kept it from being made."""
        self._answer()

    def play(self, task: Task[T], number: int, is_wanted: IsWanted) -> T:
        with self._death_named():
            if task is not self._task:
                self._connection.send(task)
                self._task = task
            self._connection.send(number)
            while not self._connection.poll(0.05):
                if not is_wanted():
                    self._connection.send(None)
                    break
        result: T = self._answer()
        return result

    def _answer(self) -> Any:
        with self._death_named():
            answer = self._connection.recv()
        if isinstance(answer, Exception):
            raise answer
        return answer

    @contextmanager
    def _death_named(self) -> Iterator[None]:
        try:
            yield
        except (EOFError, ConnectionError) as error:
            raise WorkerDiedError("a worker's process has died") from error

    def close(self) -> None:
        """End the process."""
        self._connection.close()
        self._process.join()


def _processes() -> ForkServerContext | SpawnContext:
    """How processes start. Never as forks of this one, which would copy threads' locks and an MPI
    process's connections. On Linux they are forks of a server that has imported what takes seconds,
    which is Python's own default from 3.14 on."""
    if sys.platform != "linux":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["gymnasium", "torch"])  # no matter when one is not installed
    return context


@contextmanager
def _ignore_interrupts() -> Iterator[None]:
    """A process that is started meanwhile ignores Ctrl-C for all its life."""
    if threading.current_thread() is not threading.main_thread():  # only there can it be set
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _serve(connection: Connection[Any, Any], make: Make, set_up: Callable[[], None]) -> None:
    """A process's life: play the numbers it is sent, by the task it was sent last.

    None means that the number in play is not wanted any more; when it comes too late, it means
    nothing.
    """
    with suppress(EOFError, ConnectionError), ExitStack() as opened:
        try:
            set_up()
            env = make()
            opened.callback(env.close)
        except Exception as error:
            connection.send(_as_sent(error))
            return
        connection.send(None)
        task: Any = None
        while True:
            message = connection.recv()
            if isinstance(message, int):
                try:
                    answer = task(env, message, lambda: not connection.poll())
                except Exception as error:
                    answer = _as_sent(error)
                connection.send(answer)
            elif message is not None:
                task = message


def _as_sent(error: Exception) -> Exception:
    """An exception that survives the way to the other process."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def _nothing() -> None:
    """What most processes have to set up."""


def start(make: Make, workers: int = 1, set_up: Callable[[], None] = _nothing) -> Workers:
    """Up to `workers` workers with an environment each.

    An environment's ``side_by_side`` says how it may be played in: "threads", "processes", or
    "in turn" where more workers would cost more than they bring. One that does not say gets
    processes, for it may share state with its likes.
    """
    with ExitStack() as opened:

        def made() -> gym.Env[Any, Any]:
            env = make()
            opened.callback(env.close)
            return env

        env = made()
        kind = getattr(env.unwrapped, "side_by_side", "processes")
        players: list[Player] = [LocalPlayer(env)]
        if workers > 1 and kind == "threads":
            players += [LocalPlayer(made()) for _ in range(workers - 1)]
        elif workers > 1 and kind == "processes":
            remote = []
            for _ in range(workers):
                remote.append(RemotePlayer(make, set_up))
                opened.callback(remote[-1].close)
            for player in remote:  # they start side by side
                player.wait_until_ready()
            players = [*remote]
        return Workers(players, env, opened.pop_all())
