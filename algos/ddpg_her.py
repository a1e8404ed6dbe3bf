"""Deep deterministic policy gradient (Lillicrap et al. 2016) with hindsight experience replay.

Read from top to bottom: the choices, what it computes, the learner. The order of operations is OpenAI
baselines' (baselines/her), which the paper used through Melnik et al. 2021: an epoch is `n_cycles`
times {episodes, normaliser, `n_batches` updates, one or more moves of the target networks}, then test
episodes without noise.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
import torch
from torch import Tensor

from . import Array, Count, Fraction, NotNegative, Positive32, rollout
from .learner import Learner, restore
from .mpi import Communicator
from .networks import MLP, FlatAdam, flatten, require_hidden
from .normalizer import Normalizer, Scaling
from .policy import Policy, flat_stats, new_actor, on_cpu
from .replay import Batch, GoalObs, Replay
from .rollout import PlayEpisode, discounted, play_episodes, summary
from .spaces import PRIVILEGED, Spaces, action_size, flat_size, goal_size, n_boolean

CHECK_EVERY = (
    100  # updates between two looks at whether the ranks' parameters are equal
)
REPLAY_P = 0.8  # paper


@dataclass(frozen=True)
class DDPGHERConfig:
    """Hyperparameters; defaults are the paper's (Methods, MuJoCo set-up) unless noted."""

    hidden: tuple[int, ...] = (256, 256, 256)
    """Units of each hidden layer, actor and critic alike."""
    actor_lr: Positive32 = 1e-3
    """Learning rate of the actor (Adam)."""
    critic_lr: Positive32 = 1e-3
    """Learning rate of the critic (Adam)."""
    buffer_size: Count = 1_000_000
    """Transitions in the replay buffer of each process."""
    anneal_lr: bool = False
    """Decay both learning rates linearly to zero over the run."""
    anneal_noise: bool = False
    """Decay --noise-eps and --random-eps linearly to zero over the run."""
    anneal_action_l2: bool = False
    """Decay --action-l2 linearly to zero over the run."""
    polyak: Fraction = 0.95
    """Weight of the old target network when it moves; tau elsewhere is 1 - polyak."""
    target_update_interval: Count | None = None
    """Updates between two moves of the target networks, which move at the end of a cycle at the latest;
    default: one move per cycle (source)."""
    gamma: Annotated[float, "[0, 1)"] | None = None
    """Discount factor; default: 1 - 1/T, where T is the length of an episode (source)."""
    action_l2: NotNegative = 1.0
    """Weight of the mean squared action in the actor's loss."""
    clip_obs: Positive32 = 200.0
    """Bound on observations and goals before they are normalised."""
    norm_clip: Positive32 = 5.0
    """Bound on observations and goals after they are normalised."""
    batch_size: Count = 256
    """Transitions per update, in each process."""
    n_rollouts: Count = 2
    """Episodes per cycle, in each process."""
    n_cycles: Count = 50
    """Cycles per epoch."""
    n_batches: Count = 40
    """Updates per cycle."""
    n_test_rollouts: Annotated[int, "[0, inf)"] = 10
    """Test episodes per epoch, in each process, as a multiple of --n-rollouts."""
    random_eps: Fraction = 0.3
    """Probability of a uniformly random action."""
    noise_eps: NotNegative = 0.2
    """Standard deviation of the noise on other actions, relative to half the action range."""
    replay_p: Fraction | None = None
    """Probability that a sampled transition is relabelled (HER); default: 0.8 (paper), or 0 if the task
    has a single goal."""
    reduction: Literal["sum", "mean"] = "sum"
    """How the gradients of several processes are combined (source: sum)."""
    clip_target: bool = True
    """Clip value targets to the range of possible returns: from -1/(1 - gamma) to 0 (source), wider
    once rewards below -1 or above 0 are seen. With --normalise-rewards it follows all rewards."""
    termination: Literal["bootstrap", "terminal"] = "bootstrap"
    """How the end of an episode by termination is treated. bootstrap: the target network's value
    is added, since the source has no done mask; terminal: it is not."""
    normalise_rewards: bool = False
    """Divide rewards by a running scale, so that the largest return so far counts as much as that of a
    reward of 1 in every step. Whatever unit rewards have, --action-l2 and the learning rates then mean
    the same; rewards of -1 and 0 stay as they are."""

    @property
    def anneals(self) -> bool:
        """Does the course of a run depend on how long it will be?"""
        return self.anneal_lr or self.anneal_noise or self.anneal_action_l2

    def acting(self, remaining: float) -> DDPGHERConfig:
        """With the noise of the moment at which that fraction of the run is left."""
        left = remaining if self.anneal_noise else 1.0
        return dataclasses.replace(
            self, noise_eps=left * self.noise_eps, random_eps=left * self.random_eps
        )

    def validate(self) -> None:
        """Raise ValueError naming what does not go together; ranges are in the types."""
        require_hidden(self.hidden)


