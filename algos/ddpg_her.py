"""Deep deterministic policy gradient (Lillicrap et al. 2016) with hindsight experience replay.

Read from top to bottom: the choices, what it computes, the learner. The order of
operations is OpenAI baselines' (baselines/her), which the paper used through Melnik et
al. 2021: an epoch is `n_cycles` times {episodes, normalizer, `n_batches` updates, one
or more moves of the target networks}, then test episodes without noise.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from . import (
    Array,
    Communicator,
    Count,
    Fraction,
    NotNegative,
    Positive32,
    Workers,
    rollout,
)
from .learner import Learner, LearnerConfig, RewardScale
from .networks import MLP, flushed_denormals
from .normalizer import MIN_STD, Normalizer, Scaling
from .policy import (
    FlatInputs,
    Policy,
    Spaces,
    TaxelScale,
    action_size,
    goal_size,
    input_stats,
    new_actor,
    on_cpu,
)
from .replay import Batch, Replay, minibatches
from .rollout import (
    Episode,
    PlayEpisode,
    largest_return,
    summary,
    usable,
)

# What is kept of observations, in this order; networks see all but the last.
VIEW = ("observation", "desired_goal", "achieved_goal")
REPLAY_P = 0.8  # paper


@dataclass(frozen=True)
class DDPGHERConfig(LearnerConfig):
    """Hyperparameters; defaults are the paper's (Methods, MuJoCo set-up) unless noted."""

    hidden: tuple[Count, ...] = (256, 256, 256)
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
    """Updates between two moves of the target networks, which move at the end of a
    cycle at the latest; default: one move per cycle, as in baselines."""
    gamma: Annotated[float, "[0, 1)"] | None = None
    """Discount factor; default: 1 - 1/T, where T is the length of an episode, as in
    baselines."""
    action_l2: NotNegative = 1.0
    """Weight of the mean squared action in the actor's loss."""
    clip_obs: Positive32 = 200.0
    """Bound on observations and goals before they are normalized."""
    norm_clip: Positive32 = 5.0
    """Bound on observations and goals after they are normalized."""
    min_std: Positive32 = MIN_STD
    """Smallest standard deviation that an observation is divided by, in its own unit;
    for entries between 0 and 1, such as Boolean taxels, it is 0.01. With --min-std 1,
    what varies less stays small, such as the noise of a joint that stands still; with a
    small one, it is scaled up until it counts as much as what matters."""
    taxel_scale: TaxelScale = "each"
    """Scale of observed entries between 0 and 1, such as Boolean taxels. none: as they
    are; block: one gain for all, so that together they count as much as 24 normalized
    inputs, however many they are; each: every one normalized by itself."""
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
    """Share of steps with a uniformly random action."""
    random_hold: Annotated[float, "[1, 1e6]"] = 1.0
    """Mean number of steps for which a random action is held: of a geometric
    distribution (temporally extended exploration, Dabney et al. 2021). Their share of
    steps stays --random-eps."""
    noise_eps: NotNegative = 0.2
    """Standard deviation of the noise on other actions, relative to half the action
    range."""
    replay_p: Fraction | None = None
    """Probability that a sampled transition is relabelled (HER); default: 0.8 (paper),
    or 0 if the task has a single goal."""
    reduction: Literal["sum", "mean"] = "sum"
    """Combination of the gradients of several processes (baselines: sum)."""
    clip_target: bool = True
    """Clip value targets to the range of possible returns: from -1/(1 - gamma) to 0
    (baselines), wider once rewards below -1 or above 0 are seen. With
    --normalize-rewards it begins at 0 to 0, and is widened before the first update."""
    termination: Literal["bootstrap", "terminal"] = "bootstrap"
    """Treatment of an episode's end by termination. bootstrap: the target network's
    value is added, since baselines has no done mask; terminal: it is not. Whether a
    relabelled goal ends the episode is what the environment's compute_terminated says,
    as Gymnasium-Robotics' have it. Without one, it ends where its reward is as high as
    at the ends that were seen, if all of those were higher than the rewards of all
    other steps."""
    normalize_rewards: bool = False
    """Divide rewards by a running scale, so that the largest return so far counts as
    much as that of a reward of 1 in every step. Whatever unit rewards have, --action-l2
    and the learning rates then mean the same; rewards of -1 and 0 stay as they are once
    a whole episode has failed."""

    @property
    def anneals(self) -> bool:
        """True if the course of a run depends on how long it will be."""
        return self.anneal_lr or self.anneal_noise or self.anneal_action_l2

    def acting(self, remaining: float) -> DDPGHERConfig:
        """Return a copy with annealed exploration noise; `remaining` falls from 1 to 0 over a run."""
        left = remaining if self.anneal_noise else 1.0
        return dataclasses.replace(
            self, noise_eps=left * self.noise_eps, random_eps=left * self.random_eps
        )

    @property
    def explores(self) -> bool:
        """True if a policy that acts by this configuration has exploration noise."""
        return self.noise_eps > 0.0 or self.random_eps > 0.0


