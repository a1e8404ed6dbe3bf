"""The learners as before 0.4.0, with gradients as one would derive them: the same runs bit for bit.

`python -m benchmarks reproduce --by-hand` trains with them: `python -m benchmarks.learners.by_hand
train ...` is `tactilerl train`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import torch
from tactilerl.algos import ddpg_her, ppo
from tactilerl.algos.ddpg_her import DDPGHER
from tactilerl.algos.networks import MLP, FlatAdam
from tactilerl.algos.ppo import MAX_LOG_RATIO, PPO, Transitions, surrogate
from tactilerl.commands import cli
from tactilerl.envs import observations
from torch import Tensor
from torch.nn import functional


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
    def _update_actor(self, minibatch: Transitions) -> Tensor:
        n, own, gaussian = len(minibatch.obs), minibatch.own_rows(self.comm), self.gaussian
        values = run(self.actor, own.obs[:, : self._n_obs])
        log_ratio = gaussian.log_prob(own.actions, values[-1]) - own.log_prob
        loss, kl, is_clipped = surrogate(log_ratio, own.advantages, self.config.clip_range)
        cut = log_ratio.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO)
        gain = cut.exp() * own.advantages
        slope = -gain * ((-gain >= loss) & (cut == log_ratio))  # the loss is above where the clip binds
        residual = (own.actions - values[-1]) / gaussian.log_std.exp()
        if gaussian.log_std.grad is not None:
            by_log_std = (slope / n)[:, None] * (residual.square() / gaussian.variance - 1.0)
            gaussian.log_std.grad.copy_(by_log_std.sum(dim=0))
        by_mean = (slope / (n * gaussian.variance))[:, None] * residual / gaussian.log_std.exp()
        backward(self.actor, values, by_mean)
        self._step_along(self.actor_adam)
        return torch.stack([loss, kl, is_clipped]).sum(dim=1) / n

    @torch.no_grad()
    def _update_critic(self, minibatch: Transitions) -> Tensor:
        n, own = len(minibatch.obs), minibatch.own_rows(self.comm)
        values = run(self.critic, own.obs)
        error = values[-1] - own.returns[:, None]
        backward(self.critic, values, error * (2 / n))
        self._step_along(self.critic_adam)
        return error.square().sum(dim=0) / n

    def _step_along(self, adam: FlatAdam) -> None:
        adam.reduce(self.comm)
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


if __name__ == "__main__":
    ppo.PPO, ddpg_her.DDPGHER = PPOByHand, DDPGHERByHand  # type: ignore[misc]
    observations._upper = lambda quaternion: quaternion  # which had either sign
    sys.exit(cli.main())
