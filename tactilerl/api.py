"""tactilerl as a library: train on any Gymnasium environment, evaluate, run what the commands run.

import tactilerl

env = tactilerl.make("shadow", layout=4)
ppo = tactilerl.PPO(env, seed=0)
ppo.learn(50_000, progress=True)
ppo.save("my_policy.pt")
policy = tactilerl.load_policy("my_policy.pt")
print(tactilerl.evaluate(policy, env, episodes=20))
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import torch

from . import envs
from .algos import mpi, recipes
from .algos.mpi import Communicator
from .algos.policy import Policy, Spaces
from .envs import validation, vector
from .envs.layouts import Layout
from .envs.validation import require_known
from .machine import WorkerCount, free_cores
from .runs import evaluation, policies, training
from .runs.config import RunConfig, RunOptions
from .runs.store import resolve
from .terminal.epochs import EpochLog

Env = gym.Env[Any, Any] | str | Callable[[], gym.Env[Any, Any]]
"""An environment, which the caller closes; or an id, or a function that makes one."""
NEEDS = (
    '; a script that plays in processes needs `if __name__ == "__main__":`, and a function that '
    "makes environments above it, with a name; or give workers=1"
)
Callback = Callable[[dict[str, Any]], Any]


class Learner:
    """Learn in an environment; the common part of `PPO` and `DDPGHER`."""

    algo: ClassVar[str]

    def __init__(
        self,
        env: Env,
        *,
        seed: int = 0,
        workers: int | None = None,
        device: str = "cpu",
        recipe: str = recipes.PAPER,
        **hyperparameters: Any,
    ) -> None:
        """Make a learner for `env`, with untrained networks.

        `env` is an environment with Box or goal-Dict observations and bounded Box
        actions, whose episodes end; wrap it as you like. Or pass an id, or a function
        that makes one, to play `workers` episodes side by side: results are the same
        with any number. (Environments that need a process each need a function that can
        be pickled: one of a module, or a `functools.partial` of it.)

        `seed` is the random seed of everything, `device` PyTorch's device for the
        networks. Hyperparameters are the flags of ``tactilerl train``, with the same
        defaults: those of `recipe`, such as "paper" or "steady".

        Raises ValueError, in one line, for an invalid argument.
        """
        options = dict(seed=seed, workers=workers, device=device)
        learner = recipes.recipe(self.algo, recipe)
        known = validation.names(learner) | {*options, "recipe"}
        require_known(hyperparameters, known)
        usual = RunConfig(RunOptions(algo=self.algo), None, learner)
        self._chosen = usual.choose(options | hyperparameters)
        self.config = self._chosen.learner
        self._comm, self._epoch = Communicator(), 0
        start = partial(_start, env, workers)
        with _one_thread():  # a thread that is started inside has one too
            started = training.start_learner(self._chosen, start, self._comm)
        self._learner, self._workers = started

    @property
    def env_steps(self) -> int:
        """The environment steps learned from so far."""
        return self._learner.env_steps

    def learn(
        self,
        total_timesteps: int,
        *,
        progress: bool = False,
        callback: Callback | None = None,
        tensorboard: str | Path | None = None,
    ) -> Learner:
        """Learn for `total_timesteps` environment steps, and to the end of the cycle that reaches them.

        Call it again to go on, for `total_timesteps` more; what is annealed ends with
        this call. Returns the learner.

        `progress` shows what ``tactilerl train`` shows. `callback` is called after
        every epoch with its row of ``progress.csv`` (``env_steps``, ``mean_return``,
        ``success_rate``, ...) and stops the learning by returning False. `tensorboard`
        is a folder for events of the same columns.

        Raises DivergenceError (a FloatingPointError) when an observation, a reward, a
        loss or a parameter is no longer finite, and ValueError when the learner cannot
        use the rewards.
        """
        run = self._chosen.choose({"total_timesteps": total_timesteps}).run
        learner = self._learner
        learner.total_timesteps = learner.env_steps + run.total_timesteps
        events = None if tensorboard is None else Path(tensorboard)
        log = EpochLog(learner, self._comm, events, is_quiet=not progress)
        with _one_thread(), closing(log):
            if not self._epoch:
                learner.check()
            for row in training.epochs(learner, self._epoch):
                self._epoch = row["epoch"]
                log.epoch(row)
                if callback is not None and callback(row) is False:
                    break
        return self

    def policy(self) -> Policy:
        """Return a copy of the current policy; further learning does not change it."""
        return copy.deepcopy(self._learner.policy())

    def save(self, path: str | Path) -> None:
        """Write the current policy to a file that `load_policy` reads, replacing an older one.

        The file holds what acting needs. To go on with the learning some day, use
        `train`.
        """
        policies.save_policy(path, self.algo, self._learner)

    def close(self) -> None:
        """Close the environments that the learner made; one that it was given stays open."""
        self._workers.close()


class PPO(Learner):
    """Learn by proximal policy optimisation.

    Its hyperparameters are the fields of `tactilerl.algos.ppo.PPOConfig`.
    """

    algo = "ppo"


class DDPGHER(Learner):
    """Learn by DDPG with hindsight experience replay, in goal environments.

    Its hyperparameters are the fields of `tactilerl.algos.ddpg_her.DDPGHERConfig`.
    """

    algo = "ddpg_her"


def evaluate(
    policy: Any,
    env: Env,
    *,
    episodes: int = 100,
    stochastic: bool = False,
    workers: int | None = None,
) -> dict[str, Any]:
    """Play episodes with a policy, from the same starts every time.

    `policy` is what `load_policy` returns, a learner, a function of an observation that
    returns an action, or an object with `predict`, such as a model of
    Stable-Baselines3. Returns `success_rate` (where the environment reports
    ``is_success``) and `mean_return`, their 95 % intervals `success_rate_ci` (Wilson)
    and `mean_return_ci` (bootstrap), `mean_length` in steps and more, as
    ``tactilerl evaluate --json`` does. `stochastic` keeps the exploration noise; for `env` and
    `workers` see `PPO`. Raises ValueError when the policy does not fit `env`.
    """
    validation.require_type(episodes, evaluation.EpisodeCount, "episodes")
    player = policy.policy() if isinstance(policy, Learner) else policy
    with _one_thread(), closing(_start(env, workers)) as played_in:
        spaces = Spaces(played_in.observation_space, played_in.action_space)
        if isinstance(player, Policy):
            player.require_spaces(spaces)
        else:
            player = evaluation.OthersPolicy(player, spaces, stochastic)
        played = played_in.play(evaluation.task(player, stochastic), range(episodes))
        return evaluation.summarise([evaluation.row(episode) for episode in played])


def design(
    *, taxels: int | str = "", workers: int | None = None, **flags: Any
) -> Layout:
    """Choose where a hand's taxels go, as ``tactilerl design`` does; a layout for ``make(layout=...)``.

    Flags of the command are keywords, as in
    ``design(scene="handover", taxels=1, only=("palm",))``. Of a range of numbers it is
    the layout with the most taxels, of a budget the best that it buys. Raises
    ValueError, in one line, for an invalid flag, and for scenes in which nothing is
    handed over.
    """
    from .placement import choice
    from .placement.candidates import DesignFlags, Pool

    require_known(flags, validation.names(DesignFlags))
    chosen = {**flags, "taxels": str(taxels), "workers": workers}
    read = validation.replace(DesignFlags(), chosen)
    result = choice.design(Pool.of(read), workers or free_cores())
    return result.layout(max(result.chosen))


def train(
    env: str | None = None,
    *,
    algo: str | None = None,
    recipe: str | None = None,
    scene: str | None = None,
    out: str | Path | None = None,
    resume: str | Path | None = None,
    **flags: Any,
) -> Path:
    """Train as ``tactilerl train`` does, and return the run folder.

    `load_policy` and the commands take that folder. Flags of the command are keywords,
    as in ``train("shadow", algo="ppo", layout=4, seed=1)``; `recipe` is "paper" where
    nothing is said; `scene` is a named scene or its file. A run that is in `out`
    already goes on exactly where its last epoch ended, if it has these settings;
    `resume` goes on with the run in a folder, whatever its settings.

    Raises ValueError naming an unknown or invalid flag, and DivergenceError (a
    FloatingPointError) when an observation, a reward, a loss or a parameter is no
    longer finite; the last checkpoint is kept.
    """
    for name, folder in {"resume": resume, "out": out}.items():
        if folder is not None and not str(folder):
            raise ValueError(f"{name}: found '', allowed a folder")
    base = resolve(algo, env or "", recipe, scene, resume, out)
    named = {"env": env, "algo": algo, "out": None if out is None else str(out)}
    flags |= {name: value for name, value in named.items() if value is not None}
    return training.train(base.choose(flags), mpi.world())


def _start(env: Env, workers: int | None) -> vector.Workers:
    """Return workers that play in `env`; closing them closes only what was made here.

    Raise ValueError for an environment that cannot be made, or not side by side.
    """
    validation.require_type(workers, WorkerCount, "workers")
    if isinstance(env, gym.Env):
        if workers not in (None, 1):
            raise ValueError(
                f"workers: found {workers} with one environment, allowed with an id or a function "
                "that makes environments"
            )
        return vector.Workers(env)
    make = partial(envs.make, env) if isinstance(env, str) else env
    if not callable(make):
        raise ValueError(
            f"env: found {type(env).__name__}, allowed an environment, an id or a function"
        )
    one_thread = partial(torch.set_num_threads, 1)
    try:
        return vector.start(make, workers or 1, one_thread)
    except (AttributeError, TypeError, ImportError, OSError) as error:
        hint = NEEDS if (workers or 1) > 1 else ""
        raise ValueError(f"env: {error}{hint}") from error


@contextmanager
def _one_thread() -> Iterator[None]:
    """Have PyTorch compute with one thread inside."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
