"""Proximal policy optimisation (Schulman et al. 2017), as the paper uses it.

Read from top to bottom: the choices, pure functions, the learner. The source of what
the paper leaves open is PPO-for-Beginners (yu2023ppo in the paper): whole episodes, GAE with
returns = advantage + value, advantages normalised over the batch, separate Adams.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from . import Array, DivergenceError, Workers, check_ranges, flat_size, state
from .mpi import Communicator, same_on_all_ranks
from .networks import MLP, FlatAdam, require_finite
from .policy import FlatInputs, Policy, new_actor, on_cpu
from .rollout import TRAIN, Episode, PlayEpisode, finite, play_steps, require_transitions, summary
from .spaces import Spaces

SAVED = ("actor", "critic", "actor_adam", "critic_adam")
COUNTERS = ("env_steps", "epochs")
MAX_LOG_RATIO = 20.0  # exp(20) = 5e8: far outside any clip range, far inside float32


@dataclass(frozen=True)
class PPOConfig:
    """Hyperparameters; defaults are the paper's (Methods, PyBullet set-up) unless noted."""

    hidden: tuple[int, ...] = (256, 256, 256)
    """Units of each hidden layer, actor and critic alike."""
    actor_lr: float = 3e-4
    """Adam step size of the actor."""
    critic_lr: float = 1e-3
    """Adam step size of the critic."""
    action_variance: float = 0.05
    """Fixed variance of the Gaussian policy in every action dimension."""
    gamma: float = 0.99
    """Discount factor."""
    gae_lambda: float = 0.97
    """Lambda of the generalised advantage estimator."""
    clip_range: float = 0.2
    """Clip range of the probability ratio."""
    steps_per_epoch: int = 1000
    """Least environment steps per epoch, over all processes; episodes are played to their end."""
    n_passes: int = 80
    """Passes over the batch per epoch ("Updates per epoch")."""
    n_minibatches: int | None = None
    """Minibatches per pass; default: 6, unless --minibatch-size is given. (The paper's
    "Minibatch size: 6", read as its source reads it.)"""
    minibatch_size: int | None = None
    """Transitions per minibatch: the other reading. Excludes --n-minibatches."""
    max_grad_norm: float = 0.5
    """Largest gradient norm, of actor and critic separately; larger gradients are scaled down."""
    truncation: Literal["bootstrap", "terminal"] = "bootstrap"
    """What follows the last step before a time limit: the critic's value of the last observation,
    or nothing. In the paper's task a time-out ends the task itself, with -100."""
    anneal_lr: bool = False
    """Let both step sizes fall linearly to zero over the run (in the source, not in the paper)."""
    target_kl: float | None = None
    """End the epoch's passes when the KL divergence from the old policy exceeds this (in the
    source, not in the paper)."""

    def validate(self) -> None:
        """Raise ValueError naming the first invalid field."""
        check_ranges(
            self,
            positive=(
                "actor_lr",
                "critic_lr",
                "action_variance",
                "clip_range",
                "max_grad_norm",
                "target_kl",
            ),
            shares=("gamma", "gae_lambda"),
            counts=("steps_per_epoch", "n_passes", "n_minibatches", "minibatch_size"),
        )
        if self.n_minibatches is not None and self.minibatch_size is not None:
            raise ValueError("n_minibatches and minibatch_size: found both, allowed one of them")

    def minibatches(self, n: int) -> int:
        """Minibatches per pass over a batch of `n` transitions."""
        if self.minibatch_size is not None:
            return max(1, n // self.minibatch_size)
        return min(self.n_minibatches or 6, n)


def gae(rewards: Array, values: Array, last_value: float, gamma: float, lam: float) -> Array:
    """Generalised advantages (n,) of one episode, float64 (Schulman et al. 2016, eq. 16).

    `values` (n,) are the critic's at each step, `last_value` the one after the last step:
    0 where nothing follows.
    """
    next_values = np.append(values[1:], last_value)
    deltas = (rewards + gamma * next_values - values).tolist()
    advantages = np.empty(len(deltas))
    running = 0.0
    for t in range(len(deltas) - 1, -1, -1):
        running = deltas[t] + gamma * lam * running
        advantages[t] = running
    return advantages


def log_prob(actions: Tensor, mean: Tensor, variance: float) -> Tensor:
    """Log density (n,) of a Gaussian with diagonal covariance `variance`, at `actions` (n, d)."""
    squared = (actions - mean).square().sum(dim=-1)
    dimensions = actions.shape[-1]
    return -0.5 * (squared / variance + dimensions * float(np.log(2 * np.pi * variance)))


def normalise(advantages: Array) -> Array:
    """Advantages (n,) with mean 0 and standard deviation 1; zeros where all are alike."""
    centred = advantages - advantages.mean()
    std = np.sqrt(np.square(centred).mean())
    return centred / std if std > 1e-10 * np.abs(advantages).max() else np.zeros_like(centred)


class Surrogate(NamedTuple):
    """The clipped surrogate objective, negated, of each transition (n,), and what it is made of."""

    loss: Tensor
    slope: Tensor
    """Gradient of the loss by the log ratio."""
    kl: Tensor
    """Unbiased estimate of the KL divergence from the old policy."""
    is_clipped: Tensor
    """Is the ratio outside the clip range?"""


def surrogate(log_ratio: Tensor, advantages: Tensor, clip_range: float) -> Surrogate:
    """Schulman et al. 2017, eq. 7, from log ratios and advantages (n,).

    Log ratios are cut at ±20 first: no minimum changes, and an overflow cannot happen.
    """
    cut = log_ratio.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO)
    ratio = cut.exp()
    clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
    gain, bounded = ratio * advantages, clipped * advantages
    counts = (gain <= bounded) & (cut == log_ratio)
    return Surrogate(
        loss=-torch.minimum(gain, bounded),
        slope=-gain * counts,
        kl=ratio - 1 - log_ratio,
        is_clipped=clipped != ratio,
    )


