"""Contenders in updating: our learners, Stable-Baselines3's, and the matrix products alone."""

from __future__ import annotations

import itertools
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import stable_baselines3 as sb3
import torch
from stable_baselines3.common.logger import Logger
from tactilerl.algos.ddpg_her import DDPGHER, DDPGHERConfig
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.ppo import PPO, PPOConfig
from tactilerl.envs import vector

from benchmarks.command import Contender, contest, markdown

OURS, THEIRS, BOUND = "tactilerl", "stable-baselines3", "matrix products"
WIDTHS = [256] * 3
UPDATES = 40  # of one turn
# PPO-for-Beginners' minibatch on the paper's PyBullet set-up, layout 2.
PPO_BATCH, PPO_MINIBATCHES, PPO_OBS, PPO_ACTIONS = 1000, 6, 97, 7
PASSES = 8
# DDPG+HER on the Shadow Hand, layout 1; sizes of observations count the goal.
DDPG_BATCH, DDPG_OBS, DDPG_ACTIONS = 256, 200, 23
EPISODES = 50  # in the replay
GOAL, STEPS = 3, 100  # of the goals, and of an episode
PPO_SIZES, DDPG_SIZES = (PPO_OBS - GOAL, PPO_ACTIONS), (DDPG_OBS - GOAL, DDPG_ACTIONS)


