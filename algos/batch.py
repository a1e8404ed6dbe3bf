"""Learn many runs of one kind at once, each as it would learn alone.

Each run has its single learner, PPO or DDPGHER. That draws all random numbers, keeps and relabels
episodes, follows rewards and computes advantages, as it does by itself. Here are the two things that
are faster for all runs together: playing, in a vector environment, and the networks. Those are
stacked: every tensor has the runs in front, (E, ...).

Episodes are whole, and those of the single learner: number and key give their start and their noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from itertools import zip_longest
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector, vector_to_parameters
from torch.nn.utils.rnn import pad_sequence

from . import Array, DivergenceError, rollout
from .ddpg_her import (
    DDPGHER,
    VIEW,
    Exploration,
    GoalInputs,
    actor_loss,
    q_values,
    td_targets,
    tested,
)
from .normalizer import Normalizer, Scaling
from .policy import OBS, finite
from .ppo import PPO, ActorLoss, Transitions, surrogate
from .replay import Batch, Relabelled
from .rollout import REWARD, Episode, Key, summary

BETAS, EPS = (0.9, 0.999), 1e-8  # Adam's
MOMENTS = ("exp_avg", "exp_avg_sq")  # their names in the state of PyTorch's Adam
LOSSES = ("critic_loss", "actor_loss", "mean_q")  # of DDPG
T = TypeVar("T")
Rows = dict[int, dict[str, float]]  # of the progress table, by run
Rngs = Mapping[int, np.random.Generator]  # of worlds that begin
Explore = Callable[[Array, Array], Array]
"""Return actions (n, d) to take from those of the policy and the numbers of their steps (n,)."""


def alike(config: Any) -> tuple[Any, ...]:
    """Return what configurations of one batch have in common: all but the values of floats."""
    values = vars(config).items()
    fixed = ((name, "" if isinstance(x, float) else x) for name, x in values)
    return type(config), *fixed


# -- networks --------------------------------------------------------------------------------


class Networks:
    """Hold one network of each run in one tensor, `flat` (E, parameters), and its Adam.

    Inputs that a run does not have are zero, and so stay their weights.
    """

    def __init__(
        self,
        runs: Sequence[Sequence[tuple[nn.Module, torch.optim.Adam | None]]],
        columns: Sequence[Tensor],
        width: int,
        device: torch.device,
    ) -> None:
        """Stack the modules of each run, the first of them an MLP, with their Adams.

        `columns` are the places of each run's inputs among all `width`.
        """
        self.runs, (mlp, _) = runs, runs[0][0]
        self.is_tanh, self.n_layers = isinstance(mlp[-1], nn.Tanh), len(mlp.linears)  # type: ignore[index, arg-type]
        first, *rest = (p.shape for module, _ in runs[0] for p in module.parameters())
        self.shapes = [(first[0], width), *rest]
        self.sizes = [*map(math.prod, self.shapes)]
        weights, others = torch.arange(sum(self.sizes)).tensor_split([self.sizes[0]])
        weights = weights.view(self.shapes[0])
        self.places = [torch.cat([weights[:, own].ravel(), others]) for own in columns]
        shape = len(runs), sum(self.sizes)
        self.flat, *moments = (torch.zeros(shape, device=device) for _ in range(3))
        self.rows = [self.flat, *moments]
        self.n_steps = torch.zeros(len(runs), 1, device=device)
        for i in range(len(runs)):
            self.read(i)
        self.flat.requires_grad_()

    def _own(self, i: int) -> tuple[list[list[Tensor]], list[Tensor]]:
        """Return the tensors of run `i` alone: parameters and both moments; and its Adams' steps."""
        parameters, states = list[Tensor](), list[dict[str, Tensor]]()
        for module, adam in self.runs[i]:
            for p in module.parameters():
                state = adam.state[p] if adam and p.requires_grad else {}
                if not state:
                    state |= {name: torch.zeros_like(p.data) for name in MOMENTS}
                    state["step"] = torch.tensor(0.0)
                parameters.append(p)
                states.append(state)
        moments = [[state[name] for state in states] for name in MOMENTS]
        return [parameters, *moments], [state["step"] for state in states]

    @torch.no_grad()
    def read(self, i: int) -> None:
        """Copy what run `i` has alone into its rows."""
        own, steps = self._own(i)
        for rows, tensors in zip(self.rows, own, strict=True):
            rows[i, self.places[i]] = parameters_to_vector(tensors).to(rows.device)
        self.n_steps[i] = max(map(float, steps))

    @torch.no_grad()
    def write(self, i: int) -> None:
        """Copy the rows of run `i` into what it has alone."""
        own, steps = self._own(i)
        for rows, tensors in zip(self.rows, own, strict=True):
            vector = rows[i].detach()[self.places[i]].to(tensors[0].device)
            vector_to_parameters(vector, tensors)
        for step in steps:
            step.copy_(self.n_steps[i, 0])

    def __call__(self, x: Tensor) -> Tensor:
        """Return outputs (E, n, outputs) for inputs (E, n, width)."""
        pieces = self.flat.split(self.sizes, dim=1)  # type: ignore[no-untyped-call]
        for k in range(self.n_layers):
            weight, bias = (
                pieces[2 * k].unflatten(1, self.shapes[2 * k]),
                pieces[2 * k + 1],
            )
            x = torch.baddbmm(bias[:, None], x, weight.transpose(1, 2))
            x = x.relu() if k + 1 < self.n_layers else x
        return x.tanh() if self.is_tanh else x

    @torch.no_grad()
    def step(self, gradient: Tensor, lr: Tensor, on: Tensor) -> None:
        """Take an Adam step of the runs where `on` (E, 1) is 1; `lr` is (E, 1) or (E, parameters)."""
        flat, mean, square = self.rows
        gradient = torch.where(on == 1, gradient, 0.0)  # 0 * inf is NaN
        self.n_steps += on
        mean.lerp_(gradient, on * (1 - BETAS[0]))
        square.lerp_(gradient.square(), on * (1 - BETAS[1]))
        n = self.n_steps.double().clamp(min=1.0)
        first, second = ((1 - beta**n).float() for beta in BETAS)
        size = (square.sqrt() / second.sqrt()).add_(EPS)
        flat.sub_(mean / size * (on * lr / first))


