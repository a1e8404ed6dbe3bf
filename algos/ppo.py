"""Proximal policy optimisation (Schulman et al. 2017), as the paper uses it.

Read from top to bottom: the choices, the learner. The source of what the paper leaves open is
PPO-for-Beginners (yu2023ppo in the paper): whole episodes, GAE with returns = advantage + value,
advantages normalised over the batch, separate Adams.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from . import Array, Count, DivergenceError, Positive, Share, Workers, rollout, state
from .mpi import Communicator, same_on_all_ranks
from .networks import MLP, FlatAdam, require_finite, require_hidden, start_orthogonal
from .normalizer import Normalizer
from .policy import FlatInputs, Policy, flat_stats, new_actor, on_cpu
from .policy_gradient import Spread, Transitions, gae, gaussian, normalise, surrogate
from .rollout import Episode, PlayEpisode, finite, play_steps, require_transitions, summary
from .side_by_side import SideBySide, each, may_share
from .spaces import Spaces, action_size, flat_size

ACTOR_GAIN = 0.01  # of the last layer when weights start orthogonal
OBS_CLIP = 5.0  # normalised observations are cut there, as DDPG+HER's are


@dataclass(frozen=True)
class PPOConfig:
    """Hyperparameters; defaults are the paper's (Methods, PyBullet set-up) unless noted."""

    hidden: tuple[int, ...] = (256, 256, 256)
    """Units of each hidden layer, actor and critic alike."""
    actor_lr: Positive = 3e-4
    """Adam step size of the actor."""
    critic_lr: Positive = 1e-3
    """Adam step size of the critic."""
    action_variance: Positive = 0.05
    """Variance of the Gaussian policy in every action dimension, in units where the bounds are ±1."""
    gamma: Share = 0.99
    """Discount factor."""
    gae_lambda: Share = 0.97
    """Lambda of generalised advantage estimation."""
    clip_range: Positive = 0.2
    """Clip range of the probability ratio."""
    steps_per_epoch: Count = 1000
    """Least number of environment steps per epoch, over all processes; episodes are played to
    their end. Also --n-steps."""
    n_passes: Count = 80
    """Passes over the batch per epoch (paper: updates per epoch). Also --n-epochs."""
    n_minibatches: Count | None = None
    """Minibatches per pass; default: 6, unless --minibatch-size is given. The paper says
    "minibatch size: 6"; its source uses 6 as their number."""
    minibatch_size: Count | None = None
    """Transitions per minibatch, instead of --n-minibatches. Also --batch-size."""
    max_grad_norm: Positive = 0.5
    """Largest norm of the gradient, clipped separately for actor and critic."""
    exploration: Literal["fixed", "annealed", "learned"] = "fixed"
    """Variance of the policy. fixed: --action-variance; annealed: linear over the run, from there to
    --final-variance; learned: one per action dimension, starting there."""
    final_variance: Positive | None = None
    """With --exploration annealed: the last variance; default: a tenth of --action-variance."""
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
    """Decay both step sizes linearly to zero over the run (in the source, not in the paper)."""
    target_kl: Positive | None = None
    """Stop an epoch's passes when the KL divergence from the old policy exceeds this (in the source,
    not in the paper)."""

    def validate(self) -> None:
        """Raise ValueError naming what does not go together; ranges are in the types."""
        require_hidden(self.hidden)
        if self.n_minibatches is not None and self.minibatch_size is not None:
            raise ValueError(
                "n_minibatches and minibatch_size: found both, allowed one of them; "
                "None unsets that of a recipe"
            )
        if self.final_variance is not None and self.exploration != "annealed":
            raise ValueError(
                f"final_variance: found with exploration {self.exploration}, allowed only with annealed"
            )

    @property
    def anneals(self) -> bool:
        """Does the course of a run depend on how long it will be?"""
        return self.anneal_lr or self.exploration == "annealed"

    def minibatches(self, n: int) -> int:
        """Minibatches per pass over a batch of `n` transitions."""
        if self.minibatch_size is not None:
            return max(1, n // self.minibatch_size)
        return min(self.n_minibatches or 6, n)


def _parts(
    config: PPOConfig, spaces: Spaces, weights: torch.Generator
) -> tuple[MLP, Spread, Normalizer]:
    """What a policy is made of, before anything was learned; the same on all ranks."""
    spread = Spread(action_size(spaces.action), config.action_variance)
    actor = new_actor(config.hidden, spaces, weights)
    return actor, spread, flat_stats(spaces.observation, OBS_CLIP)


def _inputs(config: PPOConfig, stats: Normalizer) -> FlatInputs:
    return FlatInputs(stats.scaling() if config.normalise_obs else None)


def _policy(config: PPOConfig, spaces: Spaces, actor: MLP, spread: Spread, stats: Normalizer) -> Policy:
    noise = partial(gaussian, std=spread.std())
    return Policy(on_cpu(actor), _inputs(config, stats), noise, spaces)


class PPO(state.Saved):
    """Actor, critic and the batch of the current epoch; the interface is `algos.Algorithm`."""

    policy_parts = ("actor", "spread", "obs_stats")
    saved = (*policy_parts, "truth_stats", "critic", "actor_adam", "critic_adam")
    counters = ("env_steps", "epochs")
    cycles_per_epoch = 1

    def __init__(
        self,
        config: PPOConfig,
        workers: Workers,
        comm: Communicator,
        seed: int,
        total_timesteps: int,
        device: str = "cpu",
        cores: int = 1,
    ) -> None:
        config.validate()
        self.config, self.workers, self.comm = config, workers, comm
        self.total_timesteps, self.device = total_timesteps, torch.device(device)
        self.seed = seed
        self.spaces = Spaces(workers.observation_space, workers.action_space)
        weights = torch.Generator().manual_seed(seed)
        self.actor, self.spread, self.obs_stats = _parts(config, self.spaces, weights)
        self.truth_stats = flat_stats(self.spaces.truth, OBS_CLIP)
        self._n_obs = flat_size(self.spaces.observation)
        n_seen, seen = self._n_obs + flat_size(self.spaces.truth), self.spaces.inputs("truth")
        self.critic = MLP((n_seen, *config.hidden, 1), weights, inputs=seen)
        if config.orthogonal_init:
            start_orthogonal(self.actor, ACTOR_GAIN, weights, self.spaces.inputs())
            start_orthogonal(self.critic, 1.0, weights, seen)
        for network in (self.actor, self.spread, self.critic):
            network.to(self.device)
        self._both = SideBySide(may_share(cores, comm, self.device))
        learned = [self.actor, *([self.spread] if config.exploration == "learned" else [])]
        self.actor_adam = FlatAdam(*((part, config.actor_lr) for part in learned))
        self.critic_adam = FlatAdam((self.critic, config.critic_lr))
        comm.broadcast_(self.actor_adam.vector)
        comm.broadcast_(self.critic_adam.vector)
        self.env_steps = self.epochs = 0
        self._ahead = 1.0  # share of the run that lay ahead when the epoch began
        self._episodes: list[Episode[Array]] = []

    def describe(self) -> str:
        config = self.config
        n, passes = config.minibatches(config.steps_per_epoch), config.n_passes
        return (
            f"{n} minibatches of about {config.steps_per_epoch // n} transitions, {passes} passes: "
            f"{n * passes} updates of actor and critic per epoch"
        )

    # -- acting and collecting ---------------------------------------------------------------

    def policy(self) -> Policy:
        return _policy(self.config, self.spaces, self.actor, self.spread, self.obs_stats)

    def collect(self) -> dict[str, float]:
        """Whole episodes, until `steps_per_epoch` are there: the same ones on all ranks."""
        config = self.config
        self._ahead = left = max(0.0, 1.0 - self.env_steps / self.total_timesteps)
        if config.exploration == "annealed":
            start = config.action_variance
            self.spread.set(left * start + (1.0 - left) * (config.final_variance or start / 10))
        job = PlayEpisode[Array](self.policy(), (self.seed, 0, rollout.TRAIN, self.epochs))
        episodes = play_steps(self.workers, job, config.steps_per_epoch, self.comm)
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
            self.actor_adam.share = self.critic_adam.share = self._ahead
        batch = self._batch()
        n, n_minibatches = len(batch.seen), config.minibatches(len(batch.seen))
        rng = np.random.default_rng([self.seed, 0, rollout.LEARN, self.epochs])  # the same on all ranks
        sums, n_updates = torch.zeros(4, device=self.device), 0
        for _ in range(config.n_passes):
            order = torch.from_numpy(rng.random(n).argsort()).to(self.device)
            minibatches = batch.minibatches(order, n_minibatches)
            value_losses, others = self._both(
                partial(each, self._improve_critic, minibatches),
                partial(each, self._improve_actor, minibatches),
            )
            stats = torch.cat([others, value_losses], dim=1)
            sums += stats.sum(dim=0)
            n_updates += n_minibatches
            if config.target_kl is not None and self._total(stats[-1])[1] > config.target_kl:
                break
        means = self._total(sums / n_updates)
        self._check(torch.from_numpy(means))
        if config.normalise_obs:
            self.obs_stats.update(np.concatenate([np.stack(e.obs) for e in self._episodes]))
            self.truth_stats.update(np.concatenate([np.stack(e.truth) for e in self._episodes]))
        policy_loss, kl, clipped, value_loss = means.tolist()
        learned = {"policy_loss": policy_loss, "value_loss": value_loss, "kl": kl}
        std = float(self.spread.std().mean())
        return {**learned, "clip_fraction": clipped, "action_std": std, "updates": n_updates}

    def _total(self, stats: Tensor) -> Array:
        """The shares of all ranks together."""
        return self.comm.sum(stats.double().cpu().numpy())

    @torch.no_grad()
    def _batch(self) -> Transitions:
        """The epoch as tensors."""
        config, episodes = self.config, self._episodes
        views = [obs for episode in episodes for obs in episode.obs]
        seen = _inputs(config, self.obs_stats).stack(views)
        told = _inputs(config, self.truth_stats).stack([t for e in episodes for t in e.truth])
        all_seen = torch.cat([seen, told], dim=1).to(self.device)
        all_values = self.critic(all_seen).squeeze(-1).double().cpu().numpy()
        is_last = np.concatenate([[False] * len(e) + [True] for e in episodes])
        by_episode = np.split(all_values, np.flatnonzero(is_last)[:-1] + 1)
        advantages = []
        for episode, values in zip(episodes, by_episode, strict=True):
            last, rewards = values[-1] if self._goes_on(episode) else 0.0, np.array(episode.rewards)
            advantages.append(gae(rewards, values[:-1], last, config.gamma, config.gae_lambda))
        advantage = np.concatenate(advantages)
        returns = finite(advantage + all_values[~is_last], "a return")
        seen = all_seen[torch.from_numpy(~is_last).to(self.device)]
        taken = np.concatenate([np.stack(episode.actions) for episode in episodes])
        actions, normalised, target = (
            torch.from_numpy(values.astype(np.float32)).to(self.device)
            for values in (taken, normalise(advantage), returns)
        )
        away = self.spread.away(actions, self.actor(seen[:, : self._n_obs]))
        return Transitions(seen, actions, self.spread.log_prob(away), normalised, target)

    def _goes_on(self, episode: Episode[Array]) -> bool:
        """Would more have followed its last transition? What diverged did not end by itself."""
        is_bootstrapped = self.config.truncation == "bootstrap" and not episode.terminated
        return bool(episode.faults["diverged"]) or is_bootstrapped

    @torch.no_grad()
    def _improve_actor(self, minibatch: Transitions) -> Tensor:
        """One step along the gradient of the whole minibatch; this rank's shares of policy loss, KL
        estimate and clipped share."""
        n, own = len(minibatch.seen), minibatch.share(self.comm.rank, self.comm.size)
        acted = self.actor.run(own.seen[:, : self._n_obs])
        away = self.spread.away(own.actions, acted[-1])
        log_ratio = self.spread.log_prob(away) - own.log_prob
        loss, slope, kl, is_clipped = surrogate(log_ratio, own.advantages, self.config.clip_range)
        self.actor.backward(acted, self.spread.backward(away, slope, n))
        self._step(self.actor_adam)
        return torch.stack([loss, kl, is_clipped]).sum(dim=1) / n

    @torch.no_grad()
    def _improve_critic(self, minibatch: Transitions) -> Tensor:
        """Likewise; this rank's share of the value loss."""
        n, own = len(minibatch.seen), minibatch.share(self.comm.rank, self.comm.size)
        judged = self.critic.run(own.seen)
        error = judged[-1] - own.returns[:, None]
        self.critic.backward(judged, error * (2 / n))
        self._step(self.critic_adam)
        return error.square().sum(dim=0) / n

    def _step(self, adam: FlatAdam) -> None:
        adam.reduce(self.comm)
        adam.clip(self.config.max_grad_norm)
        adam.step()

    def _check(self, sums: Tensor) -> None:
        """Stop with DivergenceError when something broke or the ranks have parted."""
        require_finite([self.actor_adam, self.critic_adam], sums, self.env_steps)
        mean = torch.from_numpy(self.obs_stats.mean)
        shared = (self.actor_adam.vector, self.critic_adam.vector, mean)
        if not all(same_on_all_ranks(self.comm, own) for own in shared):
            raise DivergenceError("the ranks' parameters differ")

    # -- saving ------------------------------------------------------------------------------

    @staticmethod
    def saved_policy(config: PPOConfig, spaces: Spaces, saved: dict[str, Any]) -> Policy:
        parts = _parts(config, spaces, torch.Generator())
        state.restore_parts(dict(zip(PPO.policy_parts, parts, strict=True)), saved)
        return _policy(config, spaces, *parts)
