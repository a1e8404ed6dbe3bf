"""Proximal policy optimisation (Schulman et al. 2017), as the paper uses it.

Read from top to bottom: hyperparameters, equations, the learner. What the paper leaves open is as in
PPO-for-Beginners (Yu 2023), the code that the paper used: whole episodes, GAE with returns = advantage
+ value, advantages normalized over the batch, an Adam for each network.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from . import Array, Count, Fraction, Positive32, rollout
from .learner import Learner, LearnerConfig, restore
from .mpi import Communicator
from .networks import MLP, flushed_denormals, require_hidden, start_orthogonal
from .normalizer import Normalizer
from .policy import (
    FlatInputs,
    Noise,
    Policy,
    Spaces,
    TaxelScale,
    action_size,
    input_stats,
    new_actor,
    on_cpu,
)
from .rollout import (
    Episode,
    PlayEpisode,
    discounted,
    finite,
    largest_return,
    play_steps,
    require_transitions,
    summary,
)

ACTOR_GAIN = 0.01  # of the last layer when weights start orthogonal
OBS_CLIP = 5.0  # scaled observations are cut there, as DDPG+HER's are
MAX_LOG_RATIO = 20.0  # exp(20) = 5e8: far outside any clip range, far inside float32


@dataclass(frozen=True)
class PPOConfig(LearnerConfig):
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
    "minibatch size: 6"; in its code, 6 is their number."""
    minibatch_size: Count | None = None
    """Minimum number of transitions per minibatch, instead of --n-minibatches; the batch is
    split evenly. (Stable-Baselines3: batch_size.)"""
    max_grad_norm: Positive32 = 0.5
    """Largest norm of the gradient, clipped separately for actor and critic."""
    exploration: Literal["fixed", "learned"] = "fixed"
    """Variance of the policy. fixed: --action-variance; learned: one per action dimension, starting
    there."""
    std_lr: Positive32 | None = None
    """Learning rate of a learned variance (Adam); default: the actor's."""
    orthogonal_init: bool = False
    """Orthogonal initial weights, with an actor whose last layer is near zero; otherwise they are
    uniform in ±1/sqrt(inputs)."""
    normalize_obs: bool = False
    """Normalize observations with the mean and standard deviation of all earlier epochs, clipped to ±5.
    Entries between 0 and 1, such as Boolean taxels, follow --taxel-scale instead."""
    taxel_scale: TaxelScale = "none"
    """Scale of entries between 0 and 1, such as Boolean taxels. none: as they are; block: one gain for
    all, so that together they count as much as 24 normalized inputs, however many they are; each:
    every one normalized by itself."""
    normalize_rewards: bool = False
    """Divide rewards by a running scale, so that the largest return so far counts as 1. The critic's
    learning rate then means the same, whatever unit rewards have."""
    truncation: Literal["bootstrap", "terminal"] = "bootstrap"
    """Treatment of a time limit. bootstrap: the return continues with the critic's value of the last
    observation; terminal: the return ends. In the paper's task a time-out is a failure, with -100.
    """
    anneal_lr: bool = False
    """Decay both learning rates to zero, linearly over the run (in the paper's code, not its text)."""
    target_kl: Positive32 | None = None
    """Stop an epoch's passes when the KL divergence from the old policy exceeds this (in the paper's
    code, not in its text)."""
    undo_silent: bool = False
    """Do not update the actor from epochs in which every episode fails alike, and undo the update after
    which they do: a policy that meets no reward would go on learning from noise."""

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
        """True if the course of a run depends on how long it will be."""
        return self.anneal_lr

    def minibatches(self, n: int) -> int:
        """Return the number of minibatches per pass over a batch of `n` transitions."""
        if self.minibatch_size is not None:
            return max(1, n // self.minibatch_size)
        return min(self.n_minibatches or 6, n)


def gae(
    rewards: Array, values: Array, last_value: float, gamma: float, lam: float
) -> Array:
    """Return generalised advantages (n,) of one episode, float64 (Schulman et al. 2016, eq. 16).

    `values` (n,) are the critic's at each step, `last_value` the one after the last step:
    0 where nothing follows.
    """
    next_values = np.append(values[1:], last_value)
    deltas = (rewards + gamma * next_values - values).tolist()
    # Backwards in time: A[t] = delta[t] + gamma lambda A[t + 1].
    return np.array(discounted(deltas, gamma * lam))


def normalize(advantages: Array) -> Array:
    """Return advantages (n,) with mean 0 and standard deviation 1; zeros where all are alike."""
    centred = advantages - advantages.mean()
    std = np.sqrt(np.square(centred).mean())
    return (
        centred / std
        if std > 1e-10 * np.abs(advantages).max()
        else np.zeros_like(centred)
    )


class Gaussian(nn.Module):
    """Give actions independent normal noise, in units where the bounds are ±1.

    Its standard deviations are sqrt(variance) · exp(log_std), so `log_std` is relative to the first.
    """

    def __init__(self, n_actions: int, variance: float) -> None:
        super().__init__()
        self.variance, self.log_std = variance, nn.Parameter(torch.zeros(n_actions))

    def std(self) -> Array:
        """Return the standard deviation of each action, float32 (d,)."""
        relative: Array = self.log_std.detach().cpu().exp().numpy()
        return np.float32(self.variance**0.5) * relative

    def log_prob(self, actions: Tensor, mean: Tensor) -> Tensor:
        """Return the log density (n,) of actions (n, d)."""
        residual = (actions - mean) / self.log_std.exp()
        constant = mean.shape[-1] * math.log(2 * math.pi * self.variance)
        squared = residual.square().sum(dim=-1) / self.variance
        return -0.5 * (squared + constant) - self.log_std.sum()


def gaussian_noise(rng: np.random.Generator, std: Array) -> Noise:
    """Return a function that adds normal noise of standard deviations `std` (d,) to actions (n, d)."""
    return lambda actions: (
        actions + std * rng.standard_normal(actions.shape, dtype=np.float32)
    )


class Surrogate(NamedTuple):
    """Hold the negated clipped objective of each transition (n,), and figures to watch it by."""

    loss: Tensor
    kl: Tensor
    """Estimate of the KL divergence from the old policy, ratio - 1 - log(ratio): Schulman's k3,
    which is unbiased and never negative."""
    is_clipped: Tensor
    """True where the ratio is outside the clip range."""


def surrogate(log_ratio: Tensor, advantages: Tensor, clip_range: Any) -> Surrogate:
    """Return the clipped objective from log ratios and advantages (n,) (Schulman et al. 2017, eq. 7).

    Log ratios are cut at ±20 first, so that nothing overflows. That is far outside any clip range; what
    lies beyond has no gradient.
    """
    ratio = log_ratio.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO).exp()
    clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
    loss = -torch.minimum(ratio * advantages, clipped * advantages)
    return Surrogate(loss, (ratio - 1 - log_ratio).detach(), clipped != ratio)


