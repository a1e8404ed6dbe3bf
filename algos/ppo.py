"""Proximal policy optimisation (Schulman et al. 2017), as the paper uses it.

Read from top to bottom: the choices, three pure functions, the learner. The source of what
the paper leaves open is PPO-for-Beginners (yu2023ppo in the paper): whole episodes, GAE with
returns = advantage + value, advantages normalised over the batch, separate Adams.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from . import Array, DivergenceError, EnvPool, check_ranges, flat_observation, flat_size, state
from .mpi import Communicator, same_on_all_ranks
from .networks import MLP, FlatAdam, require_finite
from .rollout import Episode, Rollouts, finite, summary

SAVED = ("actor", "critic", "actor_adam", "critic_adam")
COUNTERS = ("env_steps",)
MAX_LOG_RATIO = 20.0  # exp(20) = 5e8: far outside any clip range, far inside float32


@dataclass(frozen=True)
class PPOConfig:
    """Hyperparameters; defaults are the paper's (Methods, PyBullet set-up) unless said."""

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
    """Environment steps per epoch over all ranks, at least: episodes are finished."""
    n_passes: int = 80
    """Passes over the batch per epoch ("Updates per epoch")."""
    n_minibatches: int | None = None
    """Minibatches per pass; 6 when --minibatch-size is not given either. The paper's
    "Minibatch size: 6" read as its source reads it."""
    minibatch_size: int | None = None
    """Transitions per minibatch: the other reading. Not together with --n-minibatches."""
    entropy_coef: float = 0.0
    """Only 0 (paper): with a fixed variance the entropy is constant and cannot teach anything."""
    max_grad_norm: float = 0.5
    """Gradient norm is clipped to this, actor and critic separately."""
    truncation: Literal["terminal", "bootstrap"] = "terminal"
    """What follows the last step before a time limit: nothing (the source, and the paper's -100
    at time-out), or the critic's value of the last observation."""
    anneal_lr: bool = False
    """Let both step sizes fall linearly to zero over the run (in the source, not in the paper)."""
    target_kl: float | None = None
    """End the epoch's passes when the KL divergence from the old policy exceeds this (in the
    source, not in the paper)."""

    def validate(self) -> None:
        """Raise ValueError naming the first field that cannot be."""
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
        if self.entropy_coef != 0:
            raise ValueError(f"entropy_coef: found {self.entropy_coef}, allowed 0")

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


def clipped_loss(log_ratio: Tensor, advantages: Tensor, clip_range: float) -> Tensor:
    """The clipped surrogate objective, negated (Schulman et al. 2017, eq. 7): a scalar.

    Log ratios are cut at ±20 first: no minimum changes, and an overflow cannot happen.
    """
    ratio = log_ratio.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO).exp()
    clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
    return -torch.min(ratio * advantages, clipped * advantages).mean()