def td_targets(
    rewards: Tensor,
    next_values: Tensor,
    terminal: Tensor,
    gamma: float,
    span: tuple[float, float] | None,
) -> Tensor:
    """What the critic should say (n,): r + gamma Q'(next), of arguments (n,).

    `terminal` is 1 where nothing follows. Values are cut to the returns that rewards in `span` can
    make (Andrychowicz et al. 2017, appendix A).
    """
    values = rewards + gamma * (1.0 - terminal) * next_values
    return (
        values.clamp(*(reward / (1.0 - gamma) for reward in span)) if span else values
    )


def largest_return(rewards: Sequence[float], gamma: float) -> float:
    """The largest discounted return, without its sign, from any step of an episode to its end."""
    return max([0.0, *map(abs, discounted(rewards, gamma))])


def explore(
    actions: Array, rng: np.random.Generator, noise_eps: float, random_eps: float
) -> Array:
    """Noisy copies of actions (n, d) in [-1, 1]; whole rows are random with `random_eps`."""
    noisy = actions + np.float32(noise_eps) * rng.standard_normal(
        actions.shape, dtype=np.float32
    )
    noisy = np.clip(noisy, -1.0, 1.0)
    is_random = rng.random(actions.shape[:-1])[..., None] < random_eps
    return np.where(
        is_random, rng.uniform(-1.0, 1.0, actions.shape).astype(np.float32), noisy
    )


@dataclass(frozen=True)
class GoalInputs:
    """The actor's input: observation and goal, cut and normalised."""

    obs_scaling: Scaling
    goal_scaling: Scaling
    limit: float

    def read(self, obs: Any) -> GoalObs:
        whole = {
            "achieved_goal": obs["desired_goal"],
            **obs,
        }  # a network sees no achieved goal
        return GoalObs(
            *(np.array(whole[key], np.float32).ravel() for key in GoalObs._fields)
        )

    def stack(self, views: Sequence[GoalObs]) -> Tensor:
        obs, _, goals = (
            torch.from_numpy(np.stack(part)) for part in zip(*views, strict=True)
        )
        return self(obs, goals)

    def __call__(self, obs: Tensor, goals: Tensor) -> Tensor:
        """Of observations (n, obs) and goals (n, goal): (n, obs + goal)."""
        parts = (self.obs_scaling, obs), (self.goal_scaling, goals)
        return torch.cat(
            [scale(part.clamp(-self.limit, self.limit)) for scale, part in parts], dim=1
        )


def _stats(
    config: DDPGHERConfig, spaces: Spaces, comm: Communicator
) -> list[Normalizer]:
    """Moments of observations and of goals, before anything was seen."""
    n_goal, n_obs = goal_size(spaces.observation), flat_size(spaces.observation)
    return [Normalizer(n, comm, config.norm_clip) for n in (n_obs - n_goal, n_goal)]


def _policy(
    config: DDPGHERConfig,
    spaces: Spaces,
    actor: MLP,
    obs_stats: Normalizer,
    goal_stats: Normalizer,
) -> Policy:
    noise = partial(explore, noise_eps=config.noise_eps, random_eps=config.random_eps)
    inputs = GoalInputs(obs_stats.scaling(), goal_stats.scaling(), config.clip_obs)
    return Policy(on_cpu(actor), inputs, noise, spaces)


