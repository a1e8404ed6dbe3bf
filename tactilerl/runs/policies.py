"""Trained policies from disk: a run folder's, or one in a file of its own.

No environment is made for them, and no learner.
"""

from __future__ import annotations

import dataclasses
import json
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from .. import algos
from ..algos import recipes
from ..algos.learner import progress_remaining
from ..algos.policy import Policy, Spaces, network_sizes
from ..envs import validation
from ..files import damage_named
from . import sealed

if TYPE_CHECKING:
    from ..algos.learner import Learner
    from .config import RunConfig

FORMAT = 1  # of a policy's file
FLOAT = 4  # bytes
TYPES = {
    "policy_format": int,
    "algo": str,
    "learner": str,
    "spaces": str,
    "state": dict,
}


class Trained(NamedTuple):
    """What a run has come to."""

    config: RunConfig
    """As it was trained, but on the CPU and with the full hold test."""
    policy: Policy
    epoch: int
    env_steps: int


def load_policy(path: str | Path) -> Policy:
    """The policy of a run folder at its last checkpoint, or of a file that `PPO.save` or
    `DDPGHER.save` wrote.

    `policy.act(obs)` is the action for an observation, or for a batch of observations. Files of
    others are safe to load: only tensors and plain values are read. Raises ValueError, one line,
    when there is no policy or its file is damaged.
    """
    path = Path(path)
    if path.is_dir():
        return read_run(path).policy
    data = _fields(path)
    with damage_named(path):
        config_type, _ = algos.get(data["algo"])
        told = recipes.completed(data["algo"], json.loads(data["learner"]))
        config: Any = validation.make(config_type, told, "learner")
        config.validate()
        return _policy(
            path, data["algo"], config, Spaces.from_json(data["spaces"]), data["state"]
        )


def save_policy(path: str | Path, algo: str, learner: Learner) -> None:
    """Write the policy of a learner, whole or not at all; replaces another policy that is there.

    Raises ValueError when `path` is no place for a file, or holds another one; OSError when the disk is
    full.
    """
    path = Path(path)
    if path.is_dir() or not path.parent.is_dir():
        raise ValueError(
            f"path: found {str(path)!r}, allowed a file in a folder that exists"
        )
    state = learner.state_dict()
    content = {
        "policy_format": FORMAT,
        "algo": algo,
        "learner": json.dumps(
            dataclasses.asdict(learner.config.acting(learner.progress_remaining))
        ),
        "spaces": learner.spaces.to_json(),
        "state": {name: state[name] for name in learner.policy_parts},
    }
    sealed.write(path, content, _fields)


def _fields(path: Path) -> dict[str, Any]:
    return sealed.read_fields(
        path, "policy", FORMAT, TYPES, "; for a run, give its folder"
    )


def _policy(
    path: Path, algo: str, config: Any, spaces: Spaces, state: dict[str, Any]
) -> Policy:
    """The policy in a learner's state; ValueError before a network is made that no such file holds."""
    sizes = network_sizes(config.hidden, spaces)
    if FLOAT * sum(a * b for a, b in pairwise(sizes)) > path.stat().st_size:
        raise ValueError(f"hidden: found {config.hidden}, more than the file holds")
    policy: Policy = algos.get(algo)[1].saved_policy(config, spaces, state)
    return policy


def read_run(path: Path) -> Trained:
    """The policy of a run folder at its last checkpoint, and its configuration.

    InputError as of `load_policy`.
    """
    from . import checkpoint  # a policy's file needs no environments' configuration
    from .run_dir import RunDir

    run_dir = RunDir(path)
    saved = run_dir.read_config()
    data, file = checkpoint.read(run_dir, saved), run_dir.checkpoint_file
    with damage_named(file):
        spaces, state = Spaces.from_json(data["spaces"]), data["ranks"][0]
        remaining = progress_remaining(state["env_steps"], saved.run.total_timesteps)
        policy = _policy(
            file, saved.run.algo, saved.learner.acting(remaining), spaces, state
        )
    run = dataclasses.replace(saved.run, workers=1, device="cpu")
    scene = saved.scene and dataclasses.replace(saved.scene, hold_verdict="full")
    config = dataclasses.replace(saved, run=run, scene=scene)
    return Trained(config, policy, data["epoch"], state["env_steps"])
