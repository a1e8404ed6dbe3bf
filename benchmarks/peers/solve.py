"""Contenders in solving: seconds and steps until a toy with a known optimum is solved.

Both libraries get the hyperparameters of tests/algos/test_toy_learning.py. What cannot be made equal:

- PPO: Stable-Baselines3 clips the gradient of actor and critic together, normalizes advantages
  in each minibatch, and its mean action has no tanh. Its policy's variance is fixed and its first
  weights are orthogonal, as ours are here.
- DDPG+HER: Stable-Baselines3 has no penalty on actions, no bounds on targets and no uniformly
  random actions but in the first episodes. Its target networks move a little with every update, as
  far in forty as ours do in one step after them. It runs without a normalizer of observations, as it
  does by default, and with VecNormalize, as ours always has one.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any

import numpy as np
import stable_baselines3 as sb3
import torch
from scipy import stats
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tactilerl import envs
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.envs import vector
from tactilerl.envs.toy import LQREnv, PointReachEnv

from benchmarks.command import interval, markdown, progress

SEEDS = range(6)
FIRST_START = 10_000_000  # not a start of training
Act = Callable[[Any], np.ndarray]
"""Observation -> action without exploration."""
PPO_CONFIG = PPOConfig(
    hidden=(64, 64), actor_lr=1e-3, n_passes=20, n_minibatches=12, gae_lambda=0.9,
    action_variance=0.02, orthogonal_init=True, anneal_lr=True,
    steps_per_epoch=17 * LQREnv.max_episode_steps, truncation="bootstrap",
)  # fmt: skip
DDPG_CONFIG = DDPGHERConfig(hidden=(64, 64), action_l2=0.1, polyak=0.9, batch_size=128)
OURS, THEIRS = "tactilerl", "stable-baselines3"


@dataclass
class Run:
    """One seed's way to the solution. The clock stands still while the policy is looked at."""

    toy: Toy
    seconds: float = 0.0
    steps: int = 0
    is_solved: bool = False
    _since: float = field(default_factory=time.process_time)

    def look(self, steps: int, act: Act) -> None:
        """Play `act` every `toy.every` steps."""
        if steps - self.steps >= self.toy.every:
            self.seconds += time.process_time() - self._since
            self.steps, self.is_solved = steps, self.toy.is_solved(act)
            self._since = time.process_time()


def ours(toy: Toy, seed: int) -> Run:
    """Train our learner until it has solved the toy."""
    with closing(vector.start(partial(envs.make, toy.name))) as workers:
        learner = toy.kind(toy.config, workers, Communicator(), seed, toy.cap)
        run = Run(toy)
        while learner.env_steps < toy.cap and not run.is_solved:
            learner.collect()
            learner.update()
            run.look(learner.env_steps, learner.policy().act)
    return run


class Looks(BaseCallback):
    """Look wherever Stable-Baselines3 is about to collect, and at the end."""

    def __init__(self, toy: Toy) -> None:
        super().__init__()
        self.toy = toy

    def act(self, obs: Any) -> np.ndarray:
        """Return the action for one observation, normalized where the learner's are."""
        if normalizer := self.model.get_vec_normalize_env():
            obs = normalizer.normalize_obs(obs)
        return self.model.predict(obs, deterministic=True)[0]

    def _on_training_start(self) -> None:
        self.run = Run(self.toy)

    def _on_rollout_start(self) -> None:
        self.run.look(self.num_timesteps, self.act)

    _on_training_end = _on_rollout_start

    def _on_step(self) -> bool:
        return not self.run.is_solved


def theirs(make: Callable[[Any, int], Any], toy: Toy, seed: int) -> Run:
    """Train a learner of Stable-Baselines3 until it has solved the toy."""
    looks = Looks(toy)
    make(envs.make(toy.name), seed).learn(toy.cap, callback=looks)
    return looks.run


def their_ppo(env: Any, seed: int) -> Any:
    """Return Stable-Baselines3's PPO as PPO_CONFIG."""
    config = PPO_CONFIG
    model = sb3.PPO(
        "MlpPolicy", env, learning_rate=lambda left: left * config.actor_lr,
        n_steps=config.steps_per_epoch, batch_size=config.steps_per_epoch // config.n_minibatches,
        n_epochs=config.n_passes, gamma=config.gamma, gae_lambda=config.gae_lambda,
        clip_range=config.clip_range, vf_coef=1.0, max_grad_norm=config.max_grad_norm,
        policy_kwargs={
            "net_arch": list(config.hidden), "activation_fn": torch.nn.ReLU,
            "log_std_init": float(np.log(config.action_variance) / 2),
        },
        seed=seed, device="cpu",
    )  # fmt: skip
    model.policy.log_std.requires_grad_(False)
    return model


def their_ddpg(env: Any, seed: int, normalize: bool = False) -> Any:
    """Return Stable-Baselines3's DDPG with its HER buffer as DDPG_CONFIG."""
    config = DDPG_CONFIG
    if normalize:
        env = VecNormalize(DummyVecEnv([lambda: env]), norm_reward=False, clip_obs=config.norm_clip)
    none = np.zeros(env.action_space.shape)
    return sb3.DDPG(
        "MultiInputPolicy", env, learning_rate=config.actor_lr, buffer_size=config.buffer_size,
        batch_size=config.batch_size, tau=1.0 - config.polyak ** (1.0 / config.n_batches),
        gamma=1.0 - 1.0 / PointReachEnv.max_episode_steps, gradient_steps=config.n_batches,
        train_freq=(config.n_rollouts, "episode"),
        action_noise=NormalActionNoise(none, none + config.noise_eps),
        replay_buffer_class=sb3.HerReplayBuffer, replay_buffer_kwargs={"n_sampled_goal": 4},
        policy_kwargs={"net_arch": list(config.hidden)}, seed=seed, device="cpu",
    )  # fmt: skip


