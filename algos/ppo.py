"""Proximal policy optimisation (Schulman et al. 2017), as the paper uses it.

Read from top to bottom: the choices, what it computes, the learner. The source of what the paper
leaves open is PPO-for-Beginners (yu2023ppo in the paper): whole episodes, GAE with returns =
advantage + value, advantages normalised over the batch, separate Adams.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from . import Array, Count, Fraction, Positive32, rollout
from .learner import Learner, restore
from .mpi import Communicator
from .networks import MLP, FlatAdam, require_hidden, start_orthogonal
from .normalizer import Normalizer
from .policy import FlatInputs, Policy, flat_stats, new_actor, on_cpu
from .rollout import (
    Episode,
    PlayEpisode,
    discounted,
    finite,
    play_steps,
    require_transitions,
    summary,
)
from .spaces import PRIVILEGED, Spaces, action_size, flat_size

ACTOR_GAIN = 0.01  # of the last layer when weights start orthogonal
OBS_CLIP = 5.0  # normalised observations are cut there, as DDPG+HER's are
MAX_LOG_RATIO = 20.0  # exp(20) = 5e8: far outside any clip range, far inside float32


@dataclass(frozen=True)
class PPOConfig:
    """Hyperparameters; defaults are the paper's (Methods, PyBullet set-up) unless noted."""

    hidden: tuple[int, ...] = (256, 256, 256)
    """Units of each hidden layer, actor and critic alike."""
    actor_lr: Positive32 = 3e-4
    """Learning rate of the actor (Adam)."""
    critic_lr: Positive32 = 1e-3
    """Learning rate of the critic (Adam)."""
    action_variance: Positive32 = 0.05
    """Variance of the Gaussian policy in every action dimension, in units where the bounds are ±1."""
    gamma: Fraction = 0.99
    """Discount factor."""
    gae_lambda: Fraction = 0.97
    """Lambda of generalised advantage estimation."""
    clip_range: Positive32 = 0.2
    """Clip range of the probability ratio."""
    steps_per_epoch: Count = 1000
    """Minimum number of environment steps per epoch, over all processes; episodes are played to
    their end. (Stable-Baselines3: n_steps.)"""
    n_passes: Count = 80
    """Passes over the batch per epoch (paper: updates per epoch; Stable-Baselines3: n_epochs)."""
    n_minibatches: Count | None = None
    """Minibatches per pass; default: 6, unless --minibatch-size is given. The paper says
    "minibatch size: 6"; its source uses 6 as their number."""
    minibatch_size: Count | None = None
    """Minimum number of transitions per minibatch, instead of --n-minibatches; all have about as
    many. (Stable-Baselines3: batch_size.)"""
    max_grad_norm: Positive32 = 0.5
    """Largest norm of the gradient, clipped separately for actor and critic."""
    exploration: Literal["fixed", "learned"] = "fixed"
    """Variance of the policy. fixed: --action-variance; learned: one per action dimension, starting
    there."""
    orthogonal_init: bool = False
    """Orthogonal initial weights, with an actor whose last layer is near zero; otherwise they are
    uniform in ±1/sqrt(inputs)."""
    normalise_obs: bool = False
    """Normalise observations with the mean and standard deviation of all earlier epochs, clipped to ±5.
    Entries between 0 and 1, such as Boolean taxels, stay as they are."""
    truncation: Literal["bootstrap", "terminal"] = "bootstrap"
    """How a time limit is treated. bootstrap: the return continues with the critic's value of the last
    observation; terminal: the return ends. In the paper's task a time-out is a failure, with -100."""
    anneal_lr: bool = False
    """Decay both learning rates linearly to zero over the run (in the source, not in the paper)."""
    target_kl: Positive32 | None = None
    """Stop an epoch's passes when the KL divergence from the old policy exceeds this (in the source,
    not in the paper)."""

    def acting(self, remaining: float) -> PPOConfig:
        """As `DDPGHERConfig.acting`: noise does not depend on what is left of the run."""
        return self

    def validate(self) -> None:
        """Raise ValueError naming what does not go together; ranges are in the types."""
        require_hidden(self.hidden)
        if self.n_minibatches is not None and self.minibatch_size is not None:
            raise ValueError(
                "n_minibatches and minibatch_size: found both, allowed one of them; "
                "None unsets that of a recipe"
            )

    @property
    def anneals(self) -> bool:
        """Does the course of a run depend on how long it will be?"""
        return self.anneal_lr

    def minibatches(self, n: int) -> int:
        """Minibatches per pass over a batch of `n` transitions."""
        if self.minibatch_size is not None:
            return max(1, n // self.minibatch_size)
        return min(self.n_minibatches or 6, n)


def gae(
    rewards: Array, values: Array, last_value: float, gamma: float, lam: float
) -> Array:
    """Generalised advantages (n,) of one episode, float64 (Schulman et al. 2016, eq. 16).

    `values` (n,) are the critic's at each step, `last_value` the one after the last step:
    0 where nothing follows.
    """
    next_values = np.append(values[1:], last_value)
    deltas = (rewards + gamma * next_values - values).tolist()
    return np.array(discounted(deltas, gamma * lam))


def normalise(advantages: Array) -> Array:
    """Advantages (n,) with mean 0 and standard deviation 1; zeros where all are alike."""
    centred = advantages - advantages.mean()
    std = np.sqrt(np.square(centred).mean())
    return (
        centred / std
        if std > 1e-10 * np.abs(advantages).max()
        else np.zeros_like(centred)
    )


class Gaussian(nn.Module):
    """Independent normal actions, in units where the bounds are ±1. Their standard deviations are
    sqrt(variance) · exp(log_std)."""

    def __init__(self, n_actions: int, variance: float) -> None:
        super().__init__()
        self.variance, self.log_std = variance, nn.Parameter(torch.zeros(n_actions))

    def std(self) -> Array:
        """float32 (d,)."""
        relative: Array = self.log_std.detach().cpu().exp().numpy()
        return np.float32(self.variance**0.5) * relative

    def log_prob(self, actions: Tensor, mean: Tensor) -> Tensor:
        """Log density (n,) of actions (n, d)."""
        residual = (actions - mean) / self.log_std.exp()
        constant = mean.shape[-1] * math.log(2 * math.pi * self.variance)
        squared = residual.square().sum(dim=-1) / self.variance
        return -0.5 * (squared + constant) - self.log_std.sum()


def gaussian_noise(actions: Array, rng: np.random.Generator, std: Array) -> Array:
    """Actions (n, d) with independent normal noise of standard deviations `std` (d,), float32."""
    return actions + std * rng.standard_normal(actions.shape, dtype=np.float32)


class Surrogate(NamedTuple):
    """The clipped surrogate objective, negated, of each transition (n,), and what is told of it."""

    loss: Tensor
    kl: Tensor
    """Unbiased estimate of the KL divergence from the old policy."""
    is_clipped: Tensor
    """Is the ratio outside the clip range?"""


def surrogate(log_ratio: Tensor, advantages: Tensor, clip_range: float) -> Surrogate:
    """Schulman et al. 2017, eq. 7, from log ratios and advantages (n,).

    Log ratios are cut at ±20 first, so that nothing overflows. That is far outside any clip range; what
    lies beyond has no gradient.
    """
    ratio = log_ratio.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO).exp()
    clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
    loss = -torch.minimum(ratio * advantages, clipped * advantages)
    return Surrogate(loss, (ratio - 1 - log_ratio).detach(), clipped != ratio)