def td_targets(
    rewards: Tensor,
    next_values: Tensor,
    terminal: Tensor,
    gamma: Any,
    span: Sequence[Any] | None,
) -> Tensor:
    """Return the critic's targets (n,): r + gamma Q'(next), from arguments (n,).

    `terminal` is 1 where nothing follows. Values are cut to the returns that rewards in
    `span` can make (Andrychowicz et al. 2017, appendix A).
    """
    values = rewards + gamma * (1.0 - terminal) * next_values
    return (
        values.clamp(*(reward / (1.0 - gamma) for reward in span)) if span else values
    )


def play_episodes(workers: Workers, job: PlayEpisode, n: int) -> list[Episode]:
    """Return episodes 0, 1, 2, ... in order of number until `n` of them have transitions."""
    episodes: list[Episode] = []
    while missing := n - len(usable(episodes)):
        episodes += workers.play(job, range(len(episodes), len(episodes) + missing))
    return episodes


def q_values(critic: Any, inputs: Tensor, actions: Tensor) -> Tensor:
    """Return a critic's values (..., n) of actions (..., n, d) for inputs (..., n, obs + goal)."""
    values: Tensor = critic(torch.cat([inputs, actions], dim=-1)).squeeze(-1)
    return values


def actor_loss(
    actor: Any, critic: Any, obs: Tensor, action_l2: Any
) -> tuple[Tensor, Tensor]:
    """Return the actor's loss and the mean Q of its actions, (...), for inputs (..., n, size)."""
    actions = actor(obs)
    mean_q = q_values(critic, obs, actions).mean(dim=-1)
    return action_l2 * actions.square().mean(dim=(-2, -1)) - mean_q, mean_q


