"""Several environments side by side, stepped by threads or by processes.

Threads suffice where the simulator releases the GIL while it steps, as MuJoCo does. Where it
holds the GIL, as PyBullet does, each process has a share of the environments. What comes out
does not depend on how many threads or processes there are.
"""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

Make = Callable[[], gym.Env[Any, Any]]
Question = tuple[int, str, Any]
"""(environment, "reset" or "step", seed or action)"""


class Step(NamedTuple):
    """What `gymnasium.Env.step` returns; `algos.Transition` by structure, for neither layer
    imports the other."""

    obs: Any
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


class Envs:
    """`n` environments made by `make()`; any of them can be stepped in any combination. Here they
    are stepped in turn."""

    def __init__(self, make: Make, n: int, *made: gym.Env[Any, Any]) -> None:
        """Those already `made` are among the `n`."""
        self.envs = [*made, *(make() for _ in range(n - len(made)))]
        self._map: Callable[..., Iterable[Any]] = map

    def __len__(self) -> int:
        return len(self.envs)

    @property
    def observation_space(self) -> gym.Space[Any]:
        """Of each environment."""
        return self.envs[0].observation_space

    @property
    def action_space(self) -> gym.Space[Any]:
        """Of each environment."""
        return self.envs[0].action_space

    @property
    def max_episode_steps(self) -> int | None:
        """Steps after which an episode is cut off; None where the environment does not say."""
        env = self.envs[0]
        limits = [getattr(env.unwrapped, "max_episode_steps", None)]
        limits += [env.spec.max_episode_steps] if env.spec else []
        return min((limit for limit in limits if limit), default=None)

    @property
    def n_boolean(self) -> int:
        """How many entries at the end of a goal environment's observation are 0 or 1."""
        return int(getattr(self.envs[0].unwrapped, "n_boolean", 0))

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray) -> np.ndarray:
        """Rewards (n,) of goals (n, goal_size); ValueError where the environment has no such."""
        env: Any = self.envs[0].unwrapped
        if not hasattr(env, "compute_reward"):
            raise ValueError("compute_reward: found none, allowed environments that have it")
        return np.asarray(env.compute_reward(achieved_goal, desired_goal, {}))

    def reset(self, indices: Sequence[int], seeds: Sequence[int]) -> list[Any]:
        """First observations of new episodes of the environments `indices`."""
        return list(self._map(self._reset_one, indices, seeds))

    def step(self, indices: Sequence[int], actions: Sequence[Any] | np.ndarray) -> list[Step]:
        """Step the environments `indices` with actions (len(indices), ...)."""
        return list(self._map(self._step_one, indices, actions))

    def _reset_one(self, index: int, seed: int) -> Any:
        return self.envs[index].reset(seed=seed)[0]

    def _step_one(self, index: int, action: np.ndarray) -> Step:
        obs, reward, terminated, truncated, info = self.envs[index].step(action)
        return Step(obs, float(reward), terminated, truncated, info)

    def close(self) -> None:
        """Close every environment."""
        for env in self.envs:
            env.close()


class ThreadedEnvs(Envs):
    """Stepped by `threads` threads."""

    def __init__(self, make: Make, n: int, threads: int, *made: gym.Env[Any, Any]) -> None:
        super().__init__(make, n, *made)
        self._threads = ThreadPoolExecutor(threads)
        self._map = self._threads.map

    def close(self) -> None:
        self._threads.shutdown()
        super().close()


class ProcessEnvs(Envs):
    """Stepped by `processes` processes, which end when this one does.

    One more environment lives here and answers what does not depend on an episode. `make` is
    pickled: a function of a module, or a `functools.partial` of one; a script that uses this needs
    its ``if __name__ == "__main__"``. What an environment raises is raised here; a process that
    dies is an OSError.
    """

    def __init__(self, make: Make, n: int, processes: int, *made: gym.Env[Any, Any]) -> None:
        super().__init__(make, 1, *made)
        self._n = n
        self._processes: list[BaseProcess] = []
        self._connections: list[Connection[Any, Any]] = []
        try:
            for first in range(processes):
                self._start(make, range(first, n, processes))
            self._exchange({process: [] for process in range(processes)})  # all are there
        except BaseException:
            self.close()
            raise

    def _start(self, make: Make, numbers: range) -> None:
        # A fork would copy threads' locks and an MPI process's connections.
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        process = context.Process(target=_serve, args=(there, make, numbers), daemon=True)
        with _ignore_interrupts():  # Ctrl-C reaches the whole group: this process ends the others
            process.start()
        there.close()  # so that the end of the process is an end of file here
        self._processes.append(process)
        self._connections.append(here)

    def __len__(self) -> int:
        return self._n

    def reset(self, indices: Sequence[int], seeds: Sequence[int]) -> list[Any]:
        return self._ask("reset", indices, seeds)

    def step(self, indices: Sequence[int], actions: Sequence[Any] | np.ndarray) -> list[Step]:
        return self._ask("step", indices, actions)

    def _ask(self, question: str, indices: Sequence[int], arguments: Sequence[Any] | np.ndarray) -> Any:
        """Answers of environments in their order; all processes work at once."""
        n = len(self._processes)
        asked: dict[int, list[Question]] = {}
        for index, argument in zip(indices, arguments, strict=True):
            asked.setdefault(index % n, []).append((index, question, argument))
        answers = self._exchange(asked)
        return [answers[index % n].pop(0) for index in indices]

    def _exchange(self, questions: dict[int, list[Question]]) -> dict[int, list[Any]]:
        """Answers of each process to its questions, in their order."""
        try:
            for process, asked in questions.items():
                self._connections[process].send(asked)
            answers = {process: self._connections[process].recv() for process in questions}
        except (EOFError, ConnectionError) as error:
            raise OSError("a process that steps environments has died") from error
        for answer in answers.values():
            if isinstance(answer, Exception):
                raise answer
        return answers

    def close(self) -> None:
        for connection in self._connections:
            connection.close()
        for process in self._processes:
            process.join()
        super().close()


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


def _serve(connection: Connection[Any, Any], make: Make, numbers: range) -> None:
    """A process's life: answer questions about its environments until nobody asks."""
    envs: Envs | None = None
    with suppress(EOFError, ConnectionError):
        while True:
            questions = connection.recv()
            try:
                envs = envs or Envs(make, len(numbers))
                answer: Any = [_answer(envs, numbers, *question) for question in questions]
            except Exception as error:
                answer = error
            connection.send(answer)
    if envs is not None:
        envs.close()


def _answer(envs: Envs, numbers: range, index: int, question: str, argument: Any) -> Any:
    place = numbers.index(index)
    ask = envs.reset if question == "reset" else envs.step
    return ask([place], [argument])[0]


def start(make: Make, n: int, cores: int = 1) -> Envs:
    """`n` environments on up to `cores` cores."""
    several = min(n, cores)
    if several == 1:
        return Envs(make, n)
    first = make()
    holds_gil = getattr(first.unwrapped, "holds_gil", False)
    try:
        return (ProcessEnvs if holds_gil else ThreadedEnvs)(make, n, several, first)
    except BaseException:
        first.close()
        raise
