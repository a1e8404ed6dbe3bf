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
from contextlib import ExitStack, contextmanager, suppress
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, SpawnContext
from queue import SimpleQueue
from typing import Any, Generic, Protocol, TypeVar

import gymnasium as gym
import numpy as np

Make = Callable[[], gym.Env[Any, Any]]
IsWanted = Callable[[], bool]
T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)


class Job(Protocol[T_co]):
    """What a worker does; picklable, where workers are processes."""

    def __call__(self, env: gym.Env[Any, Any], number: int, is_wanted: IsWanted) -> T_co:
        """The result for `number`. When `is_wanted` turns false it may stop and return anything."""


class _Ahead(Generic[T]):
    """Numbers that workers begin in order, running ahead, and the futures of their results."""

    def __init__(self, numbers: Iterable[int]) -> None:
        self._numbers, self._lock = iter(numbers), threading.Lock()
        self.futures: SimpleQueue[Future[T] | None] = SimpleQueue()
        """In that order; None when there are no more."""
        self.is_over = False

    def work(self, player: Player, job: Job[T]) -> None:
        """One worker's share."""
        while (begun := self._begin()) is not None:
            future, number = begun
            try:
                future.set_result(player.play(job, number, lambda: not self.is_over))
            except Exception as error:
                future.set_exception(error)

    def _begin(self) -> tuple[Future[T], int] | None:
        with self._lock:
            number = None if self.is_over else next(self._numbers, None)
            future = None if number is None else Future[T]()
            self.futures.put(future)
            return None if number is None or future is None else (future, number)


class Workers:
    """Environments and who plays in them. Closing them closes all environments."""

    def __init__(
        self, players: Sequence[Player], env: gym.Env[Any, Any], opened: ExitStack | None = None
    ) -> None:
        """`env` answers what does not depend on an episode; a player may play in it. `opened` is
        what has to be closed in the end."""
        self.env = env
        self._players, self._opened = players, opened or ExitStack()
        # One thread each, so that a player ends what it is at before it begins anything else.
        self._threads = [ThreadPoolExecutor(1) for _ in players]

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

    def play(self, job: Job[T], numbers: Iterable[int]) -> Iterator[T]:
        """Results of `job` for `numbers`, in that order, each as soon as it can be had.

        The workers run ahead. Who has enough stops iterating: what was begun beyond is not wanted
        any more then, and nobody waits for it.
        """
        if len(self._players) == 1 and isinstance(self._players[0], LocalPlayer):
            for number in numbers:
                yield self._players[0].play(job, number, lambda: True)
            return
        ahead = _Ahead[T](numbers)
        for player, thread in zip(self._players, self._threads, strict=True):
            thread.submit(ahead.work, player, job)
        try:
            while (future := ahead.futures.get()) is not None:
                yield future.result()
        finally:
            ahead.is_over = True

    def close(self) -> None:
        """End the workers and close every environment."""
        for thread in self._threads:
            thread.shutdown()
        self._opened.close()


class Player(Protocol):
    """One worker's hands: an environment here, or a process with one."""

    def play(self, job: Job[T], number: int, is_wanted: IsWanted) -> T:
        """The job's result."""


class LocalPlayer:
    """Plays in an environment of this process."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        self.env = env

    def play(self, job: Job[T], number: int, is_wanted: IsWanted) -> T:
        return job(self.env, number, is_wanted)


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
        self._job: Any = None

    def wait_until_ready(self) -> None:
        """Return when the environment is made; raises what kept it from being made."""
        self._answer()

    def play(self, job: Job[T], number: int, is_wanted: IsWanted) -> T:
        with self._death_named():
            self._connection.send((None if job is self._job else job, number))
            self._job = job
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
    """A process's life: do the job it was sent last for the numbers it is sent.

    None means that the number in play is not wanted any more; when it comes too late, it means
    nothing.
    """
    with suppress(EOFError, ConnectionError), ExitStack() as opened:
        job: Any = None
        try:
            set_up()
            env = make()
            opened.callback(env.close)
            answer: Any = None
        except Exception as error:
            connection.send(_as_sent(error))
            return
        while True:
            connection.send(answer)
            while (message := connection.recv()) is None:
                pass
            job, number = message[0] or job, message[1]
            try:
                answer = job(env, number, lambda: not connection.poll())
            except Exception as error:
                answer = _as_sent(error)


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
