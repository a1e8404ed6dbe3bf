"""`tactilerl export`: a trained policy as an ONNX graph that a real hand's control loop runs.

It goes from sensors by name to an action and joint targets.

The graph keeps nothing between two calls. What it has to know of the last one is an
input ``last_X`` for each such output ``X``.
"""

from __future__ import annotations

import io
import json
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from torch import Tensor, nn

from ..algos.policy import Policy
from ..envs.grasp import GraspEnv
from ..envs.hands import LinearAction
from ..errors import extra, input_errors
from ..files import replacing, require_new
from ..runs.evaluation import sensed
from ..runs.policies import read_run
from ..terminal import flags
from ..terminal.console import console

ABOUT = """\
Write the policy of a run as an ONNX graph (extra: export). Its inputs are sensors by name,
its outputs the action and the hand's joint targets. See docs/guides/real_hand.md.

examples:
  tactilerl export runs/X
  tactilerl export runs/X --out policy.onnx"""
UNITS = {
    "taxel": "N, or 0 and 1",
    "position of": "rad, of a slide m",
    "velocity of": "rad/s, of a slide m/s",
    "object quaternion": "w, x, y, z",
    "object kind": "number of the kind",
    "object": "m",
    "hand": "m",
}
"""Units of what is sensed, by how its name begins."""
OUTPUTS = "action", "targets", "readings"


@dataclass(frozen=True)
class ExportFlags:
    """Flags of `tactilerl export`."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    out: Path = Path("policy.onnx")
    """File of the graph."""
    overwrite: bool = False
    """Replace a file that is there."""


class Controller(nn.Module):
    """Compute an action and joint targets from what a hand's sensors read."""

    inputs: dict[str, Tensor]
    """All inputs by name, in order, as before an episode: sensors read 0, nothing was
    read before."""

    def __init__(self, policy: Policy, env: GraspEnv) -> None:
        """Take a policy and an environment that it fits."""
        super().__init__()
        self.network = policy.network
        self.scale = policy.inputs.scaling
        self.names, hand = [*sensed(env)], env.hand
        # What was asked for follows from the last targets and is no sensor.
        self.asked = [name for name in self.names if name.startswith("asked for:")]
        sensors = [name for name in self.names if name not in self.asked]
        self.n_terms = len(self.names) - len(env.observation_entries("taxels"))
        moves, targets = hand.action_map, hand.start_targets()
        n = len(hand.action_names)
        still = moves(np.zeros(n), targets)
        small = 1e-3 * np.eye(n)  # so small that no limit cuts it
        gain = 1e3 * (moves(small, np.tile(targets, (n, 1))) - still)
        self.is_absolute = isinstance(moves, LinearAction)
        farthest = np.full(n, 1.0 if self.is_absolute else 1e9)
        ends = moves(-farthest, targets), moves(farthest, targets)
        limits = np.sort(ends, axis=0)
        if not self.is_absolute:
            targets = still
        zero = moves.commands(0 * targets)  # commands are linear in targets
        slope = moves.commands(np.eye(len(targets))) - zero
        self.arrays = [*map(torch.Tensor, (still, gain, *limits, zero, slope))]
        space: Any = env.observation_space
        goal = np.nan_to_num(space["desired_goal"].low, neginf=0.0)
        start = {"last_targets": targets.tolist(), "desired_goal": goal.tolist()}
        self.inputs = dict.fromkeys(sensors, torch.zeros(1))
        self.inputs |= {name: torch.Tensor(values) for name, values in start.items()}
        nothing = torch.full((env.config.history, len(self.names)), torch.nan)
        self.inputs["last_readings"] = nothing
        self.about = {
            "control_dt": env.config.control_dt,
            "inputs": sensors,
            "units": UNITS,
            "start": start,
            "actions": hand.action_names,
            "targets": dict(zip(hand.actuators, limits.T.tolist(), strict=True)),
        }

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Return the outputs for all inputs in their order."""
        given = dict(zip(self.inputs, inputs, strict=True))
        still, gain, low, high, zero, slope = self.arrays
        last, before = given["last_targets"], given["last_readings"][:-1]
        asked = torch.split(zero + last @ slope, 1)
        given |= zip(self.asked, asked, strict=False)
        now = torch.cat([given[name] for name in self.names])
        # Nothing was read before an episode, in which all was as at its start.
        before = before.where(~before.isnan(), now)
        readings = torch.cat([now[None], before])
        terms, taxels = readings[:, : self.n_terms], readings[:, self.n_terms :]
        obs = torch.cat([terms.flatten(), taxels.flatten()])
        scaled = self.scale(torch.cat([obs, given["desired_goal"]]))
        action = self.network(scaled).clamp(-1.0, 1.0)
        targets = (still if self.is_absolute else last) + action @ gain
        targets = targets.clamp(low, high)
        return action, targets, readings


def main(args: list[str]) -> int:
    """Run `tactilerl export RUN`; the run has to be one of a hand."""
    read = flags.parse(ExportFlags, args, "tactilerl export", ABOUT)
    require_new(read.out, read.overwrite, ".onnx")
    with extra("export"):
        import onnx
    trained = read_run(read.run)
    with input_errors(), closing(trained.config.make_env()) as env:
        controller = Controller(trained.policy, env)
    file: Any = io.BytesIO()
    torch.onnx.export(
        controller,
        (*controller.inputs.values(),),
        file,
        input_names=[*controller.inputs],
        output_names=OUTPUTS,
        dynamo=False,  # the other way needs more packages
    )
    model = onnx.load_from_string(file.getvalue())
    texts = {name: json.dumps(value) for name, value in controller.about.items()}
    onnx.helper.set_model_props(model, texts)
    with replacing(read.out) as to:
        to.write(model.SerializeToString())
    console.print(f"{read.out}: docs/guides/real_hand.md says what to feed it")
    return 0