class DDPGHER(Learner):
    """Actor, critic, their targets and the replay; the interface is `Learner`'s."""

    replay: Replay
    policy_parts = ("actor", "obs_stats", "goal_stats")
    saved = (
        *policy_parts,
        "critic",
        "target_actor",
        "target_critic",
        "adam",
        "privileged_stats",
    )
    counters = ("env_steps", "updates", "cycles", "worst", "best", "reward_scale")

    def build(self, generator: torch.Generator) -> None:
        config: DDPGHERConfig = self.config
        workers, comm, seed = self.workers, self.comm, self.seed
        space, n_actions = self.spaces.observation, action_size(self.spaces.action)
        n_goal, n_privileged = goal_size(space), flat_size(self.spaces.privileged)
        if not (steps := workers.max_episode_steps):
            raise ValueError(
                "max_episode_steps: found none, allowed environments with a limit"
            )
        gamma = 1.0 - 1.0 / steps if config.gamma is None else config.gamma
        goals: Any = space["desired_goal"]  # type: ignore[index]
        is_single = np.array_equal(
            goals.low, goals.high
        )  # then it is its own hindsight
        her = 0.0 if is_single else REPLAY_P
        replay_p = her if config.replay_p is None else config.replay_p
        self.config = dataclasses.replace(config, gamma=gamma, replay_p=replay_p)
        self.actor = new_actor(config.hidden, self.spaces, generator).to(self.device)
        n_inputs = self._n_obs + n_privileged + n_actions
        names = self.spaces.inputs(PRIVILEGED, "action")
        self.critic = MLP((n_inputs, *config.hidden, 1), generator, inputs=names).to(
            self.device
        )
        self.target_actor, self.target_critic = copy.deepcopy((self.actor, self.critic))
        self.adam = FlatAdam(
            (self.actor, config.actor_lr), (self.critic, config.critic_lr)
        )
        self._target_vector = flatten(
            self.target_actor, self.target_critic
        ).requires_grad_(False)
        comm.broadcast_(self.adam.vector)
        comm.broadcast_(self._target_vector)
        self.obs_stats, self.goal_stats = _stats(config, self.spaces, comm)
        self.privileged_stats = flat_stats(
            self.spaces.privileged, config.norm_clip, comm
        )
        sizes, rewards = (
            (self._n_obs - n_goal, n_goal, n_actions, n_privileged),
            workers.compute_reward,
        )
        rng = np.random.default_rng([seed, comm.rank, rollout.LEARN])
        self.replay = Replay(
            config.buffer_size, steps, sizes, n_boolean(space), rewards, rng
        )
        self._penalty = config.action_l2
        self.cycles_per_epoch = config.n_cycles
        self.updates = self.cycles = 0
        # All rewards so far lie from -worst to best, in the source from the start from -1 to 0.
        self.worst = self.reward_scale = 0.0 if config.normalise_rewards else 1.0
        self.best = self._largest = (
            0.0  # the largest return is that of the last episodes
        )

    def check(self) -> None:
        *_, episode = play_episodes(self.workers, self._player(rollout.PROBE), 1)
        self.replay.require_rewards(episode)
        self.replay.require_memory(self.comm.local_size)

    def describe(self) -> str:
        config, replay = self.config, self.replay
        epoch = config.n_cycles * config.n_rollouts * replay.max_steps
        return (
            f"epochs of up to {epoch:,} steps and {config.n_cycles * config.n_batches:,} updates in "
            f"each process, gamma {config.gamma:g}, HER probability {config.replay_p:g}, replay of "
            f"{config.buffer_size:,} transitions: {replay.nbytes / 1e9:.2f} GB in each when full"
        )

    # -- acting and collecting ---------------------------------------------------------------

    def policy(self) -> Policy:
        config = self.config.acting(self.progress_remaining)
        return _policy(config, self.spaces, self.actor, self.obs_stats, self.goal_stats)

    def _player(self, purpose: int) -> PlayEpisode[GoalObs]:
        """Plays episodes of this rank's own."""
        key = (self.seed, self.comm.rank, purpose, self.cycles)
        return PlayEpisode[GoalObs](
            self.policy(), key, explores=purpose != rollout.TEST
        )

    def collect(self) -> dict[str, float]:
        """One cycle's episodes: into the replay, and relabelled into the normaliser."""
        config, key = (
            self.config,
            [self.seed, self.comm.rank, rollout.LEARN, self.cycles],
        )
        self.replay.rng = np.random.default_rng(key)  # whatever came before
        remaining = self.progress_remaining
        self.adam.scale_lr(remaining if config.anneal_lr else 1.0)
        self._penalty = config.action_l2 * (
            remaining if config.anneal_action_l2 else 1.0
        )
        episodes = play_episodes(
            self.workers, self._player(rollout.TRAIN), config.n_rollouts
        )
        self.cycles += 1
        stats = summary(episodes, self.comm)
        self.env_steps += int(stats.pop("steps"))
        usable = [episode for episode in episodes if len(episode)]
        self._largest = max(
            largest_return(episode.rewards, config.gamma) for episode in usable
        )
        slots = self.replay.store(usable)
        batch = self.replay.sample(sum(map(len, usable)), config.replay_p, slots)
        for name in ("obs", "goal", "privileged"):
            values = getattr(batch, name).clip(-config.clip_obs, config.clip_obs)
            getattr(self, f"{name}_stats").update(values)
        return stats

    def test(self) -> dict[str, float]:
        if not (n := self.config.n_test_rollouts * self.config.n_rollouts):
            return {}
        stats = summary(
            [*self.workers.play(self._player(rollout.TEST), range(n))], self.comm
        )
        return {
            f"test_{name}": stats[name]
            for name in ("success_rate", "mean_return", *rollout.FAULTS)
        }

    # -- learning ----------------------------------------------------------------------------

    def update(self) -> dict[str, float]:
        """One cycle's updates, with one or more moves of the target networks.

        The replay does not change in a cycle, nor do the target networks between two moves: all
        batches are drawn at once, and those between two moves are normalised and given their targets
        at once.
        """
        config, n = self.config, self.config.n_batches
        drawn = self.replay.sample(n * config.batch_size, config.replay_p)
        self._update_reward_scale(drawn.reward)
        sums = torch.zeros(3, device=self.device)
        rows = config.batch_size * (config.target_update_interval or n)
        for start in range(0, n * config.batch_size, rows):
            between = Batch(
                *(torch.from_numpy(part[start : start + rows]) for part in drawn)
            )
            for batch in self._prepared_side_by_side(between):
                sums += self._minibatch(*batch)
            self._target_vector.lerp_(self.adam.vector.detach(), 1.0 - config.polyak)
        self.updates += n
        means = self.comm.sum((sums / n).cpu().double().numpy()) / self.comm.size
        self._require_finite(torch.from_numpy(means), self.adam)
        if self.updates % CHECK_EVERY < n:
            self._require_same(self.adam.vector)
        critic_loss, actor_loss, value = means.tolist()
        learned = {"critic_loss": critic_loss, "actor_loss": actor_loss}
        return {**learned, "mean_q": value * (self.reward_scale or 1.0), "updates": n}

    @torch.no_grad()
    def _update_reward_scale(self, drawn: Array) -> None:
        """Move the bounds of rewards to hold those that were drawn (n,), and the scale with them.

        A relabelled reward may exceed all returns that were lived. When the scale grows, the critics'
        last layers shrink, so that values in the environment's unit stay (van Hasselt et al. 2016).
        """
        found = self.comm.all_gather((-drawn.min(), drawn.max(), self._largest))
        worst, best, largest = zip((self.worst, self.best, 0.0), *found, strict=True)
        self.worst, self.best = float(max(worst)), float(max(best))
        if not self.config.normalise_rewards:
            return
        of_ones = largest_return([1.0] * self.replay.max_steps, self.config.gamma)
        scale = float(max(self.worst, self.best, *largest)) / of_ones
        if scale > self.reward_scale:
            for critic in (self.critic, self.target_critic):
                for values in critic.linears[-1].parameters():
                    values.mul_(self.reward_scale / scale if self.reward_scale else 1.0)
            self.reward_scale = scale

    def _prepared_side_by_side(
        self, drawn: Batch[Tensor]
    ) -> Iterator[tuple[Tensor, ...]]:
        """Minibatches of what was drawn, as `_prepared` makes them, one half beside the other."""
        parts = [torch.tensor_split(part.to(self.device), 2) for part in drawn]
        halves = [
            partial(self._prepared, Batch(*half)) for half in zip(*parts, strict=True)
        ]
        prepared = map(torch.cat, zip(*self.side_by_side(*halves), strict=True))
        return zip(
            *(torch.split(part, self.config.batch_size) for part in prepared),
            strict=True,
        )

    @torch.no_grad()
    def _prepared(self, batch: Batch[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """The critic's inputs but for actions (n, obs + goal + privileged), actions (n, d) and the
        critic's targets (n,)."""
        config, limit = self.config, self.config.clip_obs
        scaled = GoalInputs(self.obs_stats.scaling(), self.goal_stats.scaling(), limit)
        scale_privileged = self.privileged_stats.scaling()
        inputs, next_inputs = (
            torch.cat(
                [
                    scaled(obs, batch.goal),
                    scale_privileged(values.clamp(-limit, limit)),
                ],
                dim=1,
            )
            for obs, values in (
                (batch.obs, batch.privileged),
                (batch.next_obs, batch.next_privileged),
            )
        )
        next_actions = self.target_actor(next_inputs[:, : self._n_obs])
        next_values = self.target_critic(
            torch.cat([next_inputs, next_actions], dim=1)
        ).squeeze(-1)
        terminal = batch.terminal * (config.termination == "terminal")
        scale = self.reward_scale or 1.0
        span = (-self.worst / scale, self.best / scale) if config.clip_target else None
        target = td_targets(
            batch.reward / scale, next_values, terminal, config.gamma, span
        )
        return inputs, batch.action, target

    def _minibatch(self, inputs: Tensor, actions: Tensor, target: Tensor) -> Tensor:
        """One step of both networks from the same parameters; critic's and actor's loss, mean Q."""
        self.adam.gradient.zero_()
        losses = self.side_by_side(
            partial(self._critic_gradient, inputs, actions, target),
            partial(self._actor_gradient, inputs),
        )
        self.adam.reduce(self.comm, self.config.reduction)
        self.adam.step()
        return torch.cat(losses)

    def _critic_gradient(
        self, inputs: Tensor, actions: Tensor, target: Tensor
    ) -> Tensor:
        """Write it; the critic's loss (1,)."""
        values = self.critic(torch.cat([inputs, actions], dim=1)).squeeze(-1)
        loss = (values - target).square().mean()
        loss.backward(inputs=list(self.critic.parameters()))
        return loss.detach()[None]

    def _actor_gradient(self, inputs: Tensor) -> Tensor:
        """Write it; the actor's loss and the mean Q of what it would do (2,)."""
        actions = self.actor(inputs[:, : self._n_obs])
        value = self.critic(torch.cat([inputs, actions], dim=1)).mean()
        loss = self._penalty * actions.square().mean() - value
        loss.backward(inputs=list(self.actor.parameters()))  # and not the critic's
        return torch.stack([loss, value]).detach()

    # -- saving ------------------------------------------------------------------------------

    @staticmethod
    def saved_policy(
        config: DDPGHERConfig, spaces: Spaces, saved: dict[str, Any]
    ) -> Policy:
        actor = new_actor(config.hidden, spaces, torch.Generator())
        obs_stats, goal_stats = _stats(config, spaces, Communicator())
        restore(
            {"actor": actor, "obs_stats": obs_stats, "goal_stats": goal_stats}, saved
        )
        return _policy(config, spaces, actor, obs_stats, goal_stats)