class Transitions(NamedTuple):
    """What is learned from, as tensors with a leading axis (n, ...)."""

    obs: Tensor
    """The critic's, which begins with the actor's."""
    actions: Tensor
    log_prob: Tensor
    """Of the actions, when they were taken."""
    advantages: Tensor
    returns: Tensor

    def minibatches(self, order: Tensor, n: int) -> list[Transitions]:
        """All of it in another order (n,), cut into `n` parts as equal as can be."""
        parts = (torch.tensor_split(values[order], n) for values in self)
        return [Transitions(*part) for part in zip(*parts, strict=True)]

    def own_rows(self, comm: Communicator) -> Transitions:
        """Those that this rank computes."""
        return Transitions(
            *(torch.tensor_split(values, comm.size)[comm.rank] for values in self)
        )


def _parts(
    config: PPOConfig, spaces: Spaces, generator: torch.Generator
) -> tuple[MLP, Gaussian, Normalizer]:
    """What a policy is made of, before anything was learned; the same on all ranks."""
    gaussian = Gaussian(action_size(spaces.action), config.action_variance)
    actor = new_actor(config.hidden, spaces, generator)
    return actor, gaussian, flat_stats(spaces.observation, OBS_CLIP)


def _inputs(config: PPOConfig, stats: Normalizer) -> FlatInputs:
    return FlatInputs(stats.scaling() if config.normalise_obs else None)