def play(env: Any, act: Act, episodes: int) -> Iterator[tuple[float, float]]:
    """Yield return and success of each episode without exploration."""
    for index in range(episodes):
        obs, _ = env.reset(seed=FIRST_START + index)
        total, is_done = 0.0, False
        while not is_done:
            obs, reward, terminated, truncated, info = env.step(act(obs))
            total, is_done = total + float(reward), terminated or truncated
        yield total, float(info.get("is_success", np.nan))


def is_near_optimal(act: Act, episodes: int = 20) -> bool:
    """Return whether the mean return is within 5 % of the Riccati optimum."""
    return _within(
        1.05 * optimal_cost(episodes), (-total for total, _ in play(envs.make("lqr"), act, episodes))
    )


@cache
def optimal_cost(episodes: int) -> float:
    """Return the Riccati optimum, summed over the starts of `play`."""
    env = envs.make("lqr")
    starts = [env.reset(seed=FIRST_START + index)[0] for index in range(episodes)]
    return -sum(LQREnv.optimal_return(start.astype(np.float64)) for start in starts)


def reaches(act: Act, goals: int = 100) -> bool:
    """Return whether at least 95 % of the goals are reached."""
    played = play(envs.make("point-reach"), act, goals)
    return _within(0.05 * goals, (1.0 - success for _, success in played))


def _within(budget: float, losses: Iterable[float]) -> bool:
    """Return whether the sum stays in the budget; ends at the first loss that exceeds it."""
    return all(total <= budget + 1e-9 for total in itertools.accumulate(losses))


@dataclass(frozen=True)
class Toy:
    """A toy, when it is solved, and how both libraries learn it."""

    name: str
    is_solved: Callable[[Act], bool]
    every: int
    """Environment steps between two looks at the policy, at least."""
    cap: int
    """Environment steps after which a seed counts as not solved."""
    kind: Any
    config: Any
    theirs: dict[str, Callable[[Any, int], Any]]
    """(environment, seed) -> a learner of Stable-Baselines3, by name."""


TOYS = {
    "LQR, PPO": Toy("lqr", is_near_optimal, 1000, 40_000, PPO, PPO_CONFIG, {THEIRS: their_ppo}),
    "point-reach, DDPG+HER": Toy(
        "point-reach",
        reaches,
        250,
        10_000,
        DDPGHER,
        DDPG_CONFIG,
        {THEIRS: their_ddpg, f"{THEIRS}, VecNormalize": partial(their_ddpg, normalize=True)},
    ),
}


def solve() -> dict[str, Any]:
    """Train every seed of every library, in turn."""
    result = {}
    for title, toy in TOYS.items():
        contenders = {OURS: ours} | {name: partial(theirs, make) for name, make in toy.theirs.items()}
        runs: dict[str, list[Run]] = {name: [] for name in contenders}
        for seed in progress(SEEDS, title):
            for name, contender in contenders.items():
                runs[name].append(contender(toy, seed))
        result[title] = _summary(runs)
    return result


def _summary(runs: dict[str, list[Run]]) -> dict[str, Any]:
    """Return means with intervals; a seed that was not solved counts as if at the cap."""
    result: dict[str, Any] = {"seeds": len(SEEDS)}
    for name, group in runs.items():
        seconds = [run.seconds for run in group]
        result[name] = {
            "not_solved": sum(not run.is_solved for run in group),
            "seconds": _with_interval(np.mean, seconds),
            "env_steps": _with_interval(np.mean, [float(run.steps) for run in group]),
        }
        if name != OURS:
            reference = [run.seconds for run in runs[OURS]]
            result[name]["ratio"] = _with_interval(
                lambda a, b, axis: a.mean(axis) / b.mean(axis), seconds, reference
            )
    return result


def _with_interval(statistic: Callable[..., Any], *samples: list[float]) -> list[float]:
    """Return value, low and high of a bootstrap over seeds, 95 %."""
    data = tuple(np.array(sample) for sample in samples)
    result = stats.bootstrap(data, statistic, method="percentile", vectorized=True, rng=0)
    ends = result.confidence_interval
    return [float(statistic(*data, axis=0)), float(ends.low), float(ends.high)]


def show(solved: dict[str, Any]) -> None:
    """Print one table."""
    rows: list[tuple[str, ...]] = []
    for title, row in solved.items():
        for name, result in row.items():
            if name == "seeds":
                continue
            seconds = interval(*result["seconds"], ".1f")
            steps = interval(*result["env_steps"], ",.0f")
            ratio = interval(*result["ratio"], ".1f") if "ratio" in result else "1"
            not_solved = f"{result['not_solved']} of {row['seeds']}"
            rows.append((f"{title}: {name}", seconds, ratio, steps, not_solved))
    markdown("| | processor time, s | relative to ours | environment steps | not solved |", rows)
