"""Hyperparameters that go together, by name: the paper's, and others for a purpose."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from . import get
from .ddpg_her import DDPGHERConfig
from .ppo import PPOConfig

PAPER = "paper"  # every learner's own defaults
# Hyperparameters that files of earlier versions lack.
SINCE: dict[str, dict[str, Any]] = {
    "ddpg_her": {
        **dict.fromkeys(
            ("anneal_lr", "anneal_noise", "anneal_action_l2", "normalise_rewards"),
            False,
        ),
        "target_update_interval": None,
    },
}
# Those that earlier versions have, with the values that mean what this one does.
GONE: dict[str, dict[str, Any]] = {"ppo": {"final_variance": None}}
# For runs that learn faster, or keep what they learned: docs/concepts/learners.md.
# A name keeps its values for good: study files and recorded runs mean them by it.
STEADY = DDPGHERConfig(
    n_batches=16,
    polyak=0.9,
    target_update_interval=16,  # up to 0.3.0 once per cycle, which is the same with 16 updates
    anneal_lr=True,
    anneal_noise=True,
    anneal_action_l2=True,
)
BEYOND: dict[str, dict[str, Any]] = {
    "ddpg_her": {
        "steady": STEADY,
        "scaled": replace(
            STEADY, normalise_rewards=True, termination="terminal", action_l2=0.1
        ),
    },
    "ppo": {
        "steady": PPOConfig(
            exploration="learned",
            orthogonal_init=True,
            normalise_obs=True,
            n_passes=10,
            minibatch_size=64,
            critic_lr=3e-4,
            target_kl=0.05,
        ),
    },
}


def recipes(algorithm: str) -> dict[str, Any]:
    """The learner's recipes by name, the paper's first; ValueError for an unknown learner."""
    config_type, _ = get(algorithm)
    return {PAPER: config_type(), **BEYOND.get(algorithm, {})}


def recipe(algorithm: str, name: str = PAPER) -> Any:
    """The learner's hyperparameters; ValueError when it has no such recipe."""
    known = recipes(algorithm)
    if name not in known:
        raise ValueError(
            f"recipe: found {name!r}, allowed for {algorithm}: {', '.join(known)}"
        )
    return known[name]


def current(algorithm: str, told: dict[str, Any]) -> dict[str, Any]:
    """Hyperparameters that an earlier version may have written, as this one has them."""
    gone = GONE.get(algorithm, {}).items()
    return SINCE.get(algorithm, {}) | {
        name: v for name, v in told.items() if (name, v) not in gone
    }


def comparable(algorithm: str, told: dict[str, Any]) -> dict[str, Any]:
    """The same, where what means the same is the same: an interval of a whole cycle is none."""
    values = current(algorithm, told)
    if (
        "n_batches" in values
        and (values.get("target_update_interval") or 0) >= values["n_batches"]
    ):
        values["target_update_interval"] = None
    return values
