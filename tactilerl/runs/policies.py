"""Trained policies from disk: a run folder's, or one in a file of its own.

No environment is made for them, and no learner.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from .. import algos
from ..algos.learner import progress_remaining
from ..algos.policy import Policy
from ..envs import validation
from ..files import damage_named, require_path
from .config import RunConfig
from .store import (
    RunDir,
    read_tensors,
    spaces_from_json,
    spaces_to_json,
    write_tensors,
)

if TYPE_CHECKING:
    from ..algos.learner import Learner

FORMAT = 1  # of a policy's file


class Trained(NamedTuple):
    """Hold what is read of a trained run."""

    config: RunConfig
    """Its configuration, but on the CPU and with the full hold test."""
    policy: Policy
    epoch: int
    env_steps: int
    explores: bool
    """False if its exploration noise has been annealed to zero."""


def load_policy(path: str | Path) -> Policy:
    """Return the policy of a run folder at its last checkpoint, or of a file that `save` wrote.

    Such files come from `PPO.save` and `DDPGHER.save`. `policy.act(obs)` is the action
    for an observation, or for a batch of observations. Files of others are safe to
    load: only tensors and plain values are read. Raises ValueError, one line, when
    there is no policy or its file is damaged.
    """
    path = require_path(path, "path")
    if path.is_dir():
        return read_run(path).policy
    data = _read(path)
    with damage_named(path):
        config_type, learner_type = algos.get(data["algo"])
        config = validation.fill(config_type, json.loads(data["learner"]), "learner")
        spaces = spaces_from_json(data["spaces"])
        policy: Policy = learner_type.saved_policy(config, spaces, data["state"])
        return policy


def _read(path: Path) -> dict[str, Any]:
    return read_tensors(path, "policy", "policy_format", FORMAT)


def save_policy(path: str | Path, algo: str, learner: Learner) -> None:
    """Write the policy of a learner, whole or not at all; replaces another policy that is there.

    Raises ValueError when `path` is no place for a file, or holds another one, and
    OSError when the disk is full.
    """
    path = require_path(path, "path")
    if path.is_file():
        _read(path)  # ValueError where it is no policy
    state = learner.state_dict()
    acting = learner.config.acting(learner.progress_remaining)
    content = {
        "policy_format": FORMAT,
        "algo": algo,
        "learner": json.dumps(dataclasses.asdict(acting)),
        "spaces": spaces_to_json(learner.spaces),
        "state": {name: state[name] for name in learner.policy_parts},
    }
    write_tensors(path, content)


def read_run(path: Path) -> Trained:
    """Return the policy of a run folder at its last checkpoint, and its configuration.

    InputError as of `load_policy`.
    """
    run_dir = RunDir(path)
    saved = run_dir.read_config()
    data = run_dir.read_checkpoint()
    with damage_named(run_dir.checkpoint_file):
        spaces, state = spaces_from_json(data["spaces"]), data["ranks"][0]
        remaining = progress_remaining(state["env_steps"], saved.run.total_timesteps)
        acting = saved.learner.acting(remaining)
        learner_type = algos.get(saved.run.algo)[1]
        policy = learner_type.saved_policy(acting, spaces, state)
    run = dataclasses.replace(saved.run, workers=1, device="cpu")
    scene = saved.scene and dataclasses.replace(saved.scene, hold_verdict="full")
    config = dataclasses.replace(saved, run=run, scene=scene)
    progress = data["epoch"], state["env_steps"]
    return Trained(config, policy, *progress, acting.explores)