class PPO:
    """Actor, critic and the batch of the current epoch; the interface is `algos.Algorithm`."""

    def __init__(
        self,
        config: PPOConfig,
        pool: EnvPool,
        comm: Communicator,
        seed: int,
        total_timesteps: int,
        device: str = "cpu",
    ) -> None:
        config.validate()
        self.config, self.pool, self.comm = config, pool, comm
        self.total_timesteps, self.device = total_timesteps, torch.device(device)
        self.rng = np.random.default_rng([seed, comm.rank])
        self.rollouts = Rollouts(pool, flat_observation, self.rng)
        n_obs, n_actions = flat_size(pool.observation_space), self.rollouts.n_actions
        weights = torch.Generator().manual_seed(seed)
        self.actor = MLP((n_obs, *config.hidden, n_actions), weights, tanh=True).to(self.device)
        self.critic = MLP((n_obs, *config.hidden, 1), weights).to(self.device)
        self.actor_adam = FlatAdam((self.actor, config.actor_lr))
        self.critic_adam = FlatAdam((self.critic, config.critic_lr))
        self.env_steps, self.cycles_per_epoch = 0, 1
        self._episodes: list[Episode[Array]] = []

    def prepare(self) -> str:
        """What the configuration amounts to, in words."""
        config = self.config
        steps = -(-config.steps_per_epoch // self.comm.size)
        n = config.minibatches(steps)
        return (
            f"{n} minibatches of about {steps // n} transitions, {config.n_passes} "
            f"passes: {n * config.n_passes} updates of actor and critic per epoch"
        )

    # -- acting and collecting ---------------------------------------------------------------

    def act(self, obs: Any, deterministic: bool = False) -> Array:
        """Action for one observation, in the environment's own range."""
        return self.rollouts.to_env(self._sample([flat_observation(obs)], deterministic))[0]

    @torch.no_grad()
    def _sample(self, obs: list[Array], deterministic: bool = False) -> Array:
        """Actions (n, d) in units of the policy, where the bounds are ±1."""
        mean = self.actor(torch.from_numpy(np.stack(obs)).to(self.device)).cpu().numpy()
        if deterministic:
            return mean
        noise = self.rng.standard_normal(mean.shape, dtype=np.float32)
        return mean + np.float32(self.config.action_variance**0.5) * noise

    def collect(self) -> dict[str, float]:
        """Whole episodes, until this rank's share of `steps_per_epoch` is there."""
        wanted = -(-self.config.steps_per_epoch // self.comm.size)
        self._episodes = self.rollouts.play(self._sample, steps=wanted)
        seen = summary(self._episodes, self.rollouts.faults, self.comm)
        self.env_steps += int(seen.pop("steps"))
        return seen

    def test(self) -> dict[str, float]:
        """Nothing: the paper's success rate is that of the training episodes."""
        return {}

    # -- learning ----------------------------------------------------------------------------

    def update(self) -> dict[str, float]:
        """`n_passes` over the batch in shuffled minibatches."""
        config, comm = self.config, self.comm
        if config.anneal_lr:
            left = max(0.0, 1.0 - self.env_steps / self.total_timesteps)
            self.actor_adam.set_lr(config.actor_lr * left)
            self.critic_adam.set_lr(config.critic_lr * left)
        batch = self._batch()
        n = len(batch[0])
        n_minibatches = comm.min(config.minibatches(n))
        sums, n_updates = torch.zeros(4, device=self.device), 0
        for _ in range(config.n_passes):
            order = torch.from_numpy(self.rng.permutation(n)).to(self.device)
            shuffled = (torch.tensor_split(t[order], n_minibatches) for t in batch)
            kl = 0.0
            for minibatch in zip(*shuffled, strict=True):
                stats = self._minibatch(*minibatch)
                sums += stats
                kl, n_updates = float(stats[2]), n_updates + 1
            if config.target_kl is not None and comm.average(kl) > config.target_kl:
                break
        self._check(sums)
        policy_loss, value_loss, kl, clip_fraction = (sums / n_updates).tolist()
        return {
            "policy_loss": policy_loss,
            "value_loss": value_loss,
            "kl": kl,
            "clip_fraction": clip_fraction,
            "updates": n_updates,
        }

    @torch.no_grad()
    def _batch(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The epoch as tensors: obs, actions, old log-probabilities, advantages, returns."""
        config, episodes = self.config, self._episodes
        all_obs = torch.from_numpy(np.concatenate([np.stack(e.obs) for e in episodes])).to(self.device)
        all_values = self.critic(all_obs).squeeze(-1).double().cpu().numpy()
        is_last = np.concatenate([[False] * len(e.rewards) + [True] for e in episodes])
        advantages, start = [], 0
        for episode in episodes:
            end = start + len(episode.rewards)
            follows = config.truncation == "bootstrap" and not episode.terminated
            last_value = all_values[end] if follows else 0.0
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
            for x in (self._normalise(advantage), returns)
        )
        return obs, actions, old_log_prob, normalised, target

    def _normalise(self, advantage: Array) -> Array:
        """Mean 0 and standard deviation 1 over all ranks; zero where all are alike."""
        n, total = self.comm.sum(np.array([advantage.size, advantage.sum()]))
        centred = advantage - total / n
        squares, largest = self.comm.sum(np.array([np.square(centred).sum(), np.abs(advantage).max()]))
        std = np.sqrt(squares / n)
        return centred / std if std > 1e-10 * largest else np.zeros_like(centred)

    def _minibatch(
        self, obs: Tensor, actions: Tensor, old: Tensor, advantages: Tensor, returns: Tensor
    ) -> Tensor:
        """One step of both networks; policy loss, value loss, KL estimate, clipped share."""
        config = self.config
        log_ratio = log_prob(actions, self.actor(obs), config.action_variance) - old
        policy_loss = clipped_loss(log_ratio, advantages, config.clip_range)
        value_loss = (self.critic(obs).squeeze(-1) - returns).square().mean()
        self.actor_adam.zero_grad()
        self.critic_adam.zero_grad()
        (policy_loss + value_loss).backward()
        for adam in (self.actor_adam, self.critic_adam):
            adam.reduce(self.comm)
            adam.clip(config.max_grad_norm)
            adam.step()
        with torch.no_grad():
            ratio = log_ratio.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO).exp()
            kl = (ratio - 1 - log_ratio).mean()
            clipped = ((ratio - 1).abs() > config.clip_range).float().mean()
            return torch.stack([policy_loss, value_loss, kl, clipped])

    def _check(self, sums: Tensor) -> None:
        """Stop with DivergenceError when something broke or the ranks have parted."""
        require_finite([self.actor_adam, self.critic_adam], sums, self.env_steps)
        for adam in (self.actor_adam, self.critic_adam):
            if not same_on_all_ranks(self.comm, adam.vector):
                raise DivergenceError("the ranks' parameters differ")

    # -- saving ------------------------------------------------------------------------------

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, random state, counters: all that the next epoch depends on."""
        return state.take(self, SAVED, COUNTERS)

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on exactly where `state_dict` was taken."""
        state.give(self, saved, SAVED, COUNTERS)

    @property
    def experience_bytes(self) -> int:
        """Nothing is remembered from epoch to epoch."""
        return 0

    def new_experience(self, everything: bool = False) -> dict[str, Any]:
        """Nothing."""
        return {}

    def add_experience(self, saved: dict[str, Any], is_foreign: bool = False) -> None:
        """Nothing to remember."""