def stacked(
    stats: Sequence[Normalizer], columns: Sequence[Tensor], width: int, device: Any
) -> Scaling:
    """Return what normalizers do to values now, (E, 1, width); where a run has no column it is 0."""
    parts = torch.zeros(4, len(stats), 1, width)
    for i, one in enumerate(stats):
        parts[:, i, 0, columns[i]] = torch.stack([*one.scaling()])
    return Scaling(*parts.to(device))


# -- learners --------------------------------------------------------------------------------


class BatchLearner:
    """Learn E runs at once; `collect` and `update` in turn, as a single learner does.

    A run is active until it has its steps, or fails: `failures` says why, by run. It plays in W worlds
    of its own, `i` W to `(i + 1)` W, all at once; one that has enough episodes waits for the others.
    """

    networks: Sequence[Networks]
    own: list[Tensor]
    """Places of what a run's own learner keeps in whole observations."""

    def __init__(self, learners: Sequence[Any], env: Any) -> None:
        """Stack learners whose configurations are `alike`; `env` has the same worlds for each.

        It is Gymnasium's VectorEnv, whose observations are tensors, with autoreset off. Where its info
        has ``holding``, a step of those worlds is not over: it ends with the call that says so no more,
        and all actions but its first are ignored.
        """
        self.learners, self.env = learners, env
        self.n_worlds = env.num_envs // len(learners)
        self.device = torch.device(env.device)
        self.cycles_per_epoch = learners[0].cycles_per_epoch
        self.config = learners[0].config  # but for floats, which are in `hyper`
        spaces = env.single_observation_space
        self.width, self.n_goal = (
            math.prod(spaces[key].shape) for key in ("observation", "desired_goal")
        )
        self.n_actions = math.prod(env.single_action_space.shape)
        self.e = torch.arange(len(learners), device=self.device)[:, None]
        self.failures, self.on = dict[int, str](), list[int]()
        self.hyper = {
            name: self.numbers(getattr(one.config, name) for one in learners)
            for name, value in vars(self.config).items()
            if isinstance(value, float)
        }
        self.build()

    def build(self) -> None:
        """Stack the learners' `networks`; set `own`."""
        raise NotImplementedError

    def act(self, seen: Tensor) -> Tensor:
        """Return actions without exploration (E, W, d) from whole observations (E, W, ...)."""
        raise NotImplementedError

    def explore(self, rngs: Rngs) -> Explore:
        """Return the exploration of an episode in each of some worlds, with their generators."""
        raise NotImplementedError

    def write(self, i: int) -> None:
        """Write the state of run `i` into its single learner."""
        for networks in self.networks:
            networks.write(i)

    def columns(self, n_more: int) -> list[Tensor]:
        """Return the places of each run's inputs: of its own observation, and all of `n_more`."""
        spaces = [one.spaces.observation["observation"] for one in self.learners]
        rest = range(self.width, self.width + n_more)
        return [torch.tensor([*range(space.shape[0]), *rest]) for space in spaces]

    def numbers(self, values: Iterable[float]) -> Tensor:
        """Return a number of each run, (E, 1)."""
        return torch.tensor([[float(x)] for x in values], device=self.device)

    def mask(self, runs: Collection[int]) -> Tensor:
        """Return 1 for these runs and 0 for others, (E, 1)."""
        return self.numbers(i in runs for i in range(len(self.learners)))

    def rate(self, adam: str) -> Tensor:
        """Return the learning rate that an Adam of each single learner has now, (E, 1)."""
        adams = (getattr(one, adam) for one in self.learners)
        return self.numbers(one.param_groups[0]["lr"] for one in adams)

    @property
    def active(self) -> list[int]:
        """Runs that go on."""
        return [
            i
            for i, one in enumerate(self.learners)
            if one.env_steps < one.total_timesteps and i not in self.failures
        ]

    def tried(self, i: int, function: Callable[..., T], *args: Any) -> T | None:
        """Return what a function returns; where it raises DivergenceError, run `i` has failed."""
        try:
            return function(*args)
        except DivergenceError as error:
            self.failures.setdefault(i, str(error))
            self.on = [j for j in self.on if j != i]
            return None

    def means(
        self, sums: Tensor, n_updates: Mapping[int, int], *networks: Networks
    ) -> dict[int, list[float]]:
        """Return means of sums (E, k) by run; one with losses or parameters not finite fails."""
        weights = [network.flat.sum(dim=1, keepdim=True) for network in networks]
        rows = torch.cat([sums, *weights], dim=1).tolist()
        for i in self.on:
            self.tried(i, self.learners[i].check_learned, rows[i])
        n = sums.shape[1]
        return {i: [x / n_updates[i] for x in rows[i][:n]] for i in self.on}

    # -- episodes ----------------------------------------------------------------------------

    def collect(self) -> Rows:
        """Play the episodes of each active run that it learns from next; return counts and means."""
        self.on, keys = self.active, dict[int, Key]()
        for i in self.on:
            self.learners[i].begin()
            keys[i] = self.learners[i].key(rollout.TRAIN)
        episodes = self.play(
            keys,
            lambda i, played: bool(self.tried(i, self.learners[i].wants_more, played)),
            self.explore,
        )
        rows = {i: self.tried(i, self._keep, i, episodes[i]) for i in self.on}
        return {i: row for i, row in rows.items() if row}

    def _keep(self, i: int, episodes: list[Episode]) -> dict[str, float]:
        """Let run `i` keep its episodes, with its own part of the observations."""
        for episode in _finite(episodes):
            episode.obs = episode.obs[:, self.own[i]]  # type: ignore[call-overload]
        row: dict[str, float] = self.learners[i].keep(episodes)
        return row

    def play_best(self, keys: Mapping[int, Key], n: int) -> Rows:
        """Return counts and means of `n` episodes without exploration of the runs with keys."""
        played = self.play(
            keys,
            lambda _, played: len(played) < n,
            lambda rngs: lambda actions, steps: actions,
        )
        usable = {i: self.tried(i, _finite, mine) for i, mine in played.items()}
        return {i: summary(mine) for i, mine in usable.items() if mine}

    def test(self, asked: Iterable[int]) -> Rows:
        """Return how good the runs that are asked for are without exploration; may be empty."""
        return {}

    @torch.no_grad()
    def play(
        self,
        keys: Mapping[int, Key],
        wants_more: Callable[[int, list[Episode]], bool],
        explore: Callable[[Rngs], Explore],
    ) -> dict[int, list[Episode]]:
        """Play episodes 0, 1, 2, ... of the runs with these keys until each has enough of them.

        `explore` returns what adds noise from the generators of worlds that begin.
        """
        episodes = {i: list[Episode]() for i in keys}
        wanted, first = dict(keys), 0
        while wanted:
            for world, episode in self._wave(wanted, first, explore).items():
                i = world // self.n_worlds
                if wants_more(i, episodes[i]):
                    episodes[i].append(episode)
            wanted = {i: keys[i] for i in wanted if wants_more(i, episodes[i])}
            first += self.n_worlds
        return episodes

    def _wave(
        self, keys: Mapping[int, Key], first: int, explore: Callable[[Rngs], Explore]
    ) -> dict[int, Episode]:
        """Play one episode, number `first` and following, in each world of the runs with keys."""
        env, n, n_worlds = self.env, self.env.num_envs, self.n_worlds
        rngs = {
            i * n_worlds + w: np.random.default_rng([*key, first + w])
            for i, key in keys.items()
            for w in range(n_worlds)
        }
        draws = {world: int(rng.integers(2**31)) for world, rng in rngs.items()}
        noisy, seeds = explore(rngs), [draws.get(world) for world in range(n)]
        live = np.isin(np.arange(n), [*rngs])
        obs, info = env.reset(seed=seeds, options={"reset_mask": live})
        diverged = live & self._flags(info, "diverged")
        live = live & ~diverged
        seen, n_steps = self._whole(obs), env.max_episode_steps
        views = seen.new_zeros(n, n_steps + 1, seen.shape[-1])
        views[:, 0] = seen
        actions = np.zeros((n, n_steps, self.n_actions), np.float32)
        rewards, lengths = np.zeros((n, n_steps)), np.zeros(n, np.int64)
        success, terminated, begins = live & False, live & False, live
        while live.any():
            chosen = self.act(seen.unflatten(0, (-1, n_worlds)))  # type: ignore[no-untyped-call]
            taken = noisy(chosen.flatten(0, 1).cpu().numpy(), lengths)
            taken = np.nan_to_num(taken)  # of runs that fail
            actions[begins, lengths[begins]] = taken[begins]
            on_device = torch.from_numpy(taken.clip(-1.0, 1.0)).to(seen.device)
            obs, *results, info = env.step(on_device)
            reward, is_end, is_cut = (result.cpu().numpy() for result in results)
            broken, holds = (
                live & self._flags(info, "diverged"),
                self._flags(info, "holding"),
            )
            stepped = live & ~broken & ~holds
            rewards[stepped, lengths[stepped]] = reward[stepped]
            lengths += stepped
            seen, at = self._whole(obs), np.flatnonzero(stepped)
            views[at, lengths[at]] = seen[at]
            is_success = self._flags(info, "is_success")
            success = np.where(stepped, is_success, success & ~broken)
            terminated |= stepped & is_end
            diverged |= broken
            live = live & ~broken & ~(stepped & (is_end | is_cut))
            begins = live & ~holds  # a step
        on_host = views.cpu().numpy()
        return {
            world: Episode(
                obs=on_host[world, : lengths[world] + 1],  # type: ignore[arg-type]
                actions=actions[world, : lengths[world]],  # type: ignore[arg-type]
                rewards=rewards[world, : lengths[world]].tolist(),
                terminated=bool(terminated[world]),
                success=float(success[world]),
                faults={"diverged": int(diverged[world]), "warnings": 0},
            )
            for world in rngs
        }

    def _flags(self, info: dict[str, Any], name: str) -> Array:
        return np.broadcast_to(info.get(name, False), self.env.num_envs)

    def _whole(self, obs: dict[str, Tensor]) -> Tensor:
        return torch.cat([obs[key] for key in VIEW], dim=-1)


