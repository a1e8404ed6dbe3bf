"""Train learners of both libraries, look at them, and let them play."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import numpy as np
import stable_baselines3 as sb3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from tactilerl.algos.ddpg_her import DDPGHERConfig
from tactilerl.algos.mpi import Communicator
from tactilerl.envs import vector

FIRST_START = 10_000_000  # not a start of training
Act = Callable[[Any], np.ndarray]
"""Observation -> action without exploration."""


def learn(kind: Any, config: Any, make: vector.Make, seed: int, steps: int) -> Iterator[Any]:
    """Yield one of our learners untrained, and after each update until it has taken so many steps."""
    with closing(vector.start(make)) as workers:
        learner = kind(config, workers, Communicator(), seed, steps)
        yield learner
        while learner.env_steps < steps:
            learner.collect()
            learner.update()
            yield learner


class Looks(BaseCallback):
    """Call `look` wherever Stable-Baselines3 is about to collect, and at the end."""

    def __init__(self, start: Callable[[], Any]) -> None:
        """Take a function that makes the looking object, such as a `Run`, when training begins."""
        super().__init__()
        self.start = start

    def act(self, obs: Any) -> np.ndarray:
        """Return the action for one observation, normalized where the learner's are."""
        if normalizer := self.model.get_vec_normalize_env():
            obs = normalizer.normalize_obs(obs)
        return self.model.predict(obs, deterministic=True)[0]

    def _on_training_start(self) -> None:
        self.run = self.start()

    def _on_rollout_start(self) -> None:
        self.run.look(self.num_timesteps, self.act)

    _on_training_end = _on_rollout_start

    def _on_step(self) -> bool:
        return not self.run.is_solved


def sb3_ddpg(
    env: Any, seed: int, config: DDPGHERConfig, max_steps: int, normalize: bool = False
) -> Any:
    """Return Stable-Baselines3's DDPG with its HER buffer as `config`."""
    if normalize:
        env = VecNormalize(DummyVecEnv([lambda: env]), norm_reward=False, clip_obs=config.norm_clip)
    none = np.zeros(env.action_space.shape)
    noise = NormalActionNoise(none, none + config.noise_eps)
    return sb3.DDPG(
        "MultiInputPolicy", env, learning_rate=config.actor_lr, buffer_size=config.buffer_size,
        batch_size=config.batch_size, tau=1.0 - config.polyak ** (1.0 / config.n_batches),
        gamma=1.0 - 1.0 / max_steps, train_freq=(config.n_rollouts, "episode"),
        gradient_steps=config.n_batches, action_noise=noise,
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
