"""Export a trained policy as an ONNX graph: from sensors by name to an action and joint targets.

The graph keeps nothing between two calls. What it has to know of the last one is an input ``last_X``
for each such output ``X``.
"""

from __future__ import annotations

import io
import json
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ..algos.ddpg_her import GoalInputs
from ..algos.policy import Policy
from ..envs.grasp import GraspEnv
from ..envs.hands import SLIDES, LinearAction
from ..errors import InputError, extra, input_errors
from ..files import replacing
from ..version import __version__
from .policies import read_run
from .recording import sensed

UNITS = {
    "taxel": "N, or 0 and 1",
    "position of": "rad",
    "velocity of": "rad/s",
    "object quaternion": "1",
    "object kind": "number of the kind",
    "object": "m",
    "hand": "m",
}
"""Units of observed entries by how their names begin; those of slides have m for rad."""
_tensor = partial(torch.as_tensor, dtype=torch.float32)


class Controller(nn.Module):
    """Compute an action and joint targets from what a hand's sensors read."""

    inputs: dict[str, Tensor]
    """All inputs by name, in order, as before an episode: sensors read 0, nothing was read before."""

    def __init__(self, policy: Policy, env: GraspEnv) -> None:
        """Take a policy and an environment that it fits."""
        super().__init__()
        self.network, self.scale = policy.network, policy.inputs
        self.names, hand = [*sensed(env)], env.hand
        # What was asked for follows from the last targets and is no sensor.
        self.asked = [name for name in self.names if name.startswith("asked for:")]
        sensors = [name for name in self.names if name not in self.asked]
        self.n_terms = len(self.names) - len(env.observation_entries("taxels"))
        moves, targets = hand.action_map, hand.start_targets()
        n_actions, n_targets = len(hand.action_names), len(targets)
        still = moves(np.zeros(n_actions), targets)
        small = 1e-3 * np.eye(n_actions)  # so small that no limit cuts it
        gain = 1e3 * (moves(small, np.tile(targets, (n_actions, 1))) - still)
        self.is_absolute = isinstance(moves, LinearAction)
        if self.is_absolute:
            ends = still + [[-1.0], [1.0]] * gain.sum(0)
        else:
            targets, ends = still, np.array([moves.open, moves.closed])
            ends[:, : len(moves.slide_step)] = moves.slide_limits.T
        limits = np.sort(ends, axis=0)
        zero = moves.commands(np.zeros(n_targets))  # commands are linear in targets
        slope = moves.commands(np.eye(n_targets)) - zero
        self.still, self.gain, self.limits = map(_tensor, (still, gain, limits))
        self.zero, self.slope = _tensor(zero), _tensor(slope)
        goals: Any = env.observation_space["desired_goal"]
        self.goal = _tensor(goals.low)
        self.inputs = {name: torch.zeros(1) for name in sensors}
        self.inputs["last_targets"] = _tensor(targets)
        if env.task.only_goal is None:
            self.inputs["desired_goal"] = torch.zeros(goals.shape)
        if more := env.config.history - 1:
            self.inputs["last_readings"] = torch.full(
                (more, len(self.names)), torch.nan
            )
        self.about = {
            "version": __version__,
            "control_dt": env.config.control_dt,
            "inputs": {name: _unit(name) for name in sensors},
            "actions": hand.action_names,
            "targets": dict(zip(hand.actuators, limits.T.tolist(), strict=True)),
            "start_targets": targets.tolist(),
        }

    def step(self, given: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return all outputs by name for all inputs."""
        last = given["last_targets"]
        commands = (self.zero + last @ self.slope).split(1)
        known = given | dict(zip(self.asked, commands, strict=False))
        now = torch.cat([known[name] for name in self.names])
        readings = now[None]
        if "last_readings" in given:
            before = given["last_readings"]  # nan: there was none, and all was as now
            readings = torch.cat([readings, before.where(~before.isnan(), now)])
        terms, taxels = readings[:, : self.n_terms], readings[:, self.n_terms :]
        obs = torch.cat([terms.flatten(), taxels.flatten()])
        goal = given.get("desired_goal", self.goal)
        if isinstance(self.scale, GoalInputs):
            scaled = self.scale(obs[None], goal[None])[0]
        else:
            scaled = self.scale.scaling(torch.cat([obs, goal]))
        action = self.network(scaled).clamp(-1.0, 1.0)
        targets = (self.still if self.is_absolute else last) + action @ self.gain
        outputs = {
            "action": action,
            "targets": targets.clamp(self.limits[0], self.limits[1]),
        }
        if "last_readings" in given:
            outputs["readings"] = readings[:-1]
        return outputs

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return all outputs for all inputs, in their order."""
        return tuple(self.step(dict(zip(self.inputs, inputs, strict=True))).values())


def _unit(name: str) -> str:
    """Return the unit of an entry of the observation, "" where it is not known."""
    unit = next((unit for begin, unit in UNITS.items() if name.startswith(begin)), "")
    return unit.replace("rad", "m") if name.endswith(SLIDES) else unit


def export(run: Path, out: Path) -> dict[str, Any]:
    """Write the policy of a run folder as an ONNX graph; return what its metadata say.

    InputError where there is no policy of a hand, or `onnx` is missing.
    """
    with extra("export"):
        import onnx
    trained = read_run(run)
    if trained.config.scene is None:
        env = trained.config.run.env
        raise InputError(f"{run}: found a run on {env!r}, allowed runs of hands")
    with input_errors(), closing(trained.config.make_env()) as env:
        controller = Controller(trained.policy, env)
    inputs, file = controller.inputs, io.BytesIO()
    torch.onnx.export(
        controller,
        (*inputs.values(),),
        file,
        input_names=[*inputs],
        output_names=[*controller.step(inputs)],
        dynamo=False,  # the other way needs more packages
    )
    model = onnx.load_from_string(file.getvalue())
    texts = {name: json.dumps(value) for name, value in controller.about.items()}
    onnx.helper.set_model_props(model, texts)
    with replacing(out) as to:
        to.write(model.SerializeToString())
    return controller.about
