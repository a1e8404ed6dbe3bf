"""Hyperparameters that go together, by name: the paper's, and others for a purpose."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from . import get
from .ddpg_her import DDPGHERConfig
from .ppo import PPOConfig

PAPER = "paper"  # every learner's own defaults
# For runs that learn faster, or keep what they learned: docs/concepts/learners.md.
# A name keeps its values for good: study files and recorded runs mean them by it.
STEADY_PPO = PPOConfig(
    exploration="learned",
    orthogonal_init=True,
    normalize_obs=True,
    n_passes=10,
    minibatch_size=64,
    critic_lr=3e-4,
    target_kl=0.05,
)
STEADY_DDPG = DDPGHERConfig(
    n_batches=16,
    polyak=0.9,
    target_update_interval=16,
    anneal_lr=True,
    anneal_noise=True,
    anneal_action_l2=True,
)
SCALED = replace(
    STEADY_DDPG, normalize_rewards=True, termination="terminal", action_l2=0.1
)
ROBUST_PPO = replace(
    STEADY_PPO,
    steps_per_epoch=500,
    action_variance=0.2,
    std_lr=1e-3,
    normalize_rewards=True,
    taxel_scale="block",
    undo_silent=True,
    anneal_lr=True,
)
BEYOND: dict[str, dict[str, Any]] = {
    "ppo": {
        "steady": STEADY_PPO,
        "robust": ROBUST_PPO,
        "persistent": replace(
            ROBUST_PPO,
            noise_correlation=0.7,
            min_std=1.0,
            taxel_scale="each",
            steps_per_epoch=1000,
            minibatch_size=250,
        ),
    },
    "ddpg_her": {
        "steady": STEADY_DDPG,
        "scaled": SCALED,
        "robust": replace(
            SCALED, n_batches=40, target_update_interval=20, random_hold=8.0
        ),
    },
}


def recipes(algorithm: str) -> dict[str, Any]:
    """Return the learner's recipes by name, the paper's first; ValueError if it is unknown."""
    config_type, _ = get(algorithm)
    return {PAPER: config_type(), **BEYOND.get(algorithm, {})}


def recipe(algorithm: str, name: str = PAPER) -> Any:
    """Return the learner's hyperparameters; ValueError when it has no such recipe."""
    known = recipes(algorithm)
    if name not in [*known]:  # a list has no hash
        raise ValueError(
            f"recipe: found {name!r}, allowed for {algorithm}: {', '.join(known)}"
        )
    return known[name]
