"""States of learners, to be compared; and states of a scene, to be looked at."""

import dataclasses

import numpy as np
import torch
from tactilerl.envs.state import Contacts, State

TIMES = ("collect_s", "update_s", "steps_per_s")  # columns of progress.csv that no seed decides
NO_CONTACTS = Contacts(np.zeros((0, 3)), np.zeros(0, int), np.zeros(0), np.zeros((0, 3)))


def scene(**values):
    """A state with these fields; all others are empty."""
    empty = {field.name: np.zeros(0) for field in dataclasses.fields(State)}
    return State(**{**empty, "contacts": NO_CONTACTS, **values})


def closing(env, seed, n):
    """(observations, rewards, the last info) of at most n steps of closing the hand, by a seed."""
    obs, info = env.reset(seed=seed)
    rng, seen, rewards, size = np.random.default_rng(seed), [obs], [], env.action_space.shape[0]
    for _ in range(n):
        fingers = rng.uniform(-0.5, 1, size - 3)
        obs, reward, terminated, truncated, info = env.step(np.concatenate([[0, 0, -0.1], fingers]))
        seen.append(obs)
        rewards.append(reward)
        if terminated or truncated:
            break
    return seen, rewards, info


def flat(state):
    """A state as one comparable string: every bit of every tensor."""
    if isinstance(state, dict):
        return str({key: flat(value) for key, value in state.items()})
    if isinstance(state, torch.Tensor | np.ndarray):
        return np.asarray(state).tobytes().hex()
    return str([flat(x) for x in state]) if isinstance(state, list | tuple) else repr(state)


def vector(*networks):
    """All parameters of networks in one vector."""
    return torch.cat([p.detach().reshape(-1) for network in networks for p in network.parameters()])
