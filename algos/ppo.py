"""Proximal policy optimisation (Schulman et al. 2017), as the paper that we reproduce uses it.

Read from top to bottom: hyperparameters, equations, the judge of silent epochs, the
learner (its common part is in `learner`). What that paper leaves open is as in
PPO-for-Beginners (Yu 2023), its code: whole episodes, GAE with returns = advantage +
value, advantages normalized over the batch, an Adam for each network. There is no
entropy bonus, no clipping of values and no weight of the value loss.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from scipy.special import betaln
from torch import Tensor, nn

from . import Array, Communicator, Count, Fraction, Positive32, rollout
from .learner import Counts, Learner, LearnerConfig, RewardScale, restore, states
from .networks import MLP, flushed_denormals, start_orthogonal
from .normalizer import MIN_STD, Scaling
from .policy import (
    FlatInputs,
    Policy,
    Spaces,
    TaxelScale,
    action_size,
    finite,
    input_stats,
    new_actor,
    on_cpu,
)
from .rollout import Episode, discounted, largest_return, summary, usable

ACTOR_GAIN = 0.01  # of the last layer when weights start orthogonal
OBS_CLIP = 5.0  # scaled observations are cut there, as DDPG+HER's are
N_TESTS = 20  # episodes of a test
MAX_LOG_RATIO = 20.0  # exp(20) = 5e8: far outside any clip range, far inside float32


@dataclass(frozen=True)
class PPOConfig(LearnerConfig):
    """Hyperparameters; defaults are the paper's (Methods, PyBullet set-up) unless noted."""

    hidden: tuple[Count, ...] = (256, 256, 256)
    """Units of each hidden layer, actor and critic alike."""
    actor_lr: Positive32 = 3e-4
    """Learning rate of the actor (Adam)."""
    critic_lr: Positive32 = 1e-3
    """Learning rate of the critic (Adam)."""
    action_variance: Positive32 = 0.05
    """Variance of the Gaussian policy in every action dimension, in units where the
    bounds are ±1."""
    gamma: Fraction = 0.99
    """Discount factor."""
    gae_lambda: Fraction = 0.97
    """Lambda of generalised advantage estimation."""
    clip_range: Positive32 = 0.2
    """Clip range of the probability ratio."""
    steps_per_epoch: Count = 1000
    """Minimum number of environment steps per epoch; episodes are played to
    their end. (Stable-Baselines3: n_steps.)"""
    n_passes: Count = 80
    """Passes over the batch per epoch (paper: updates per epoch; Stable-Baselines3:
    n_epochs)."""
    n_minibatches: Count | None = None
    """Minibatches per pass; default: 6, unless --minibatch-size is given. The paper
    says "minibatch size: 6"; in its code, 6 is their number."""
    minibatch_size: Count | None = None
    """Minimum number of transitions per minibatch, instead of --n-minibatches; the
    batch is split evenly. (Stable-Baselines3: batch_size.)"""
    max_grad_norm: Positive32 = 0.5
    """Largest norm of the gradient, clipped separately for actor and critic."""
    exploration: Literal["fixed", "learned"] = "fixed"
    """Variance of the policy. fixed: --action-variance; learned: one per action
    dimension, starting there."""
    noise_correlation: Fraction = 0.0
    """Correlation of exploration noise between successive steps. Noise that lasts gets
    further: a hand that closes in steps closes now and then, where independent noise
    only trembles."""
    std_lr: Positive32 | None = None
    """Learning rate of a learned variance (Adam); default: the actor's."""
    orthogonal_init: bool = False
    """Orthogonal initial weights, with an actor whose last layer is near zero;
    otherwise they are uniform in ±1/sqrt(inputs)."""
    normalize_obs: bool = False
    """Normalize observations with the mean and standard deviation of all earlier
    epochs, clipped to ±5; in the first epoch, which has none, they are only clipped.
    Entries between 0 and 1, such as Boolean taxels, follow --taxel-scale instead."""
    min_std: Positive32 = MIN_STD
    """Smallest standard deviation that an observation is divided by, in its own unit;
    for entries between 0 and 1, such as Boolean taxels, it is 0.01. With --min-std 1,
    what varies less stays small, such as the noise of a joint that stands still; with a
    small one, it is scaled up until it counts as much as what matters."""
    taxel_scale: TaxelScale = "none"
    """Scale of entries between 0 and 1, such as Boolean taxels. none: as they are;
    block: one gain for all, so that together they count as much as 24 normalized
    inputs, however many they are; each: every one normalized by itself."""
    normalize_rewards: bool = False
    """Divide rewards by a running scale, so that the largest return so far counts as 1.
    The critic's learning rate then means the same, whatever unit rewards have."""
    truncation: Literal["bootstrap", "terminal"] = "bootstrap"
    """Treatment of a time limit. bootstrap: the return continues with the critic's
    value of the last observation, cut to the range of its other values; terminal: the
    return ends. In the paper's task a time-out terminates the episode, with -100, so
    both are the same."""
    anneal_lr: bool = False
    """Decay all learning rates to zero, linearly over the run (in the paper's code, not
    its text)."""
    target_kl: Positive32 | None = None
    """End an epoch's passes, the critic's too, after one whose last minibatch has a
    larger KL divergence from the old policy (in the paper's code, not in its text)."""
    test_interval: Count | None = None
    """Epochs from one test to the next, each of 20 episodes without exploration noise;
    default: no tests."""
    undo_silent: bool = False
    """Do not update the actor from epochs in which every episode fails; where chance no
    longer explains so many failures, undo what it learned from the epoch before them. A
    policy that meets no reward would otherwise learn from noise. What a failure is
    shows once episodes differ; until then, every epoch is learned from."""

    def validate(self) -> None:
        """Raise ValueError naming what does not go together; ranges are in the types."""
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

    `values` (n,) are the critic's at each step, `last_value` the one after the last
    step: 0 where nothing follows.
    """
    next_values = np.append(values[1:], last_value)
    deltas = (rewards + gamma * next_values - values).tolist()
    # Backwards in time: A[t] = delta[t] + gamma lambda A[t + 1].
    return np.array(discounted(deltas, gamma * lam))


def normalize(advantages: Array) -> Array:
    """Return advantages (n,) with mean 0 and standard deviation 1; zeros where all are alike."""
    centred = advantages - advantages.mean()
    std = np.sqrt(np.square(centred).mean())
    if std <= 1e-10 * np.abs(advantages).max():
        return np.zeros_like(centred)
    return centred / std


def explained_variance(values: Tensor, returns: Tensor) -> float:
    """Return the share of the variance of returns (n,) that values (n,) tell; 0 where there is none."""
    variance = returns.var(unbiased=False)
    unexplained = (returns - values).var(unbiased=False)
    return float(1.0 - unexplained / variance) if variance > 0 else 0.0


class Gaussian(nn.Module):
    """Give actions independent normal noise, in units where the bounds are ±1.

    Its standard deviations are sqrt(variance) · exp(log_std), so `log_std` is relative
    to the first.
    """

    def __init__(self, n_actions: int, variance: float) -> None:
        super().__init__()
        self.variance, self.log_std = variance, nn.Parameter(torch.zeros(n_actions))

    def std(self) -> Array:
        """Return the standard deviation of each action, float32 (d,)."""
        relative: Array = self.log_std.detach().cpu().exp().numpy()
        return np.float32(self.variance**0.5) * relative

    def entropy(self) -> float:
        """Return the differential entropy, nats, where bounds are ±1."""
        each = 0.5 * math.log(2 * math.pi * math.e * self.variance) + self.log_std
        return each.sum().item()

    def log_prob(self, actions: Tensor, mean: Tensor) -> Tensor:
        """Return the log density (n,) of actions (n, d)."""
        residual = (actions - mean) / self.log_std.exp()
        constant = mean.shape[-1] * math.log(2 * math.pi * self.variance)
        squared = residual.square().sum(dim=-1) / self.variance
        return -0.5 * (squared + constant) - self.log_std.sum()


class GaussianNoise:
    """Add normal noise to the actions of one episode, which may last over steps.

    Each action alone is distributed as without `correlation`, and is learned from as if
    it stood alone (Hollenstein, Martius & Piater 2024).
    """

    def __init__(
        self, rng: np.random.Generator, std: Array, correlation: Any = 0.0
    ) -> None:
        """Take standard deviations (d,) or (n, d), and correlations between successive steps."""
        self.rng, self.std, self.correlation = rng, std, np.float32(correlation)
        self._noise: Array | None = None

    def __call__(self, actions: Array) -> Array:
        """Return noisy copies of actions (n, d); n is the same in every call."""
        drawn = self.rng.standard_normal(actions.shape, dtype=np.float32)
        if self._noise is not None:
            new = np.sqrt(1 - self.correlation**2)
            drawn = self.correlation * self._noise + new * drawn
        self._noise = drawn
        return actions + self.std * drawn


class Surrogate(NamedTuple):
    """Hold the negated clipped objective of each transition (n,), and figures to watch it by."""

    loss: Tensor
    kl: Tensor
    """Estimate of the KL divergence from the old policy, ratio - 1 - log(ratio):
    Schulman's k3."""
    is_clipped: Tensor
    """True where the ratio is outside the clip range."""


