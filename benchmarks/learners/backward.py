"""Do gradients by hand pay, or Adam's kernel by itself? Whole runs with them and with PyTorch's own.

    python -m benchmarks backward --out docs/data/backward.json

The run of `make train` (PPO, the handover) and DDPG+HER on the Shadow Hand (reach-goal, layout 2,
recipe `steady`). All learn on the same flat parameters from the same seed and take turns, an epoch or
ten cycles each, so that whatever else the machine does meets all alike. What counts is the processor's
time, simulation included. Fixed before the first run: gradients by hand stay in the library if they
save more than 10 % of both runs, and the private call of the kernel if it saves more than 5 %.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

import tactilerl
from benchmarks.command import Part, run_parts
from benchmarks.printing import markdown
from tactilerl import envs
from tactilerl.algos import recipes
from tactilerl.algos.ddpg_her import DDPGHER
from tactilerl.algos.mpi import Communicator
from tactilerl.algos.networks import MLP, FlatAdam
from tactilerl.algos.ppo import MAX_LOG_RATIO, PPO, Transitions, surrogate
from tactilerl.envs import vector

ROUNDS = 6
PYTORCH, BY_HAND, KERNEL = "PyTorch's own", "gradients by hand", "Adam's kernel"


@torch.no_grad()
def run(network: MLP, inputs: Tensor) -> list[Tensor]:
    """What each linear layer is given (n, size), the inputs first, and the outputs (n, sizes[-1])."""
    (*_, last), (_, tanh), values = network.linears, network._shape, [inputs]
    for linear in network.linears:
        values.append(functional.linear(values[-1], linear.weight, linear.bias))
        if linear is not last:
            values[-1].relu_()
        elif tanh:
            values[-1].tanh_()
    return values


@torch.no_grad()
def deltas(network: MLP, values: Sequence[Tensor], gradient: Tensor) -> list[Tensor]:
    """Gradients (n, size) of a loss by what each linear layer gives, before its ReLU or Tanh; of what
    `run` returned, and the loss's by the outputs."""
    _, tanh = network._shape
    found = [gradient * (1.0 - values[-1].square()) if tanh else gradient]
    for linear, hidden in zip(network.linears[:0:-1], values[-2:0:-1], strict=True):
        delta = found[-1] @ linear.weight
        torch.ops.aten.threshold_backward(delta, hidden, 0.0, grad_input=delta)  # ReLU's, in place
        found.append(delta)
    return found[::-1]


@torch.no_grad()
def backward(network: MLP, values: Sequence[Tensor], gradient: Tensor) -> None:
    """Write a loss's gradient by the parameters into their `grad`; arguments as of `deltas`."""
    parts = zip(network.linears, values[:-1], deltas(network, values, gradient), strict=True)
    for linear, inputs, delta in parts:
        torch.mm(delta.t(), inputs, out=linear.weight.grad)
        torch.sum(delta, dim=0, out=linear.bias.grad)


class PPOByHand(PPO):
    """Gradients of both losses as one would derive them."""

    @torch.no_grad()
    def _improve_actor(self, minibatch: Transitions) -> Tensor:
        n, gaussian = len(minibatch.obs), self.gaussian
        values = run(self.actor, minibatch.obs[:, : self._n_obs])
        log_ratio = gaussian.log_prob(minibatch.actions, values[-1]) - minibatch.log_prob
        loss, kl, is_clipped = surrogate(log_ratio, minibatch.advantages, self.config.clip_range)
        cut = log_ratio.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO)
        gain = cut.exp() * minibatch.advantages
        slope = -gain * ((-gain >= loss) & (cut == log_ratio))  # the loss is above where the clip binds
        residual = (minibatch.actions - values[-1]) / gaussian.log_std.exp()
        if gaussian.log_std.grad is not None:
            by_log_std = (slope / n)[:, None] * (residual.square() / gaussian.variance - 1.0)
            gaussian.log_std.grad.copy_(by_log_std.sum(dim=0))
        by_mean = (slope / (n * gaussian.variance))[:, None] * residual / gaussian.log_std.exp()
        backward(self.actor, values, by_mean)
        self._step_along(self.actor_adam)
        return torch.stack([loss, kl, is_clipped]).sum(dim=1) / n

    @torch.no_grad()
    def _improve_critic(self, minibatch: Transitions) -> Tensor:
        values = run(self.critic, minibatch.obs)
        error = values[-1] - minibatch.returns[:, None]
        backward(self.critic, values, error * (2 / len(error)))
        self._step_along(self.critic_adam)
        return error.square().mean(dim=0)

    def _step_along(self, adam: FlatAdam) -> None:
        adam.clip(self.config.max_grad_norm)
        adam.step()