def _policy(
    config: PPOConfig, spaces: Spaces, actor: MLP, gaussian: Gaussian, stats: Normalizer
) -> Policy:
    noise = partial(gaussian_noise, std=gaussian.std())
    return Policy(on_cpu(actor), _inputs(config, stats), noise, spaces)


def _in_turn(
    update: Callable[[Transitions], Tensor], minibatches: list[Transitions]
) -> Tensor:
    """What an update of each minibatch returns, stacked."""
    return torch.stack([update(minibatch) for minibatch in minibatches])


class PPO(Learner):
    """Actor, critic and the batch of the current epoch; the interface is `Learner`'s."""

    policy_parts = ("actor", "gaussian", "obs_stats")
    saved = (*policy_parts, "privileged_stats", "critic", "actor_adam", "critic_adam")
    counters = ("env_steps", "epochs")

    def build(self, generator: torch.Generator) -> None:
        config: PPOConfig = self.config
        self.actor, self.gaussian, self.obs_stats = _parts(
            config, self.spaces, generator
        )
        self.privileged_stats = flat_stats(self.spaces.privileged, OBS_CLIP)
        n_inputs = self._n_obs + flat_size(self.spaces.privileged)
        names = self.spaces.inputs(PRIVILEGED)
        self.critic = MLP((n_inputs, *config.hidden, 1), generator, inputs=names)
        if config.orthogonal_init:
            start_orthogonal(self.actor, ACTOR_GAIN, generator, self.spaces.inputs())
            start_orthogonal(self.critic, 1.0, generator, names)
        for network in (self.actor, self.gaussian, self.critic):
            network.to(self.device)
        self.gaussian.requires_grad_(config.exploration == "learned")
        learned = [
            self.actor,
            *([self.gaussian] if config.exploration == "learned" else []),
        ]
        self.actor_adam = FlatAdam(*((part, config.actor_lr) for part in learned))
        self.critic_adam = FlatAdam((self.critic, config.critic_lr))
        self.comm.broadcast_(self.actor_adam.vector)
        self.comm.broadcast_(self.critic_adam.vector)
        self.epochs, self._episodes = 0, list[Episode[Array]]()

    def describe(self) -> str:
        config = self.config
        n, passes = config.minibatches(config.steps_per_epoch), config.n_passes
        return (
            f"{n} minibatches of about {config.steps_per_epoch // n} transitions, {passes} passes: "
            f"{n * passes} updates of actor and critic per epoch"
        )

    # -- acting and collecting ---------------------------------------------------------------

    def policy(self) -> Policy:
        return _policy(
            self.config, self.spaces, self.actor, self.gaussian, self.obs_stats
        )

    def collect(self) -> dict[str, float]:
        """Whole episodes, until `steps_per_epoch` are there: the same ones on all ranks."""
        config = self.config
        if config.anneal_lr:
            self.actor_adam.scale_lr(self.progress_remaining)
            self.critic_adam.scale_lr(self.progress_remaining)
        job = PlayEpisode[Array](
            self.policy(), (self.seed, 0, rollout.TRAIN, self.epochs)
        )
        episodes = play_steps(self.workers, job, config.steps_per_epoch, self.comm)
        self._episodes = require_transitions(episodes)
        self.epochs += 1
        stats = summary(episodes)
        self.env_steps += int(stats.pop("steps"))
        return stats

    # -- learning ----------------------------------------------------------------------------

    def update(self) -> dict[str, float]:
        """`n_passes` over the batch in shuffled minibatches; each rank computes its rows of each."""
        config, batch = self.config, self._batch()
        n, n_minibatches = len(batch.obs), config.minibatches(len(batch.obs))
        rng = np.random.default_rng(
            [self.seed, 0, rollout.LEARN, self.epochs]
        )  # the same on all ranks
        sums, n_updates = torch.zeros(4, device=self.device), 0
        for _ in range(config.n_passes):
            order = torch.from_numpy(rng.random(n).argsort()).to(self.device)
            minibatches = batch.minibatches(order, n_minibatches)
            of_actor_and_critic = self.side_by_side(
                partial(_in_turn, self._update_actor, minibatches),
                partial(_in_turn, self._update_critic, minibatches),
            )
            stats = torch.cat(
                of_actor_and_critic, dim=1
            )  # policy loss, KL, clipped, value loss
            sums += stats.sum(dim=0)
            n_updates += n_minibatches
            if (
                config.target_kl is not None
                and self._total(stats[-1])[1] > config.target_kl
            ):
                break
        means = self._total(sums / n_updates)
        self._require_finite(torch.from_numpy(means), self.actor_adam, self.critic_adam)
        obs_mean = torch.from_numpy(self.obs_stats.mean)
        self._require_same(self.actor_adam.vector, self.critic_adam.vector, obs_mean)
        if config.normalise_obs:
            self.obs_stats.update(
                np.concatenate([np.stack(e.obs) for e in self._episodes])
            )
            privileged = np.concatenate(
                [np.stack(e.privileged) for e in self._episodes]
            )
            self.privileged_stats.update(privileged)
        policy_loss, kl, clipped, value_loss = means.tolist()
        learned = {"policy_loss": policy_loss, "value_loss": value_loss, "kl": kl}
        std = float(self.gaussian.std().mean())
        return {
            **learned,
            "clip_fraction": clipped,
            "action_std": std,
            "updates": n_updates,
        }

    def _total(self, stats: Tensor) -> Array:
        """The sums over all ranks."""
        return self.comm.sum(stats.cpu().double().numpy())

    def _update_actor(self, minibatch: Transitions) -> Tensor:
        """One step along the gradient of the whole minibatch; this rank's part of policy loss, KL
        estimate and clipped fraction."""
        n, own = len(minibatch.obs), minibatch.own_rows(self.comm)
        log_prob = self.gaussian.log_prob(
            own.actions, self.actor(own.obs[:, : self._n_obs])
        )
        found = surrogate(
            log_prob - own.log_prob, own.advantages, self.config.clip_range
        )
        self._step(self.actor_adam, found.loss.sum() / n)
        return (
            torch.stack([found.loss.detach(), found.kl, found.is_clipped]).sum(dim=1)
            / n
        )

    def _update_critic(self, minibatch: Transitions) -> Tensor:
        """Likewise; this rank's part of the value loss."""
        n, own = len(minibatch.obs), minibatch.own_rows(self.comm)
        loss = (self.critic(own.obs).squeeze(-1) - own.returns).square().sum() / n
        self._step(self.critic_adam, loss)
        return loss.detach()[None]

    def _step(self, adam: FlatAdam, loss: Tensor) -> None:
        adam.gradient.zero_()
        loss.backward()  # type: ignore[no-untyped-call]
        adam.reduce(self.comm)
        adam.clip(self.config.max_grad_norm)
        adam.step()

    @torch.no_grad()
    def _batch(self) -> Transitions:
        """The epoch as tensors."""
        config, episodes = self.config, self._episodes
        parts = (
            (self.obs_stats, [obs for e in episodes for obs in e.obs]),
            (
                self.privileged_stats,
                [values for e in episodes for values in e.privileged],
            ),
        )
        all_obs = torch.cat(
            [_inputs(config, stats).stack(views) for stats, views in parts], dim=1
        )
        all_obs = all_obs.to(self.device)
        all_values = self.critic(all_obs).squeeze(-1).cpu().double().numpy()
        is_last = np.concatenate([[False] * len(e) + [True] for e in episodes])
        by_episode = np.split(all_values, np.flatnonzero(is_last)[:-1] + 1)
        advantages = []
        for episode, values in zip(episodes, by_episode, strict=True):
            last, rewards = (
                values[-1] if self._goes_on(episode) else 0.0,
                np.array(episode.rewards),
            )
            advantages.append(
                gae(rewards, values[:-1], last, config.gamma, config.gae_lambda)
            )
        advantage = np.concatenate(advantages)
        returns = finite(advantage + all_values[~is_last], "a return")
        obs = all_obs[torch.from_numpy(~is_last).to(self.device)]
        taken = np.concatenate([np.stack(episode.actions) for episode in episodes])
        actions, normalised, target = (
            torch.from_numpy(values.astype(np.float32)).to(self.device)
            for values in (taken, normalise(advantage), returns)
        )
        log_prob = self.gaussian.log_prob(actions, self.actor(obs[:, : self._n_obs]))
        return Transitions(obs, actions, log_prob, normalised, target)

    def _goes_on(self, episode: Episode[Array]) -> bool:
        """Would more have followed its last transition? What diverged did not end by itself."""
        is_bootstrapped = (
            self.config.truncation == "bootstrap" and not episode.terminated
        )
        return bool(episode.faults["diverged"]) or is_bootstrapped

    # -- saving ------------------------------------------------------------------------------

    @staticmethod
    def saved_policy(
        config: PPOConfig, spaces: Spaces, saved: dict[str, Any]
    ) -> Policy:
        parts = _parts(config, spaces, torch.Generator())
        restore(dict(zip(PPO.policy_parts, parts, strict=True)), saved)
        return _policy(config, spaces, *parts)