def surrogate(log_ratio: Tensor, advantages: Tensor, clip_range: Any) -> Surrogate:
    """Return the clipped objective from log ratios and advantages (n,) (Schulman et al. 2017, eq. 7).

    For the ratio, log ratios are cut at ±20, so that nothing overflows. That is far
    outside any clip range; what lies beyond has no gradient.
    """
    ratio = log_ratio.clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO).exp()
    clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
    loss = -torch.minimum(ratio * advantages, clipped * advantages)
    return Surrogate(loss, (ratio - 1 - log_ratio).detach(), clipped != ratio)


class ActorLoss(NamedTuple):
    """Hold means over a minibatch, ()."""

    policy_loss: Tensor
    kl: Tensor
    clip_fraction: Tensor


Verdict = Literal["learn", "wait", "undo"]
"""What becomes of the actor: it is updated; it stays; it goes back to before its last
update."""


class Silence(Counts):
    """Judge a silent epoch, in which every episode fails: is the actor's last update to blame?

    - Some episode did not fail: learn.
    - All failed, as chance may have it: wait. The critic learns, the actor does not.
    - All failed, in so many episodes since the last update that the policy before it would have done so
      with a probability below `LEVEL`: undo. Nothing more is undone until there is another update.

    A failure has the lowest return of the last epoch that was learned from and in which
    returns differed. All failed where all returns are that one, or all are below it.
    The policy before the update is known by its failures and its other episodes, which
    fade by `KEEP` from one update to the next: they speak of the last five or so. Its
    success rate is what they leave uncertain (Beta distribution, Jeffreys' prior). Of
    updates that change nothing, about one in fifty is undone.
    """

    LEVEL, KEEP, PRIOR = 0.02, 0.8, 0.5

    def __init__(self) -> None:
        self.failure = -math.inf  # the return of a failure; -inf until returns differed
        self.failed = self.others = 0.0  # episodes before the last update
        self.failed_since = 0  # episodes since, all of them failures
        self.can_undo = False

    def judge(self, returns: Sequence[float]) -> Verdict:
        """Return what an epoch's returns say; one at least."""
        lowest, highest, n = min(returns), max(returns), len(returns)
        if highest < self.failure or lowest == highest == self.failure:
            return self._judge_failures(n)
        if lowest == highest and self.failure == -math.inf:
            return "learn"  # nobody knows yet what a failure is
        if lowest < highest and lowest != self.failure:
            # Another return is a failure now, so counts begin anew. Where rewards are
            # dense, that is in nearly every epoch, and all that is undone are updates
            # after which every return is below the lowest of before.
            self.failure, self.failed, self.others, self.failed_since = lowest, 0, 0, 0
        failed = returns.count(self.failure)
        self.failed = self.KEEP * self.failed + self.failed_since + failed
        self.others = self.KEEP * self.others + n - failed
        # The update that follows is the last.
        self.failed_since, self.can_undo = 0, True
        return "learn"

    def _judge_failures(self, n: int) -> Verdict:
        """Return whether to undo after `n` failures more."""
        self.failed_since += n
        failed, others = self.failed + self.PRIOR, self.others + self.PRIOR
        log_p = betaln(failed + self.failed_since, others) - betaln(failed, others)
        if not self.can_undo or log_p >= math.log(self.LEVEL):
            return "wait"
        self.failed_since, self.can_undo = 0, False  # these were the undone policy's
        return "undo"