class DDPGHERByHand(DDPGHER):
    """Likewise."""

    @torch.no_grad()
    def _critic_gradient(self, inputs: Tensor, actions: Tensor, target: Tensor) -> Tensor:
        values = run(self.critic, torch.cat([inputs, actions], dim=1))
        error = values[-1] - target[:, None]
        backward(self.critic, values, error * (2 / len(error)))
        return error.square().mean(dim=0)

    @torch.no_grad()
    def _actor_gradient(self, inputs: Tensor) -> Tensor:
        values = run(self.actor, inputs[:, : self._n_obs])
        own, (n, n_inputs) = values[-1], inputs.shape
        of_critic = run(self.critic, torch.cat([inputs, own], dim=1))
        first, *_ = deltas(self.critic, of_critic, torch.full_like(of_critic[-1], -1 / n))
        by_own = first @ self.critic.linears[0].weight[:, n_inputs:]
        backward(self.actor, values, by_own + 2 * self._penalty / own.numel() * own)
        value = of_critic[-1].mean()
        return torch.stack([self._penalty * own.square().mean() - value, value])


def kernel_step(adam: FlatAdam) -> None:
    """A step by the kernel of torch.optim.Adam(fused=True), without the optimiser around it."""
    for group in adam._adam.param_groups:
        (parameter,) = group["params"]
        state = adam._adam.state[parameter]
        state["step"] += 1
        torch._fused_adam_(
            [parameter], [parameter.grad], [state["exp_avg"]], [state["exp_avg_sq"]], [],
            [state["step"]], lr=group["lr"], beta1=0.9, beta2=0.999, weight_decay=0.0, eps=1e-8,
            amsgrad=False, maximize=False,
        )  # fmt: skip


def take_turn(learner: Any, cycles: int) -> float:
    """Processor seconds of some cycles."""
    started = time.process_time()
    for _ in range(cycles):
        learner.collect()
        learner.update()
    return time.process_time() - started


def measure(kinds: tuple[Any, Any], config: Any, make: vector.Make, cycles: int) -> dict[str, Any]:
    """Seconds of each contender's turns, after one to warm up."""
    own, by_hand = kinds
    with ExitStack() as opened:
        learners = {
            name: kind(
                config, opened.enter_context(closing(vector.start(make))), Communicator(), 0, 10**5
            )
            for name, kind in ((PYTORCH, own), (BY_HAND, by_hand), (KERNEL, own))
        }
        for name in ("adam", "actor_adam", "critic_adam"):
            if adam := getattr(learners[KERNEL], name, None):
                adam.step = torch.no_grad()(partial(kernel_step, adam))
        turns = [
            {name: take_turn(learner, cycles) for name, learner in learners.items()}
            for _ in range(ROUNDS + 1)
        ][1:]
    return {
        "steps": {name: learner.env_steps for name, learner in learners.items()},
        "seconds": {name: [turn[name] for turn in turns] for name in learners},
    }


def display(name: str, result: dict[str, Any]) -> None:
    """A row for each contender: seconds, and what they save of PyTorch's, in all and turn by turn."""
    rows, own = [], np.array(result["seconds"][PYTORCH])
    for contender, seconds in result["seconds"].items():
        taken = np.array(seconds)
        saved, turns = 1 - taken.sum() / own.sum(), np.sort(1 - taken / own)
        rows.append(
            (contender, f"{taken.sum():.1f}", f"{saved:.1%}", f"{turns[0]:.1%} to {turns[-1]:.1%}")
        )
    markdown(f"| {name} | processor s | saved | in single turns |", rows)


def main() -> None:
    """Both learners."""
    ppo, ddpg = (PPO, PPOByHand), (DDPGHER, DDPGHERByHand)
    reach = partial(envs.make, "shadow", task="reach-goal", layout="2")
    parts: dict[str, Part] = {
        "ppo": (
            partial(
                measure,
                ppo,
                recipes.recipe("ppo", "steady"),
                partial(tactilerl.make, scene="handover"),
                1,
            ),
            partial(display, "PPO, `make train`"),
        ),
        "ddpg_her": (
            partial(measure, ddpg, recipes.recipe("ddpg_her", "steady"), reach, 10),
            partial(display, "DDPG+HER, Shadow Hand"),
        ),
    }
    run_parts(__doc__, parts, "torch")