class Silence:
    """Judge whether the last update is to blame that every episode fails alike.

    It counts episodes by their returns: those that failed, with the lowest return of an epoch in which
    returns differed, and all others. Both fade by `KEEP` from one update to the next, so they speak of
    the last five or so. An update is undone once as many failures in a row as came since had a
    probability below `LEVEL` before it: for a success rate between 0 and 1 that the counts leave
    uncertain (Beta distribution, Jeffreys' prior). So of updates that change nothing, about one in
    fifty is undone. After that, nothing is judged until there is another update.
    """

    LEVEL, KEEP, PRIOR = 0.02, 0.8, 0.5

    def __init__(self) -> None:
        self.failure = -math.inf  # the return of a failure; -inf until returns differed
        self.failed = self.others = 0.0  # episodes before the last update
        self.failed_since = 0  # all episodes since
        self.can_undo = False

    def judge(self, returns: Sequence[float]) -> Literal["learn", "wait", "undo"]:
        """Return what an epoch's returns say: learn from it, or not, or undo the last update, too."""
        lowest, highest, n = min(returns), max(returns), len(returns)
        if lowest == highest == self.failure or highest < self.failure:
            return self._judge_failures(n)
        if lowest == highest and self.failure == -math.inf:
            return "learn"  # nobody knows yet what a failure is
        if lowest < highest and lowest != self.failure:
            self.failure, self.failed, self.others, self.failed_since = lowest, 0, 0, 0
        failed = returns.count(self.failure)
        self.failed = self.KEEP * self.failed + self.failed_since + failed
        self.others = self.KEEP * self.others + n - failed
        self.failed_since, self.can_undo = 0, True
        return "learn"

    def _judge_failures(self, n: int) -> Literal["wait", "undo"]:
        self.failed_since += n
        failed, others = self.failed + self.PRIOR, self.others + self.PRIOR
        # Beta function of (failed + failed_since, others) over that of (failed, others).
        log_p = math.lgamma(failed + self.failed_since) + math.lgamma(failed + others)
        log_p -= math.lgamma(failed + self.failed_since + others) + math.lgamma(failed)
        if not self.can_undo or log_p >= math.log(self.LEVEL):
            return "wait"
        self.failed_since, self.can_undo = 0, False  # these were the undone policy's
        return "undo"

    def state_dict(self) -> dict[str, float]:
        """Return what it has counted."""
        return dict(vars(self))

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Go on counting from what `state_dict` returned."""
        vars(self).update(state)


class Transitions(NamedTuple):
    """Hold what is learned from, as tensors with a leading axis (n, ...)."""

    obs: Tensor
    actions: Tensor
    log_prob: Tensor
    """Log density of the actions when they were taken."""
    advantages: Tensor
    returns: Tensor


class PPO(Learner):
    """Learn by proximal policy optimisation: actor, critic and the batch of the current epoch."""

    policy_parts = ("actor", "gaussian", "obs_stats")
    acting = ("actor", "gaussian", "actor_adam", "std_adam")
    saved = (
        *policy_parts,
        "critic",
        "actor_adam",
        "std_adam",
        "critic_adam",
        "silence",
    )
    plain = (
        "env_steps",
        "epochs",
        "before_update",
        "reward_scale",
        "lowest_reward",
        "highest_reward",
    )

    def build(self, generator: torch.Generator) -> None:
        config: PPOConfig = self.config
        names = self.spaces.inputs()
        self.actor, self.gaussian, self.obs_stats = _policy_parts(
            config, self.spaces, generator
        )
        self.critic = MLP((self._n_obs, *config.hidden, 1), generator, inputs=names)
        if config.orthogonal_init:
            start_orthogonal(self.actor, ACTOR_GAIN, generator, names)
            start_orthogonal(self.critic, 1.0, generator, names)
        for network in (self.actor, self.gaussian, self.critic):
            network.to(self.device)
        self.actor_parameters = [*self.actor.parameters()]
        std_parameters = [*self.gaussian.parameters()]
        self.std_adam = self.adam(std_parameters, config.std_lr or config.actor_lr)
        if config.exploration == "learned":
            self.actor_parameters += std_parameters
        self.critic_parameters = [*self.critic.parameters()]
        self.gaussian.requires_grad_(config.exploration == "learned")
        self.broadcast(self.actor, self.critic)
        self.actor_adam = self.adam([*self.actor.parameters()], config.actor_lr)
        self.critic_adam = self.adam(self.critic_parameters, config.critic_lr)
        self.epochs, self._episodes = 0, list[Episode[Array]]()
        self.silence = Silence()
        self.before_update: dict[str, Any] = {}  # states of `acting`
        self.reward_scale = 0.0 if config.normalize_rewards else 1.0
        self.lowest_reward = self.highest_reward = 0.0  # of all so far, 0 included

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
        """Play whole episodes until `steps_per_epoch` are there: the same ones on all ranks."""
        config = self.config
        if config.anneal_lr:
            self.anneal(self.actor_adam, self.std_adam, self.critic_adam)
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
        """Take `n_passes` over the batch in shuffled minibatches, of which each rank computes a part.

        Actor and critic share nothing that is learned: each has its own loop, and its own thread
        where there are two cores. In a silent epoch, only the critic is updated.
        """
        config, batch = self.config, self._batch()
        n, n_minibatches = len(batch.obs), config.minibatches(len(batch.obs))
        is_silent, undone = (
            self._look_at_returns() if config.undo_silent else (False, 0)
        )
        # The same order on all ranks.
        rng = np.random.default_rng([self.seed, 0, rollout.LEARN, self.epochs])
        sums, n_updates = torch.zeros(4, device=self.device), 0
        with flushed_denormals():
            for _ in range(config.n_passes):
                order = torch.from_numpy(rng.random(n).argsort()).to(self.device)
                minibatches = order.tensor_split(n_minibatches)
                actor_stats, value_losses = self.in_two_threads(
                    partial(
                        self._update_actor, batch, () if is_silent else minibatches
                    ),
                    partial(self._update_critic, batch, minibatches),
                )
                sums += torch.cat([actor_stats.sum(dim=0), value_losses.sum()[None]])
                n_updates += n_minibatches
                if config.target_kl is None or is_silent:
                    continue
                if self._over_ranks(actor_stats[-1])[1] > config.target_kl:
                    break
        means = self._over_ranks(sums / n_updates)
        self.require_finite(means, self.actor, self.gaussian, self.critic)
        self.require_same(*self.actor_parameters, *self.critic_parameters)
        self.require_same(torch.from_numpy(self.obs_stats.mean))
        self.obs_stats.update(np.concatenate([np.stack(e.obs) for e in self._episodes]))
        policy_loss, kl, clipped, value_loss = means
        return {
            "policy_loss": policy_loss,
            "value_loss": value_loss,
            "kl": kl,
            "clip_fraction": clipped,
            "action_std": float(self.gaussian.std().mean()),
            "undone": undone,
            "updates": n_updates,
        }

    def _over_ranks(self, stats: Tensor) -> list[float]:
        """Return the sums over all ranks."""
        sums: list[float] = self.comm.sum(stats.cpu().double().numpy()).tolist()
        return sums

    def _update_actor(
        self, batch: Transitions, minibatches: Sequence[Tensor]
    ) -> Tensor:
        """Take an Adam step on the clipped objective of each minibatch, given as rows of the batch.

        Returns this rank's share of policy loss, KL estimate and clipped fraction, (minibatches, 3).
        """
        stats = [torch.zeros(0, 3, device=self.device)]
        for rows in minibatches:
            mine = rows.tensor_split(self.comm.size)[self.comm.rank]
            mean = self.actor(batch.obs[mine])
            log_ratio = (
                self.gaussian.log_prob(batch.actions[mine], mean) - batch.log_prob[mine]
            )
            result = surrogate(
                log_ratio, batch.advantages[mine], self.config.clip_range
            )
            self.actor_adam.zero_grad()
            self.std_adam.zero_grad()
            loss = result.loss.sum() / len(rows)
            loss.backward()  # type: ignore[no-untyped-call]
            self.sum_gradients(self.actor_parameters)
            nn.utils.clip_grad_norm_(self.actor_parameters, self.config.max_grad_norm)
            self.actor_adam.step()
            self.std_adam.step()
            parts = torch.stack([result.loss.detach(), result.kl, result.is_clipped])
            stats.append(parts.sum(dim=1)[None] / len(rows))
        return torch.cat(stats)

    def _update_critic(
        self, batch: Transitions, minibatches: Sequence[Tensor]
    ) -> Tensor:
        """Take an Adam step on the critic's squared error over each minibatch.

        Returns this rank's share of the value loss, (minibatches,).
        """
        losses = []
        for rows in minibatches:
            mine = rows.tensor_split(self.comm.size)[self.comm.rank]
            values = self.critic(batch.obs[mine]).squeeze(-1)
            loss = (values - batch.returns[mine]).square().sum() / len(rows)
            self.critic_adam.zero_grad()
            loss.backward()
            self.sum_gradients(self.critic_parameters)
            nn.utils.clip_grad_norm_(self.critic_parameters, self.config.max_grad_norm)
            self.critic_adam.step()
            losses.append(loss.detach())
        return torch.stack(losses)

    def _look_at_returns(self) -> tuple[bool, int]:
        """Return whether this epoch says nothing to the actor, and how many updates were undone."""
        # Returns of episodes that the physics cut off say nothing.
        whole = [e for e in self._episodes if not e.faults["diverged"]]
        verdict = (
            self.silence.judge([sum(e.rewards) for e in whole]) if whole else "learn"
        )
        acting = {name: getattr(self, name) for name in self.acting}
        if verdict == "learn" and self.silence.can_undo:
            states = {name: part.state_dict() for name, part in acting.items()}
            self.before_update = copy.deepcopy(states)
        elif verdict == "undo":
            restore(acting, self.before_update)
        return verdict != "learn", int(verdict == "undo")

    @torch.no_grad()
    def _batch(self) -> Transitions:
        """Return the epoch as tensors, with advantages and returns."""
        config, episodes = self.config, self._episodes
        self._update_reward_scale()
        scale = self.reward_scale or 1.0
        views = [obs for episode in episodes for obs in episode.obs]
        all_obs = FlatInputs(self.obs_stats.scaling()).stack(views).to(self.device)
        all_values = self.critic(all_obs).squeeze(-1).cpu().double().numpy()
        # An episode has one more observation than transitions: the last, after which nothing is done.
        is_last = np.concatenate([[False] * len(e) + [True] for e in episodes])
        by_episode = np.split(all_values, np.flatnonzero(is_last)[:-1] + 1)
        # No value of a last observation is ever learned. Where it is like no other, as with time in
        # the observation, the critic extrapolates, and returns would grow from epoch to epoch.
        lowest, highest = all_values[~is_last].min(), all_values[~is_last].max()
        advantages = []
        for episode, values in zip(episodes, by_episode, strict=True):
            goes_on = self._goes_on(episode)
            last_value = np.clip(values[-1], lowest, highest) if goes_on else 0.0
            rewards = np.array(episode.rewards) / scale
            advantages.append(
                gae(rewards, values[:-1], last_value, config.gamma, config.gae_lambda)
            )
        self._warn_of_divergence(all_values * scale)
        advantage = np.concatenate(advantages)
        returns = finite(advantage + all_values[~is_last], "a return")
        obs = all_obs[torch.from_numpy(~is_last).to(self.device)]
        taken = np.concatenate([np.stack(episode.actions) for episode in episodes])
        actions, normalized, target = (
            torch.from_numpy(values.astype(np.float32)).to(self.device)
            for values in (taken, normalize(advantage), returns)
        )
        # Of the actor that played; where it is then undone, this epoch does not update it.
        log_prob = self.gaussian.log_prob(actions, self.actor(obs))
        return Transitions(obs, actions, log_prob, normalized, target)

    def _update_reward_scale(self) -> None:
        """Raise the scale of rewards to the largest return so far; it is 0 before the first reward.

        The critic's last layer shrinks as it grows, so that values in the environment's unit stay
        (PopArt, van Hasselt et al. 2016).
        """
        if not self.config.normalize_rewards:
            return
        gamma = self.config.gamma
        largest = max(largest_return(e.rewards, gamma) for e in self._episodes)
        if largest > self.reward_scale:
            self.critic.scale_outputs((self.reward_scale / largest) or 1.0)
            self.reward_scale = largest

    def _warn_of_divergence(self, values: Array) -> None:
        """Warn where the critic's values (n,) are beyond any return of the rewards seen so far."""
        rewards = [reward for episode in self._episodes for reward in episode.rewards]
        self.lowest_reward = min(self.lowest_reward, *rewards)
        self.highest_reward = max(self.highest_reward, *rewards)
        # A return is at most the largest reward, divided by this.
        one_minus_gamma = 1.0 - self.config.gamma
        if one_minus_gamma == 0.0:
            return
        low, high = (
            self.lowest_reward / one_minus_gamma,
            self.highest_reward / one_minus_gamma,
        )
        margin = high - low  # what a critic may be off by without having diverged
        if values.min() < low - margin or values.max() > high + margin:
            self.warn_once(
                "values",
                f"the critic's values reach from {values.min():.3g} to {values.max():.3g}, but "
                f"returns of the rewards seen lie between {low:.3g} and {high:.3g}: it has diverged",
            )

    def _goes_on(self, episode: Episode[Array]) -> bool:
        """Return whether more would have followed an episode's last transition.

        Nor is it an end where the physics diverged and cut the episode off.
        """
        is_bootstrapped = (
            self.config.truncation == "bootstrap" and not episode.terminated
        )
        return bool(episode.faults["diverged"]) or is_bootstrapped

    # -- saving ------------------------------------------------------------------------------

    @staticmethod
    def saved_policy(
        config: PPOConfig, spaces: Spaces, saved: dict[str, Any]
    ) -> Policy:
        parts = _policy_parts(config, spaces, torch.Generator())
        restore(dict(zip(PPO.policy_parts, parts, strict=True)), saved)
        return _policy(config, spaces, *parts)


def _policy_parts(
    config: PPOConfig, spaces: Spaces, generator: torch.Generator
) -> tuple[MLP, Gaussian, Normalizer]:
    """Return what a policy is made of, before anything was learned; the same on all ranks."""
    actor = new_actor(config.hidden, spaces, generator)
    gaussian = Gaussian(action_size(spaces.action), config.action_variance)
    # Episodes are the same on all ranks, so their moments need no message.
    stats = input_stats(
        spaces.observation,
        Communicator(),
        OBS_CLIP,
        config.normalize_obs,
        config.taxel_scale,
    )
    return actor, gaussian, stats


def _policy(
    config: PPOConfig,
    spaces: Spaces,
    actor: MLP,
    gaussian: Gaussian,
    stats: Normalizer,
) -> Policy:
    explore = partial(gaussian_noise, std=gaussian.std())
    return Policy(on_cpu(actor), FlatInputs(stats.scaling()), explore, spaces)