def gaussian(actions: Array, variance: float, rng: np.random.Generator) -> Array:
    """Actions (..., d) with independent normal noise."""
    return actions + np.float32(variance**0.5) * rng.standard_normal(actions.shape, dtype=np.float32)


def _policy(config: PPOConfig, spaces: Spaces, actor: MLP) -> Policy:
    noise = partial(gaussian, variance=config.action_variance)
    return Policy(on_cpu(actor), FlatInputs(), noise, spaces)


class PPO:
    """Actor, critic and the batch of the current epoch; the interface is `algos.Algorithm`."""

    policy_parts = ("actor",)
    cycles_per_epoch = 1

    def __init__(
        self,
        config: PPOConfig,
        workers: Workers,
        comm: Communicator,
        seed: int,
        total_timesteps: int,
        device: str = "cpu",
    ) -> None:
        config.validate()
        self.config, self.workers, self.comm = config, workers, comm
        self.total_timesteps, self.device = total_timesteps, torch.device(device)
        self.seed = seed
        self.rng = np.random.default_rng(seed)  # the same on all ranks: they share every minibatch
        self.spaces = Spaces(workers.observation_space, workers.action_space)
        weights = torch.Generator().manual_seed(seed)
        self.actor = new_actor(config.hidden, self.spaces, weights).to(self.device)
        n_obs = flat_size(self.spaces.observation)
        self.critic = MLP((n_obs, *config.hidden, 1), weights).to(self.device)
        self.actor_adam = FlatAdam((self.actor, config.actor_lr))
        self.critic_adam = FlatAdam((self.critic, config.critic_lr))
        comm.broadcast_(self.actor_adam.vector)
        comm.broadcast_(self.critic_adam.vector)
        self.env_steps = self.epochs = 0
        self._episodes: list[Episode[Array]] = []

    def describe(self) -> str:
        """What the configuration amounts to, in words."""
        config = self.config
        n = config.minibatches(config.steps_per_epoch)
        return (
            f"{n} minibatches of about {config.steps_per_epoch // n} transitions, {config.n_passes} "
            f"passes: {n * config.n_passes} updates of actor and critic per epoch"
        )

    # -- acting and collecting ---------------------------------------------------------------

    def policy(self) -> Policy:
        """What acts now; good until the next update."""
        return _policy(self.config, self.spaces, self.actor)

    def collect(self) -> dict[str, float]:
        """Whole episodes, until `steps_per_epoch` are there: the same ones on all ranks."""
        task = PlayEpisode[Array](self.policy(), (self.seed, 0, TRAIN, self.epochs))
        episodes = play_steps(self.workers, task, self.config.steps_per_epoch, self.comm)
        self._episodes = require_transitions(episodes)
        self.epochs += 1
        seen = summary(episodes)
        self.env_steps += int(seen.pop("steps"))
        return seen

    # -- learning ----------------------------------------------------------------------------

    def update(self) -> dict[str, float]:
        """`n_passes` over the batch in shuffled minibatches; each rank computes its share of each."""
        config = self.config
        if config.anneal_lr:
            left = max(0.0, 1.0 - self.env_steps / self.total_timesteps)
            self.actor_adam.set_lr(config.actor_lr * left)
            self.critic_adam.set_lr(config.critic_lr * left)
        batch = self._batch()
        n = len(batch[0])
        n_minibatches = config.minibatches(n)
        sums, n_updates = torch.zeros(4, device=self.device), 0
        for _ in range(config.n_passes):
            order = torch.from_numpy(self.rng.permutation(n)).to(self.device)
            shuffled = (torch.tensor_split(t[order], n_minibatches) for t in batch)
            stats = torch.zeros(4)
            for minibatch in zip(*shuffled, strict=True):
                stats = self._minibatch(*minibatch)
                sums += stats
                n_updates += 1
            if config.target_kl is not None and self._total(stats)[2] > config.target_kl:
                break
        means = self._total(sums / n_updates)
        self._check(torch.from_numpy(means))
        policy_loss, value_loss, kl, clip_fraction = means.tolist()
        return {
            "policy_loss": policy_loss,
            "value_loss": value_loss,
            "kl": kl,
            "clip_fraction": clip_fraction,
            "updates": n_updates,
        }

    def _total(self, stats: Tensor) -> Array:
        """The shares of all ranks together."""
        return self.comm.sum(stats.double().cpu().numpy())

    @torch.no_grad()
    def _batch(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The epoch as tensors: obs, actions, old log-probabilities, advantages, returns."""
        config, episodes = self.config, self._episodes
        all_obs = torch.from_numpy(np.concatenate([np.stack(e.obs) for e in episodes])).to(self.device)
        all_values = self.critic(all_obs).squeeze(-1).double().cpu().numpy()
        is_last = np.concatenate([[False] * len(e) + [True] for e in episodes])
        advantages, start = [], 0
        for episode in episodes:
            end = start + len(episode)
            last_value = all_values[end] if self._goes_on(episode) else 0.0
            rewards = np.array(episode.rewards)
            advantages.append(
                gae(rewards, all_values[start:end], last_value, config.gamma, config.gae_lambda)
            )
            start = end + 1
        advantage = np.concatenate(advantages)
        returns = finite(advantage + all_values[~is_last], "a return")
        obs = all_obs[torch.from_numpy(~is_last).to(self.device)]
        actions = torch.from_numpy(np.concatenate([np.stack(e.actions) for e in episodes]))
        actions = actions.to(self.device)
        old_log_prob = log_prob(actions, self.actor(obs), config.action_variance)
        normalised, target = (
            torch.from_numpy(x.astype(np.float32)).to(self.device)
            for x in (normalise(advantage), returns)
        )
        return obs, actions, old_log_prob, normalised, target

    def _goes_on(self, episode: Episode[Array]) -> bool:
        """Would more have followed its last transition? What diverged did not end by itself."""
        if episode.faults["diverged"]:
            return True
        return self.config.truncation == "bootstrap" and not episode.terminated

    @torch.no_grad()
    def _minibatch(
        self, obs: Tensor, actions: Tensor, old: Tensor, advantages: Tensor, returns: Tensor
    ) -> Tensor:
        """One step of both networks along the gradient of the whole minibatch.

        This rank's shares of policy loss, value loss, KL estimate and clipped share.
        """
        config, n = self.config, len(obs)
        if self.comm.size > 1:
            obs, actions, old, advantages, returns = (
                torch.tensor_split(t, self.comm.size)[self.comm.rank]
                for t in (obs, actions, old, advantages, returns)
            )
        seen, judged = self.actor.run(obs), self.critic.run(obs)
        away, error = actions - seen[-1], judged[-1] - returns[:, None]
        log_ratio = log_prob(actions, seen[-1], config.action_variance) - old
        loss, slope, kl, is_clipped = surrogate(log_ratio, advantages, config.clip_range)
        self.actor.backward(seen, (slope / (n * config.action_variance))[:, None] * away)
        self.critic.backward(judged, error * (2 / n))
        for adam in (self.actor_adam, self.critic_adam):
            adam.reduce(self.comm)
            adam.clip(config.max_grad_norm)
            adam.step()
        return torch.stack([loss, error.square().squeeze(-1), kl, is_clipped]).sum(dim=1) / n

    def _check(self, sums: Tensor) -> None:
        """Stop with DivergenceError when something broke or the ranks have parted."""
        require_finite([self.actor_adam, self.critic_adam], sums, self.env_steps)
        for adam in (self.actor_adam, self.critic_adam):
            if not same_on_all_ranks(self.comm, adam.vector):
                raise DivergenceError("the ranks' parameters differ")

    # -- saving ------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, random state, counters: all that the next epoch depends on."""
        return state.save(self, SAVED, COUNTERS)

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on exactly where `state_dict` was taken."""
        state.restore(self, saved, SAVED, COUNTERS)

    @staticmethod
    def saved_policy(config: PPOConfig, spaces: Spaces, saved: dict[str, Any]) -> Policy:
        """The policy in what `state_dict` returned, on the CPU and without a learner around it."""
        actor = new_actor(config.hidden, spaces, torch.Generator())
        state.restore_parts({"actor": actor}, saved)
        return _policy(config, spaces, actor)