class RandomGoals(gym.Env[Any, Any]):
    """Random numbers in the right shapes; `n_obs` does not count the goals."""

    max_episode_steps = STEPS

    def __init__(self, n_obs: int, n_actions: int) -> None:
        sizes = {"observation": n_obs, "achieved_goal": GOAL, "desired_goal": GOAL}
        boxes = {k: gym.spaces.Box(-np.inf, np.inf, (n,), np.float32) for k, n in sizes.items()}
        self.observation_space = gym.spaces.Dict(boxes, seed=0)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (n_actions,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Return a random observation."""
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        """Return another observation, with its reward."""
        self.steps += 1
        obs = self.observation_space.sample()
        reward = float(self.compute_reward(obs["achieved_goal"], obs["desired_goal"], {}))
        return obs, reward, False, self.steps >= STEPS, {}

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> Any:
        """Return 0 where the goal is reached, and −1 elsewhere."""
        return (np.linalg.norm(achieved - desired, axis=-1) < 1.0) - 1.0


def fed(kind: Any, config: Any, n_obs: int, n_actions: int) -> Any:
    """Return a learner of this kind that has collected there once."""
    workers = vector.start(partial(RandomGoals, n_obs, n_actions))
    learner = kind(config, workers, Communicator(), 0, 10**6)
    learner.collect()
    return learner


def sb3_ppo() -> Contender:
    """Return Stable-Baselines3's PPO.train on a batch of the same shapes and networks."""
    env = gym.wrappers.FilterObservation(RandomGoals(*PPO_SIZES), ["observation", "desired_goal"])
    model = sb3.PPO(
        "MlpPolicy", gym.wrappers.FlattenObservation(env), n_steps=PPO_BATCH, n_epochs=PASSES,
        batch_size=-(-PPO_BATCH // PPO_MINIBATCHES), device="cpu",
        policy_kwargs={"net_arch": {"pi": WIDTHS, "vf": WIDTHS}, "activation_fn": torch.nn.ReLU},
    )  # fmt: skip
    model.set_logger(Logger(None, []))
    model.learn(PPO_BATCH)
    model.set_logger(Logger(None, []))

    def run() -> int:
        model.train()
        return PPO_MINIBATCHES * PASSES

    return run


def sb3_ddpg() -> Any:
    """Return Stable-Baselines3's DDPG with the same networks, batch and replay contents."""
    model = sb3.DDPG(
        "MultiInputPolicy", RandomGoals(*DDPG_SIZES), replay_buffer_class=sb3.HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4}, batch_size=DDPG_BATCH, buffer_size=100_000,
        learning_starts=EPISODES * STEPS, policy_kwargs={"net_arch": WIDTHS}, device="cpu",
    )  # fmt: skip
    model.learn(EPISODES * STEPS + 1)
    return model


def products(batch: int, *work: tuple[list[int], int, int, int]) -> Contender:
    """Return the matrix products that updates cannot do without: what no implementation beats.

    Each network in `work` is its sizes, and how often an update goes through it: forward, for
    gradients of weights, for gradients of inputs; the last not at the first layer the last time.
    """
    tensors = {
        (i, o): (torch.randn(batch, i), torch.randn(o, i), torch.randn(batch, o))
        for sizes, *_ in work
        for i, o in itertools.pairwise(sizes)
    }

    def run() -> int:
        for _ in range(UPDATES):
            for sizes, forward, of_weights, of_inputs in work:
                for layer, shape in enumerate(itertools.pairwise(sizes)):
                    x, weight, grad = tensors[shape]
                    for _ in range(forward):
                        x @ weight.T
                    for _ in range(of_weights):
                        grad.T @ x
                    for _ in range(of_inputs if layer else of_inputs - 1):
                        grad @ weight
        return UPDATES

    return run


def ppo_products() -> Contender:
    """Return the products of one minibatch through actor and critic."""
    actor, critic = ([PPO_OBS, *WIDTHS, outputs] for outputs in (PPO_ACTIONS, 1))
    return products(PPO_BATCH // PPO_MINIBATCHES, (actor, 1, 1, 1), (critic, 1, 1, 1))


def ddpg_products() -> Contender:
    """Return those of one batch; the actor's loss goes through the critic, targets through both."""
    actor = [DDPG_OBS, *WIDTHS, DDPG_ACTIONS]
    critic = [DDPG_OBS + DDPG_ACTIONS, *WIDTHS, 1]
    return products(DDPG_BATCH, (actor, 2, 1, 1), (critic, 3, 1, 2))


def updates() -> dict[str, Any]:
    """Measure updates of actor and critic, and relabelled transitions, per second."""
    config = PPOConfig(n_passes=PASSES, steps_per_epoch=PPO_BATCH)
    ppo = fed(PPO, config, *PPO_SIZES)
    replay = DDPGHERConfig(n_rollouts=EPISODES, n_batches=UPDATES, batch_size=DDPG_BATCH)
    ddpg, model = fed(DDPGHER, replay, *DDPG_SIZES), sb3_ddpg()
    drawn = UPDATES * DDPG_BATCH

    def sb3_update() -> int:
        model.train(UPDATES, DDPG_BATCH)
        return UPDATES

    def sb3_samples() -> int:
        for _ in range(UPDATES):
            model.replay_buffer.sample(DDPG_BATCH)
        return drawn

    def our_samples() -> int:
        return len(ddpg.replay.sample(drawn, ddpg.config.replay_p).reward)

    def our_updates(learner: Any) -> int:
        return int(learner.update()["updates"])

    contests: dict[str, dict[str, Contender]] = {
        f"PPO minibatch updates, {PPO_BATCH // PPO_MINIBATCHES} × {PPO_OBS} → {PPO_ACTIONS}": {
            OURS: partial(our_updates, ppo),
            THEIRS: sb3_ppo(),
            BOUND: ppo_products(),
        },
        f"DDPG+HER updates, {DDPG_BATCH} × {DDPG_OBS} → {DDPG_ACTIONS}": {
            OURS: partial(our_updates, ddpg),
            THEIRS: sb3_update,
            BOUND: ddpg_products(),
        },
        "relabelled transitions": {OURS: our_samples, THEIRS: sb3_samples},
    }
    return {
        title: contest(contenders, *((name, THEIRS) for name in contenders if name != THEIRS))
        for title, contenders in contests.items()
    }


def show(contests: dict[str, Any]) -> None:
    """Print a table in units of Stable-Baselines3's rate."""
    rows = []
    for title, result in contests.items():
        rates = [result["per_s"].get(name) for name in (THEIRS, OURS, BOUND)]
        rows.append((title, *(f"{rate / rates[0]:.2f}" if rate else "" for rate in rates)))
    markdown("| updates | Stable-Baselines3 | tactilerl | the products alone |", rows)