class Exploration:
    """Make the actions of one episode noisy, and some of them random for several steps.

    This is the exploration of OpenAI baselines (Gaussian noise, and a uniformly random
    action with probability `random_eps`), where random actions are held for a geometric
    number of steps with mean `random_hold` (Dabney et al. 2021). Their share of steps
    is `random_eps` from the first step on.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        noise_eps: Any,
        random_eps: Any,
        random_hold: Any = 1.0,
    ) -> None:
        """Take numbers, or columns (n, 1) with one for each row of actions."""
        self.rng, self.noise_eps, self.random_eps = rng, noise_eps, random_eps
        self.random_hold = random_hold
        # Probability q that a random action begins where none is held: where holds last
        # h steps on average, a share of h q / (h q + 1 - q) of all steps is random.
        self._begin = random_eps / (random_eps + random_hold * (1.0 - random_eps))
        # Which rows were random in the last step, (n, 1); None before the first.
        self._is_random: Array | None = None
        self._random = np.zeros(0, np.float32)  # (n, d)

    def __call__(self, actions: Array) -> Array:
        """Return noisy copies of actions (n, d) in [-1, 1]; n is the same in every call."""
        rng = self.rng
        noise = rng.standard_normal(actions.shape, dtype=np.float32)
        noisy = np.clip(actions + np.float32(self.noise_eps) * noise, -1.0, 1.0)
        chance = rng.random(actions.shape[:-1])[..., None]
        drawn = rng.uniform(-1.0, 1.0, actions.shape).astype(np.float32)
        hold = self.random_hold
        if self._is_random is None:  # the first step has the same share as all others
            is_new, is_held = chance < self.random_eps, np.zeros(chance.shape, bool)
            self._random = drawn
        else:  # one draw decides both: a hold ends below 1 / hold, and another may follow at once
            begin = np.where(self._is_random, self._begin / hold, self._begin)
            is_new = chance < begin
            is_held = self._is_random & (chance >= 1.0 / hold)
        self._random = np.where(is_new, drawn, self._random)
        self._is_random = is_new | is_held
        return np.where(self._is_random, self._random, noisy)


def joined(*stats: Normalizer) -> Scaling:
    """Return what normalizers do to their columns side by side."""
    each = (one.scaling() for one in stats)
    return Scaling(*map(torch.cat, zip(*each, strict=True)))


class GoalInputs(FlatInputs):
    """Flatten and scale observation and desired goal; keep the achieved goal, which is not seen."""

    def read(self, obs: Any) -> Array:
        """Return observation, desired and achieved goal side by side."""
        # Where an observation has no achieved goal, the desired one stands in: nothing
        # reads it.
        whole = {"achieved_goal": obs["desired_goal"], **obs}
        return np.concatenate([np.ravel(whole[key]) for key in VIEW], dtype=np.float32)

    def stack(self, views: Sequence[Array]) -> Tensor:
        seen = torch.from_numpy(np.stack(views))  # ordered as `VIEW`
        return self.scaling(seen[:, : len(self.scaling.limit)])


class DDPGHER(Learner):
    """Learn by DDPG with hindsight: actor, critic, their targets and the replay.

    A cycle is `collect` and `update`; an epoch is some cycles and `test`. Learners of
    many runs at once (`batch`) play by themselves; they call `begin`, `wants_more`,
    `keep`, `rescale` and `learn`.
    """

    replay: Replay
    policy_parts = ("actor", "obs_stats", "goal_stats")
    saved = (
        *policy_parts,
        "critic",
        "target_actor",
        "target_critic",
        "actor_adam",
        "critic_adam",
        "reward_scale",
    )
    plain = ("env_steps", "updates", "cycles")

    def build(self, generator: torch.Generator) -> None:
        config: DDPGHERConfig = self.config
        workers, comm = self.workers, self.comm
        space, n_actions = self.spaces.observation, action_size(self.spaces.action)
        n_goal = goal_size(space)
        if not (steps := workers.max_episode_steps):
            raise ValueError(
                "max_episode_steps: found none, allowed environments with a limit"
            )
        gamma = 1.0 - 1.0 / steps if config.gamma is None else config.gamma
        goals: Any = space["desired_goal"]  # type: ignore[index]
        # A single goal is its own hindsight.
        is_single = np.array_equal(goals.low, goals.high)
        her = 0.0 if is_single else REPLAY_P
        replay_p = her if config.replay_p is None else config.replay_p
        config = dataclasses.replace(config, gamma=gamma, replay_p=replay_p)
        self.config = config
        parts = self.new_parts(config, self.spaces, comm, generator)
        self.actor = parts["actor"]
        self.obs_stats, self.goal_stats = parts["obs_stats"], parts["goal_stats"]
        self.actor.to(self.device)
        sizes = (self.n_inputs + n_actions, *config.hidden, 1)
        self.critic = MLP(sizes, generator).to(self.device)
        self.actor_parameters = [*self.actor.parameters()]
        self.critic_parameters = [*self.critic.parameters()]
        self.actor_adam = self.adam(self.actor_parameters, config.actor_lr)
        self.critic_adam = self.adam(self.critic_parameters, config.critic_lr)
        self.target_actor, self.target_critic = copy.deepcopy((self.actor, self.critic))
        self.replay = Replay(
            config.buffer_size,
            steps,
            (self.n_inputs - n_goal, n_goal, n_actions),
            workers.compute_reward,
            workers.compute_terminated if config.termination == "terminal" else None,
        )
        self.action_l2 = config.action_l2  # falls where it is annealed
        self.cycles_per_epoch = config.n_cycles
        self.n_tests = config.n_test_rollouts * config.n_rollouts
        self.updates = self.cycles = 0
        is_running = config.normalize_rewards  # else as in baselines: from -1 to 0
        self.reward_scale = RewardScale(is_running, 0.0 if is_running else -1.0)
        self._largest_return = 0.0  # of the last episodes
        self.new_slots = np.zeros(0, np.int64)  # where the replay has them

    def check(self) -> None:
        episodes = play_episodes(self.workers, self.player(rollout.PROBE), 1)
        self.replay.require_rewards(episodes[-1])  # the one with transitions

    def describe(self) -> str:
        config, replay = self.config, self.replay
        epoch = config.n_cycles * config.n_rollouts * replay.max_steps
        return (
            f"epochs of up to {epoch:,} steps and {config.n_cycles * config.n_batches:,} updates in "
            f"each process, gamma {config.gamma:g}, HER probability {config.replay_p:g}, replay of "
            f"{config.buffer_size:,} transitions: {replay.nbytes / 1e9:.2f} GB in each when full"
        )

    # -- acting and collecting ---------------------------------------------------------------

    def collect(self) -> dict[str, float]:
        """Play one cycle's episodes: into the replay, and relabelled into the normalizers."""
        self.begin()
        player = self.player(rollout.TRAIN)
        episodes = play_episodes(self.workers, player, self.config.n_rollouts)
        return self.keep(episodes)

    def key(self, purpose: int) -> rollout.Key:
        """Return the key of this cycle's episodes, for one of the purposes in `rollout`."""
        return self.seed, self.comm.rank, purpose, self.cycles

    def begin(self) -> None:
        """Begin a cycle: set what falls over a run, and the random numbers of storing and learning."""
        self.replay.rng = np.random.default_rng(self.key(rollout.LEARN))
        if self.config.anneal_lr:
            self.anneal(self.actor_adam, self.critic_adam)
        if self.config.anneal_action_l2:
            self.action_l2 = self.progress_remaining * self.config.action_l2

    def wants_more(self, episodes: list[Episode]) -> bool:
        """Return whether a cycle has too few episodes with transitions."""
        return len(usable(episodes)) < self.config.n_rollouts

    def keep(self, episodes: list[Episode]) -> dict[str, float]:
        """Take a cycle's episodes into the replay and the normalizers; return counts and means."""
        self.cycles += 1
        stats = summary(episodes, self.comm)
        self.env_steps += int(stats.pop("steps"))
        played, gamma = usable(episodes), self.config.gamma
        self._largest_return = max(largest_return(e.rewards, gamma) for e in played)
        self.new_slots = self.replay.store(played)
        n = sum(map(len, played))
        batch = self.replay.sample(n, self.config.replay_p, self.new_slots)
        self.obs_stats.update(batch.obs)
        self.goal_stats.update(batch.goal)
        return stats

    # -- learning ----------------------------------------------------------------------------

    def update(self) -> dict[str, float]:
        """Take one cycle's updates, with one or more moves of the target networks."""
        config, n = self.config, self.config.n_batches
        # The replay does not change in a cycle: all minibatches are drawn at once.
        drawn = self.replay.sample(n * config.batch_size, config.replay_p)
        self.rescale(drawn.reward)  # and widen the bounds of targets
        sums = self.learn(minibatches(self._as_inputs(drawn), config.batch_size))
        self.updates += n
        over_ranks = self.comm.sum((sums / n).cpu().double().numpy())
        critic_loss, actor_loss, mean_q = means = (over_ranks / self.comm.size).tolist()
        self.check_learned(means, self.actor, self.critic)
        return {
            "critic_loss": critic_loss,
            "actor_loss": actor_loss,
            "mean_q": mean_q * self.reward_scale.unit,  # as the environment has rewards
            "updates": n,
        }

    def learn(self, batches: Iterable[Batch]) -> Tensor:
        """Take an Adam step on each of `n_batches` minibatches, and move the target networks.

        Returns the sums of what `_update_networks` does.
        """
        config, n = self.config, self.config.n_batches
        sums: Any = 0.0
        with flushed_denormals():
            for i, batch in enumerate(batches, start=1):
                sums += self._update_networks(batch)
                if i % (config.target_update_interval or n) == 0 or i == n:
                    self._move_targets()
        return sums  # type: ignore[no-any-return]

    def _as_inputs(self, drawn: Batch) -> Batch:
        """Return tensors in which observations are the networks' inputs (n, obs + goal)."""
        batch = Batch(*(torch.from_numpy(column).to(self.device) for column in drawn))
        scaling = self.scaling()
        obs, next_obs = (
            scaling(torch.cat([part, batch.goal], dim=-1))
            for part in (batch.obs, batch.next_obs)
        )
        return batch._replace(obs=obs, next_obs=next_obs)

    def _update_networks(self, batch: Batch) -> Tensor:
        """Take one Adam step of critic and actor, both from the same parameters.

        Returns the critic's loss, the actor's loss and the mean Q of the actor's
        actions, (3, ...).
        """
        critic_loss, actor_losses = self.in_two_threads(
            partial(self._critic_gradient, batch),
            partial(self._actor_gradient, batch.obs),
        )
        parameters = self.actor_parameters + self.critic_parameters
        self._sum_gradients(parameters)
        if self.config.reduction == "mean":
            for parameter in parameters:
                parameter.grad.div_(self.comm.size)
        self.critic_adam.step()
        self.actor_adam.step()
        return torch.cat([critic_loss[None], actor_losses])

    def _critic_gradient(self, batch: Batch) -> Tensor:
        """Compute the gradient of the critic's squared error; return the loss, (...)."""
        targets = self._targets(batch)
        errors = q_values(self.critic, batch.obs, batch.action) - targets
        loss = errors.square().mean(dim=-1)
        self.critic_adam.zero_grad()
        # A sum over runs, where there are several in front: each has parameters of its
        # own.
        loss.sum().backward(inputs=self.critic_parameters)  # type: ignore[no-untyped-call]
        return loss.detach()

    def _actor_gradient(self, inputs: Tensor) -> Tensor:
        """Compute the gradient of what the critic says of the actor's actions.

        Returns the actor's loss and the mean Q, (2, ...).
        """
        loss, mean_q = actor_loss(self.actor, self.critic, inputs, self.action_l2)
        self.actor_adam.zero_grad()
        # Of the actor alone: the critic, through which it passes, has its own.
        loss.sum().backward(inputs=self.actor_parameters)  # type: ignore[no-untyped-call]
        return torch.stack([loss, mean_q]).detach()

    @torch.no_grad()
    def _targets(self, batch: Batch) -> Tensor:
        """Return the critic's targets (n,), from the target networks."""
        config, inputs = self.config, batch.next_obs
        next_actions = self.target_actor(inputs)
        next_values = q_values(self.target_critic, inputs, next_actions)
        terminal = batch.terminal
        if config.termination == "bootstrap":
            terminal = torch.zeros_like(terminal)
        scale = self.reward_scale
        unit, low, high = scale.unit, scale.lowest, scale.highest
        span = (low / unit, high / unit) if config.clip_target else None
        return td_targets(
            batch.reward / unit, next_values, terminal, config.gamma, span
        )

    @torch.no_grad()
    def _move_targets(self) -> None:
        """Move the target networks by 1 - polyak towards actor and critic."""
        networks = ((self.target_actor, self.actor), (self.target_critic, self.critic))
        for target, network in networks:
            for old, new in zip(target.parameters(), network.parameters(), strict=True):
                old.lerp_(new, 1.0 - self.config.polyak)

    def rescale(self, rewards: Array) -> None:
        """Follow the rewards that were drawn (n,), of all ranks: their bounds, and a running scale.

        The scale is what makes the largest return so far as large as that of a reward
        of 1 in every step; a relabelled reward may exceed all returns that were played.
        As it grows, the critics' outputs shrink, so that values in the environment's
        unit stay.
        """
        mine = rewards.min(), rewards.max(), self._largest_return
        lows, highs, largest = zip(*self.comm.all_gather(mine), strict=True)
        self.reward_scale.see(np.array([*lows, *highs]))
        of_ones = largest_return([1.0] * self.replay.max_steps, self.config.gamma)
        scale = self.reward_scale
        extreme = max(-scale.lowest, scale.highest, *largest)
        factor = scale.grow(float(extreme) / of_ones)
        for critic in (self.critic, self.target_critic):
            critic.scale_outputs(factor)

    def _sum_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace gradients by their sums over ranks: one message."""
        if self.comm.size == 1:
            return
        gradients: list[Any] = [p.grad for p in parameters]
        vector = parameters_to_vector(gradients)
        self.comm.sum_(vector)
        vector_to_parameters(vector, gradients)  # writes into the gradients

    # -- the policy --------------------------------------------------------------------------

    def scaling(self) -> Scaling:
        """Return what the networks' inputs are scaled by now."""
        return joined(self.obs_stats, self.goal_stats)

    @staticmethod
    def new_parts(
        config: DDPGHERConfig,
        spaces: Spaces,
        comm: Communicator,
        generator: torch.Generator,
    ) -> dict[str, Any]:
        space: Any = spaces.observation
        return {
            "actor": new_actor(config.hidden, spaces, generator),
            "obs_stats": input_stats(
                space["observation"],
                comm,
                config.norm_clip,
                True,
                config.taxel_scale,
                config.min_std,
                config.clip_obs,
            ),
            "goal_stats": Normalizer(
                goal_size(space), comm, config.norm_clip, bound=config.clip_obs
            ),
        }

    @staticmethod
    def as_policy(config: DDPGHERConfig, spaces: Spaces, *parts: Any) -> Policy:
        actor, *stats = parts
        explore = partial(
            Exploration,
            noise_eps=config.noise_eps,
            random_eps=config.random_eps,
            random_hold=config.random_hold,
        )
        inputs = GoalInputs(joined(*stats))
        return Policy(on_cpu(actor), inputs, explore, spaces)