class Transitions(NamedTuple):
    """Hold what is learned from, as tensors with a leading axis (n, ...)."""

    obs: Tensor
    actions: Tensor
    log_prob: Tensor
    """Log density of the actions, which are not clipped, by the actor that took
    them."""
    advantages: Tensor
    returns: Tensor
    values: Tensor
    """Values of the critic before it learned from these."""


class PPO(Learner):
    """Learn by proximal policy optimisation, from the whole episodes of one epoch after another.

    An epoch is `collect` and `update`. Learners of many runs at once (`batch`) play and
    step the networks themselves; they call `begin`, `wants_more`, `keep`, `prepare` and
    `after_update`.
    """

    policy_parts = ("actor", "gaussian", "obs_stats")
    saved = (
        *policy_parts,
        "critic",
        "actor_adam",
        "std_adam",
        "critic_adam",
        "silence",
        "reward_scale",
    )
    plain = ("env_steps", "epochs", "before_update")

    def build(self, generator: torch.Generator) -> None:
        config: PPOConfig = self.config
        if self.comm.size > 1:
            raise ValueError(
                f"ranks: found {self.comm.size} with ppo, allowed 1; without mpirun, --workers plays "
                "on many cores"
            )
        parts = self.new_parts(config, self.spaces, self.comm, generator)
        self.actor, self.gaussian, self.obs_stats = parts.values()
        self.critic = MLP((self.n_inputs, *config.hidden, 1), generator)
        if config.orthogonal_init:
            start_orthogonal(self.actor, ACTOR_GAIN, generator)
            start_orthogonal(self.critic, 1.0, generator)
        for network in (self.actor, self.gaussian, self.critic):
            network.to(self.device)
        self.gaussian.requires_grad_(config.exploration == "learned")
        stds, std_lr = [*self.gaussian.parameters()], config.std_lr or config.actor_lr
        self.actor_adam = self.adam([*self.actor.parameters()], config.actor_lr)
        self.std_adam = self.adam(stds, std_lr)
        self.critic_adam = self.adam([*self.critic.parameters()], config.critic_lr)
        self.epochs, self.episodes = 0, list[Episode]()
        self.n_tests = N_TESTS if config.test_interval else 0
        self.silence = Silence()
        self.before_update: dict[str, Any] = {}  # states of `undoable`, by name
        self.reward_scale = RewardScale(config.normalize_rewards)

    def describe(self) -> str:
        config = self.config
        n, passes = config.minibatches(config.steps_per_epoch), config.n_passes
        return (
            f"{n} minibatches of about {config.steps_per_epoch // n} transitions, {passes} passes: "
            f"{n * passes} updates of actor and critic per epoch"
        )

    # -- acting and collecting ---------------------------------------------------------------

    def collect(self) -> dict[str, float]:
        """Play whole episodes until `steps_per_epoch` are there."""
        self.begin()
        player, episodes = self.player(rollout.TRAIN), list[Episode]()
        for episode in self.workers.play(player, itertools.count()):
            episodes.append(episode)
            if not self.wants_more(episodes):
                break
        return self.keep(episodes)

    def key(self, purpose: int) -> rollout.Key:
        """Return the key of random numbers for one of the purposes in `rollout`.

        It counts the epochs that were played, so one epoch's LEARN is one above its
        TRAIN.
        """
        return self.seed, self.comm.rank, purpose, self.epochs

    @property
    def is_tested(self) -> bool:
        interval = self.config.test_interval
        return interval is not None and self.epochs % interval == 0

    def begin(self) -> None:
        """Begin an epoch: anneal learning rates."""
        if self.config.anneal_lr:
            self.anneal(self.actor_adam, self.std_adam, self.critic_adam)

    def wants_more(self, episodes: list[Episode]) -> bool:
        """Return whether an epoch has too few steps."""
        return sum(map(len, usable(episodes))) < self.config.steps_per_epoch

    def keep(self, episodes: list[Episode]) -> dict[str, float]:
        """Keep the epoch's episodes to learn from; return counts and means."""
        self.episodes = usable(episodes)
        self.epochs += 1
        stats = summary(episodes)
        self.env_steps += int(stats.pop("steps"))
        return stats

    # -- learning ----------------------------------------------------------------------------

    def update(self) -> dict[str, float]:
        """Take `n_passes` over the batch in shuffled minibatches.

        Actor and critic share nothing that is learned: in each pass, each has its own
        loop, and its own thread where there are two cores. They meet after it, where
        `target_kl` may end the passes. In a silent epoch, only the critic is updated.
        """
        config = self.config
        batch, verdict = self.prepare()
        learns = verdict == "learn"
        actor_losses, value_losses = list[ActorLoss](), list[Tensor]()
        with flushed_denormals():
            for minibatches in self.passes(len(batch.obs)):
                for_actor = minibatches if learns else ()
                of_actor, of_critic = self.in_two_threads(
                    partial(self._update_actor, batch, for_actor),
                    partial(self._update_critic, batch, minibatches),
                )
                actor_losses += of_actor
                value_losses += of_critic
                limit = config.target_kl if learns else None
                if limit and of_actor[-1].kl.item() > limit:
                    break
        actor_losses = actor_losses or [ActorLoss(*torch.zeros(3))]  # in a silent epoch
        policy_loss, kl, clip_fraction = (
            torch.stack(each).mean().item() for each in zip(*actor_losses, strict=True)
        )
        figures = {
            "policy_loss": policy_loss,
            "value_loss": torch.stack(value_losses).mean().item(),
            "kl": kl,
            "clip_fraction": clip_fraction,
        }
        self.check_learned([*figures.values()], self.actor, self.gaussian, self.critic)
        return figures | self.after_update(batch, verdict, len(value_losses))

    def prepare(self) -> tuple[Transitions, Verdict]:
        """Return what to learn from, and what becomes of the actor, whose last update may be undone."""
        # The unit of rewards is the largest return; as it grows, the critic's outputs
        # shrink.
        returns = (largest_return(e.rewards, self.config.gamma) for e in self.episodes)
        self.critic.scale_outputs(self.reward_scale.grow(max(returns)))
        batch = self._batch()
        verdict = self._judge()
        if verdict == "undo":
            restore(self.undoable, self.before_update)
        elif self.config.undo_silent and verdict == "learn":
            self.before_update = states(self.undoable)
        return batch, verdict

    def _judge(self) -> Verdict:
        """Return what the returns say; those of episodes that the physics cut off say nothing."""
        if not self.config.undo_silent:
            return "learn"
        whole = [e for e in self.episodes if not e.faults["diverged"]]
        return self.silence.judge([sum(e.rewards) for e in whole]) if whole else "wait"

    def passes(self, n: int) -> Iterator[Sequence[Tensor]]:
        """Yield for each pass over a batch of `n` transitions the rows of its minibatches."""
        rng = np.random.default_rng(self.key(rollout.LEARN))
        for _ in range(self.config.n_passes):
            order = torch.from_numpy(rng.random(n).argsort()).to(self.device)
            yield order.tensor_split(self.config.minibatches(n))

    def after_update(
        self, batch: Transitions, verdict: Verdict, n_updates: int
    ) -> dict[str, float]:
        """Take the epoch's observations into the moments, for the next; return its other metrics."""
        self.obs_stats.update(np.concatenate([np.stack(e.obs) for e in self.episodes]))
        return {
            "explained_variance": explained_variance(batch.values, batch.returns),
            "entropy": self.gaussian.entropy(),
            "action_std": float(self.gaussian.std().mean()),
            "undone": int(verdict == "undo"),
            "updates": n_updates,
        }

    def _update_actor(
        self, batch: Transitions, minibatches: Sequence[Tensor]
    ) -> list[ActorLoss]:
        """Take an Adam step on the clipped objective of each minibatch, given as rows of the batch."""
        losses = []
        parameters = [*self.actor.parameters(), *self.gaussian.parameters()]
        for rows in minibatches:
            log_prob = self.gaussian.log_prob(
                batch.actions[rows], self.actor(batch.obs[rows])
            )
            result = surrogate(
                log_prob - batch.log_prob[rows],
                batch.advantages[rows],
                self.config.clip_range,
            )
            loss = result.loss.mean()
            self.actor_adam.zero_grad()
            self.std_adam.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(parameters, self.config.max_grad_norm)
            self.actor_adam.step()
            self.std_adam.step()  # without effect where the variance is fixed
            clipped = result.is_clipped.float().mean()
            losses.append(ActorLoss(loss.detach(), result.kl.mean(), clipped))
        return losses

    def _update_critic(
        self, batch: Transitions, minibatches: Sequence[Tensor]
    ) -> list[Tensor]:
        """Take an Adam step on the critic's squared error over each minibatch; return the errors."""
        losses, parameters = [], [*self.critic.parameters()]
        for rows in minibatches:
            values = self.critic(batch.obs[rows]).squeeze(-1)
            loss = (values - batch.returns[rows]).square().mean()
            self.critic_adam.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(parameters, self.config.max_grad_norm)
            self.critic_adam.step()
            losses.append(loss.detach())
        return losses

    @property
    def undoable(self) -> dict[str, Any]:
        """Parts of the learner, by name, that an undone update puts back."""
        names = "actor", "gaussian", "actor_adam", "std_adam"
        return {name: getattr(self, name) for name in names}

    @torch.no_grad()
    def _batch(self) -> Transitions:
        """Return the epoch as tensors, with advantages and returns."""
        inputs = FlatInputs(self.scaling())
        # An episode has one more observation than transitions: the last, after which
        # nothing is done.
        obs = [inputs.stack(e.obs).to(self.device) for e in self.episodes]
        # By episode, or at once on a GPU, which waits for every answer.
        stacks = obs if self.device.type == "cpu" else [torch.cat(obs)]
        found = [self.critic(seen).squeeze(-1).cpu().double() for seen in stacks]
        values = np.split(torch.cat(found).numpy(), np.cumsum([*map(len, obs)])[:-1])
        acted_on = torch.cat([seen[:-1] for seen in obs])
        taken = np.concatenate([np.stack(e.actions) for e in self.episodes])
        columns = (taken, *self._targets(values))
        actions, advantages, returns, predicted = (
            torch.from_numpy(column.astype(np.float32)).to(self.device)
            for column in columns
        )
        log_prob = self.gaussian.log_prob(actions, self.actor(acted_on))
        return Transitions(acted_on, actions, log_prob, advantages, returns, predicted)

    def _targets(self, values: Sequence[Array]) -> tuple[Array, Array, Array]:
        """Return normalized advantages, returns and values (n,) of the epoch's transitions.

        `values` are the critic's of each episode's observations, (length + 1,).
        """
        config, advantages = self.config, list[Array]()
        predicted = np.concatenate([each[:-1] for each in values])
        # Not in the paper's code: the critic is never fitted to a last observation, so
        # its value there is cut to the range of the others. Uncut, and with time in the
        # observation, returns would grow from epoch to epoch.
        lowest, highest = predicted.min(), predicted.max()
        for episode, each in zip(self.episodes, values, strict=True):
            # The return continues at a time limit, and always where physics diverged.
            is_cut_off = config.truncation == "bootstrap" and not episode.terminated
            bootstraps = is_cut_off or episode.faults["diverged"]
            last_value = np.clip(each[-1], lowest, highest) if bootstraps else 0.0
            rewards = np.array(episode.rewards) / self.reward_scale.unit
            advantages.append(
                gae(rewards, each[:-1], last_value, config.gamma, config.gae_lambda)
            )
        advantage = np.concatenate(advantages)
        returns = finite(advantage + predicted, "a return")
        return normalize(advantage), returns, predicted

    # -- the policy --------------------------------------------------------------------------

    def scaling(self) -> Scaling:
        """Return what the networks' inputs are scaled by now."""
        return self.obs_stats.scaling()

    @staticmethod
    def new_parts(
        config: PPOConfig,
        spaces: Spaces,
        comm: Communicator,
        generator: torch.Generator,
    ) -> dict[str, Any]:
        actor = new_actor(config.hidden, spaces, generator)
        gaussian = Gaussian(action_size(spaces.action), config.action_variance)
        stats = input_stats(
            spaces.observation,
            comm,
            OBS_CLIP,
            config.normalize_obs,
            config.taxel_scale,
            config.min_std,
        )
        return {"actor": actor, "gaussian": gaussian, "obs_stats": stats}

    @staticmethod
    def as_policy(config: PPOConfig, spaces: Spaces, *parts: Any) -> Policy:
        actor, gaussian, stats = parts
        explore = partial(
            GaussianNoise, std=gaussian.std(), correlation=config.noise_correlation
        )
        return Policy(on_cpu(actor), FlatInputs(stats.scaling()), explore, spaces)
