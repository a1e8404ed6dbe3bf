"""A batch of worlds plays what GraspEnv plays."""

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from tactilerl import envs
from tactilerl.envs.batch import BatchEnv, DeviceDraws
from tactilerl.envs.grasp import GraspConfig, GraspEnv

NOISY = dict(object_seen="noisy", joint_noise=0.02, joint_noise_held=0.05, slide_noise=0.001)
FAULTS = dict(taxel_false_on=0.02, taxel_false_off=0.1, taxel_dead=0.1, taxel_stuck=0.05, taxel_delay=2, hand_seed=3)


def config(hand: str, scene: str = "handover_anywhere", **choices: Any) -> GraspConfig:
    """Return a scene's configuration on a hand, in MuJoCo."""
    env: Any = envs.make(hand, scene=scene, simulator="mujoco", **choices)
    return env.unwrapped.config


def play(env: Any, seed: int, actions: Any) -> list[Any]:
    """Return an episode's (obs, reward, terminated, truncated, is_success), the start first."""
    obs, _ = env.reset(seed=seed)
    steps = [(obs, 0.0, False, False, False)]
    while not any(steps[-1][2:4]):
        obs, *rest, info = env.step(actions(seed, len(steps)))
        steps.append((obs, *rest, info["is_success"]))
    return steps


def play_batch(env: BatchEnv, seeds: list[int], actions: Any) -> list[list[Any]]:
    """Return the same of one episode in each world."""
    obs, info = env.reset(seed=seeds)
    episodes = [[(row(obs, i), 0.0, False, False, False)] for i in range(len(seeds))]
    over = np.zeros(len(seeds), bool)
    while not over.all():
        acts = [actions(seed, len(steps)) for seed, steps in zip(seeds, episodes, strict=True)]
        obs, reward, terminated, truncated, info = env.step(np.array(acts))
        ends = terminated | truncated
        for i in np.flatnonzero(~over & ~info["holding"]):
            episodes[i].append((row(obs, i), reward[i], terminated[i], truncated[i], info["is_success"][i]))
        over |= ends
    return episodes


def row(obs: Any, i: int) -> Any:
    return {key: value[i].copy() for key, value in obs.items()}


def act(hand_closes_at: int, size: int) -> Any:
    """Return a rule of actions that closes the hand from some step on, with a little noise."""

    def actions(seed: int, step: int) -> Any:
        noise = 0.1 * np.random.default_rng([seed, step]).standard_normal(size)
        return np.clip(np.where(step < hand_closes_at + seed % 4, -0.2, 0.9) + noise, -1, 1)

    return actions


def assert_alike(hand: str, groups: list[GraspConfig], seeds: list[int], actions: Any, least: float = 0.0) -> list[Any]:
    """Play the same episodes in a batch, two a group, and one by one."""
    batch = BatchEnv(hand, [(group, 2) for group in groups], "loop", AutoresetMode.DISABLED, numpy=True)
    together = play_batch(batch, seeds, actions)
    returns = []
    for group, width, *pairs in zip([g for g in groups for _ in "ab"], [w for w in batch.widths for _ in "ab"], seeds, together, strict=True):
        seed, played = pairs
        env = GraspEnv(hand, group)
        alone = play(env, seed, actions)
        assert len(alone) == len(played), seed
        for (obs, *rest), (seen, *found) in zip(alone, played, strict=True):
            np.testing.assert_allclose(seen["observation"][:width], obs["observation"], atol=1e-5)
            assert not seen["observation"][width:].any()
            for goal in ("achieved_goal", "desired_goal"):
                np.testing.assert_allclose(seen[goal], obs[goal], atol=1e-6)
            np.testing.assert_allclose(found, rest, rtol=1e-6)
        returns.append(alone[-1][1])
        env.close()
    batch.close()
    return returns


@pytest.mark.parametrize("hand", ["mpl", "shadow", "allegro"])
def test_handover_with_noise_in_groups_of_layouts_touch_and_faults(hand: str) -> None:
    first = config(hand, layout="1", **NOISY)
    groups = [
        first,
        replace(first, layout="5", **FAULTS),
        replace(first, layout="5", taxel_threshold=0.05, taxel_release=0.02),
        replace(first, touch="off"),
        replace(first, touch="absent"),
    ]
    returns = assert_alike(hand, groups, list(range(10)), act(15, 1))
    assert {-100.0, 1000.0} & set(returns)