def _finite(episodes: list[Episode]) -> list[Episode]:
    """Return episodes; DivergenceError where one has what is not finite, as in a single run."""
    for episode in episodes:
        finite(episode.obs, OBS)
        finite(episode.rewards, REWARD)
    return episodes


class BatchPPO(BatchLearner):
    """Learn E runs by PPO."""

    def build(self) -> None:
        """Stack actors, each with its standard deviations, and critics."""
        self.own, self.size = self.columns(self.n_goal), self.width + self.n_goal
        place, singles = (self.own, self.size, self.device), self.learners
        actors = [
            [(one.actor, one.actor_adam), (one.gaussian, one.std_adam)]
            for one in singles
        ]
        critics = [[(one.critic, one.critic_adam)] for one in singles]
        self.actor, self.critic = Networks(actors, *place), Networks(critics, *place)
        self.networks = self.actor, self.critic
        self.look()

    def look(self) -> None:
        """Scale what networks are given as the runs' normalizers now do."""
        stats = [one.obs_stats for one in self.learners]
        self.scale = stacked(stats, self.own, self.size, self.device)

    def act(self, seen: Tensor) -> Tensor:
        return self.actor(self.scale(seen[..., : self.size]))

    def _std(self) -> Tensor:
        """Return each run's standard deviation of actions, (E, 1, d)."""
        at_start = self.hyper["action_variance"].sqrt()[..., None]
        return at_start * self.actor.flat[:, None, -self.n_actions :].exp()

    def _log_prob(self, inputs: Tensor, actions: Tensor) -> Tensor:
        normal = torch.distributions.Normal(
            self.actor(inputs), self._std(), validate_args=False
        )
        return normal.log_prob(actions).sum(dim=-1)  # type: ignore[no-untyped-call, no-any-return]

    def explore(self, rngs: Rngs) -> Explore:
        """Draw the noise of whole episodes at once."""
        n, n_steps = self.env.num_envs, self.env.max_episode_steps
        noise = np.zeros((n, n_steps + 1, self.n_actions), np.float32)
        stds = self._std()[:, 0].cpu().numpy()
        for world, rng in rngs.items():
            drawn = rng.standard_normal((n_steps, self.n_actions), dtype=np.float32)
            noise[world, :-1] = stds[world // self.n_worlds] * drawn
        return lambda actions, steps: actions + noise[np.arange(n), steps]

    def update(self) -> Rows:
        """Take `n_passes` over each run's batch, in minibatches of its own."""
        prepared = {i: self.tried(i, self.learners[i].prepare) for i in self.on}
        batches = {i: each[0] for i, each in prepared.items() if each}
        verdicts = {i: each[1] for i, each in prepared.items() if each}
        if not batches:
            return {}
        for i in batches:  # critics have another unit of rewards, actors may be undone
            self.actor.read(i)
            self.critic.read(i)
        batch = self._stacked(batches)
        learns = self.mask([i for i in batches if verdicts[i] == "learn"])
        n = self.actor.flat.shape[1] - self.n_actions
        rates = self.rate("actor_adam").expand(-1, n), self.rate("std_adam")
        actor_lr = torch.cat([rates[0], rates[1].expand(-1, self.n_actions)], dim=1)
        lr = actor_lr, self.rate("critic_adam")
        passes = {i: self.learners[i].shuffled(len(batches[i].obs)) for i in self.on}
        sums = torch.zeros(len(self.learners), 4, device=self.device)
        n_updates, going = dict.fromkeys(self.on, 0), [*self.on]
        for _ in range(self.config.n_passes):
            minibatches = {i: next(passes[i]) for i in going}
            last_kl = torch.zeros_like(sums[:, 0])
            for rows in self._rows_of(minibatches):
                stats = self._step(batch, rows, learns, lr)
                sums += stats
                last_kl = torch.where((rows >= 0).any(dim=1), stats[:, 1], last_kl)
            for i in going:
                n_updates[i] += len(minibatches[i])
            if self.config.target_kl is not None:
                kl = last_kl.tolist()
                limits = [one.config.target_kl for one in self.learners]
                going = [i for i in going if not kl[i] > limits[i]]
            if not going:
                break
        said, names = Rows(), (*ActorLoss._fields, "value_loss")
        for i, means in self.means(sums, n_updates, self.actor, self.critic).items():
            self.write(i)
            after = self.learners[i].after_update(batches[i], verdicts[i], n_updates[i])
            said[i] = dict(zip(names, means, strict=True)) | after
        self.look()
        return said

    def _stacked(self, batches: Mapping[int, Transitions]) -> Transitions:
        """Return the transitions of all runs (E, n, ...); inputs that a run does not have are 0."""
        empty = Transitions(*(part[:0] for part in next(iter(batches.values()))))
        each = []
        for i, own in enumerate(self.own):
            one = batches.get(i, empty)
            inputs = torch.zeros(len(one.obs), self.size, device=self.device)
            inputs[:, own[: one.obs.shape[1]]] = one.obs
            each.append(one._replace(obs=inputs))
        return Transitions(*map(self._padded, zip(*each, strict=True)))

    def _padded(self, parts: Iterable[Tensor], value: float = 0.0) -> Tensor:
        """Return tensors (n, ...) of all runs as one on the device, (E, most, ...)."""
        return pad_sequence([*parts], True, padding_value=value).to(self.device)

    def _rows_of(self, minibatches: Mapping[int, Sequence[Tensor]]) -> Iterator[Tensor]:
        """Yield the rows of each minibatch of all runs, (E, size); -1 where a run has none."""
        none = torch.zeros(0, dtype=torch.long, device=self.device)
        each = (minibatches.get(i, ()) for i in range(len(self.learners)))
        return (self._padded(parts, -1) for parts in zip_longest(*each, fillvalue=none))

    def _step(
        self,
        batch: Transitions,
        rows: Tensor,
        learns: Tensor,
        lr: Sequence[Tensor],
    ) -> Tensor:
        """Take an Adam step of critics, and of actors that learn, on a minibatch of each run.

        Returns policy loss, KL estimate, clipped fraction and value loss, (E, 4).
        """
        mask, is_any = rows >= 0, (rows >= 0).any(dim=1, keepdim=True).float()
        share = mask / mask.sum(dim=1, keepdim=True).clamp(min=1)
        batch = Transitions(*(part[self.e, rows.clamp(min=0)] for part in batch))
        log_ratio = self._log_prob(batch.obs, batch.actions) - batch.log_prob
        result = surrogate(log_ratio, batch.advantages, self.hyper["clip_range"])
        errors = (self.critic(batch.obs)[..., 0] - batch.returns).square()
        parts = [result.loss, result.kl, result.is_clipped, errors]
        stats = torch.stack([(part * share).sum(dim=1) for part in parts], dim=1)
        loss = stats[:, 0].sum() + stats[:, 3].sum()
        of_actor, of_critic = torch.autograd.grad(
            loss, [self.actor.flat, self.critic.flat]
        )
        if self.config.exploration == "fixed":
            of_actor[:, -self.n_actions :] = 0.0
        self.actor.step(self._clipped(of_actor), lr[0], is_any * learns)
        self.critic.step(self._clipped(of_critic), lr[1], is_any)
        stats = stats.detach()
        return torch.cat([stats[:, :3] * learns, stats[:, 3:]], dim=1)

    def _clipped(self, gradient: Tensor) -> Tensor:
        norm = gradient.norm(dim=1, keepdim=True)
        return gradient * (self.hyper["max_grad_norm"] / (norm + 1e-6)).clamp(max=1.0)


class BatchDDPGHER(BatchLearner):
    """Learn E runs by DDPG with hindsight."""

    def build(self) -> None:
        """Stack networks and their targets, and what networks see of the replays."""
        n_goal, n_actions, singles = self.n_goal, self.n_actions, self.learners
        self.own = self.columns(2 * n_goal)

        def networks(name: str, n_more: int, adam: str = "") -> Networks:
            runs = [
                [(getattr(one, name), getattr(one, adam) if adam else None)]
                for one in singles
            ]
            width = self.width + n_more
            return Networks(runs, self.columns(n_more), width, self.device)

        self.actor = networks("actor", n_goal, "actor_adam")
        self.target_actor = networks("target_actor", n_goal)
        self.critic = networks("critic", n_goal + n_actions, "critic_adam")
        self.target_critic = networks("target_critic", n_goal + n_actions)
        self.networks = self.actor, self.critic, self.target_actor, self.target_critic
        n_steps = singles[0].replay.max_steps + 1
        shape = len(singles), 32, n_steps, self.width + n_actions
        self.memory = torch.zeros(shape, device=self.device)  # observations and actions
        for i, one in enumerate(singles):
            self._memorize(i, range(one.replay.n_episodes))
        self.look()

    def look(self) -> None:
        """Scale what networks are given as the runs' normalizers now do."""
        obs = [one.obs_stats for one in self.learners]
        goals = [one.goal_stats for one in self.learners]
        of_goals = [torch.arange(self.n_goal)] * len(goals)
        self.inputs = GoalInputs(
            stacked(obs, self.columns(0), self.width, self.device),
            stacked(goals, of_goals, self.n_goal, self.device),
            self.hyper["clip_obs"][..., None],
        )

    def act(self, seen: Tensor) -> Tensor:
        obs, goal, _ = seen.split([self.width, self.n_goal, self.n_goal], dim=-1)  # type: ignore[no-untyped-call]
        return self.actor(self.inputs(obs, goal))

    def explore(self, rngs: Rngs) -> Explore:
        """Draw the noise of whole episodes at once, in the order of the single learner's steps."""
        shape = self.env.max_episode_steps, self.env.num_envs
        noise = np.zeros((*shape, self.n_actions), np.float32)
        uniform = np.zeros((*shape, 1 + self.n_actions))
        for world, rng in rngs.items():
            for t in range(len(noise)):
                rng.standard_normal(out=noise[t, world], dtype=np.float32)
                rng.random(out=uniform[t, world])
        configs = [one.config.acting(one.progress_remaining) for one in self.learners]
        values = [[c.noise_eps, c.random_eps, c.random_hold] for c in configs]
        of_worlds = np.repeat(values, self.n_worlds, axis=0)
        noise_eps, *chances = np.split(of_worlds, 3, axis=1)
        # Its own generator draws nothing: all is drawn above.
        exploration = Exploration(np.random.default_rng(), noise_eps, *chances)
        noise *= noise_eps.astype(np.float32)
        drawn = (2.0 * uniform[..., 1:] - 1.0).astype(np.float32)
        steps = [*map(exploration.advance, uniform[..., :1], drawn)]
        is_random, random = map(np.stack, zip(*steps, strict=True))

        def explored(actions: Array, steps: Array) -> Array:
            at = steps.clip(max=len(noise) - 1), np.arange(len(steps))
            noisy = np.clip(actions + noise[at], -1.0, 1.0)
            return np.where(is_random[at], random[at], noisy)

        return explored

    def collect(self) -> Rows:
        rows = super().collect()
        for i in self.on:
            self._memorize(i, self.learners[i].new_slots)
        self.look()
        return rows

    def test(self, asked: Iterable[int]) -> Rows:
        n = self.config.n_test_rollouts * self.config.n_rollouts
        runs = [i for i in asked if n and i not in self.failures]
        keys = {i: self.learners[i].key(rollout.TEST) for i in runs}
        return {i: tested(row) for i, row in self.play_best(keys, n).items()}

    def _memorize(self, i: int, slots: Sequence[int]) -> None:
        """Copy episodes of a run's replay to the device."""
        while max(slots, default=0) >= self.memory.shape[1]:
            more = torch.zeros_like(self.memory)
            self.memory = torch.cat([self.memory, more], dim=1)
        for slot in slots:
            obs, action = map(torch.from_numpy, self.learners[i].replay.episode(slot))
            rows = self.memory[i, slot, : len(obs)]
            rows[:, : obs.shape[1]] = obs.to(self.device)
            rows[:, self.width :] = action.to(self.device)

    def update(self) -> Rows:
        """Take one cycle's updates of each active run, and move its target networks."""
        if not self.on:
            return {}
        config, n, singles = self.config, self.config.n_batches, self.learners
        drawn = dict[int, Relabelled]()
        for i in self.on:
            one = singles[i]
            drawn[i] = one.replay.relabel(n * config.batch_size, one.config.replay_p)
            one.updates += n
            if (factor := one.rescale(drawn[i].reward)) != 1.0:
                self.write(i)
                for critic in (one.critic, one.target_critic):
                    critic.scale_outputs(factor)
                self.critic.read(i)
                self.target_critic.read(i)
        scales = [one.reward_scale for one in singles]
        self.unit = self.numbers(scale.unit for scale in scales)
        self.span = [
            self.numbers(bounds) / self.unit
            for bounds in zip(*((s.lowest, s.highest) for s in scales), strict=True)
        ]
        self.action_l2 = self.numbers(one.action_l2 for one in singles)[:, 0]
        self.lr = self.rate("actor_adam"), self.rate("critic_adam")
        self.is_on = self.mask(self.on)
        sums = torch.zeros(len(singles), 3, device=self.device)
        for i, minibatch in enumerate(self._minibatches(drawn), start=1):
            sums += self._step(minibatch)
            if i % (config.target_update_interval or n) == 0 or i == n:
                self._move_targets()
        rows, n_updates = Rows(), dict.fromkeys(self.on, n)
        for i, means in self.means(sums, n_updates, self.actor, self.critic).items():
            rows[i] = dict(zip(LOSSES, means, strict=True)) | {"updates": n}
            rows[i]["mean_q"] *= scales[i].unit
        return rows

    def _minibatches(self, drawn: Mapping[int, Relabelled]) -> Iterator[Batch]:
        """Return minibatches of drawn transitions (E, n, ...); of runs that are off, any."""
        first = next(iter(drawn.values()))
        each = [drawn.get(i, first) for i in range(len(self.learners))]
        stacks = (torch.from_numpy(np.stack(part)) for part in zip(*each, strict=True))
        one = Relabelled(*(part.to(self.device) for part in stacks))
        here = self.memory[self.e, one.slot, one.step]
        following = self.memory[self.e, one.slot, one.step + 1]
        batch = Batch(
            obs=self.inputs(here[..., : self.width], one.goal),
            goal=one.goal,
            action=here[..., self.width :],
            reward=one.reward,
            next_obs=self.inputs(following[..., : self.width], one.goal),
            terminal=one.terminal,
        )
        parts = (part.split(self.config.batch_size, dim=1) for part in batch)  # type: ignore[no-untyped-call]
        return (Batch(*minibatch) for minibatch in zip(*parts, strict=True))

    def _step(self, batch: Batch) -> Tensor:
        """Take an Adam step of critics and actors, both from the same parameters.

        Returns the critics' losses, the actors' and the mean Q of the actors' actions, (E, 3).
        """
        errors = q_values(self.critic, batch.obs, batch.action) - self._targets(batch)
        errors = errors.square().mean(dim=1)
        (of_critic,) = torch.autograd.grad(errors.sum(), [self.critic.flat])
        losses, mean_q = actor_loss(self.actor, self.critic, batch.obs, self.action_l2)
        (of_actor,) = torch.autograd.grad(losses.sum(), [self.actor.flat])
        self.actor.step(of_actor, self.lr[0], self.is_on)
        self.critic.step(of_critic, self.lr[1], self.is_on)
        return torch.stack([errors, losses, mean_q], dim=1).detach()

    @torch.no_grad()
    def _targets(self, batch: Batch) -> Tensor:
        """Return the critics' targets (E, n), from the target networks."""
        actions = self.target_actor(batch.next_obs)
        values = q_values(self.target_critic, batch.next_obs, actions)
        terminal = batch.terminal * (self.config.termination == "terminal")
        span = self.span if self.config.clip_target else None
        return td_targets(
            batch.reward / self.unit, values, terminal, self.hyper["gamma"], span
        )

    @torch.no_grad()
    def _move_targets(self) -> None:
        """Move the target networks by 1 - polyak towards actors and critics."""
        share = (1.0 - self.hyper["polyak"]) * self.is_on
        self.target_actor.flat.lerp_(self.actor.flat, share)
        self.target_critic.flat.lerp_(self.critic.flat, share)


BATCHED: dict[type, type[Any]] = {PPO: BatchPPO, DDPGHER: BatchDDPGHER}
"""Learners that a batch has a form of."""
