"""Learn many runs of one kind at once, each as it would learn alone.

Each run has its single learner, PPO or DDPGHER. That draws all random numbers, keeps and relabels
episodes, follows rewards and computes advantages, as it does by itself. Here are the two things that
are faster for all runs together: playing, in a vector environment, and the networks. Those are
stacked: every tensor has the runs in front, (E, ...).

Episodes are whole, and those of the single learner: number and key give their start and their noise.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from itertools import compress, count, zip_longest
from operator import itemgetter
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector
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
from .learner import restore
from .networks import MLP, layer_shapes
from .normalizer import Normalizer, Scaling
from .ppo import PPO, ActorLoss, explained_variance, surrogate
from .replay import Batch, Relabelled
from .rollout import Episode, Key, finite, summary

BETAS, EPS = (0.9, 0.999), 1e-8  # Adam's
MOMENTS = ("exp_avg", "exp_avg_sq")  # their names in the state of PyTorch's Adam
LOSSES = ("critic_loss", "actor_loss", "mean_q")  # of DDPG
Rngs = Mapping[int, np.random.Generator]  # of worlds that begin
T = TypeVar("T")
Rows = dict[int, dict[str, float]]  # of the progress table, by run
Explore = Callable[[Array, Array], Array]
"""Return actions (n, d) to take from those of the policy and the numbers of their steps (n,)."""


def alike(config: Any) -> tuple[Any, ...]:
    """Return what configurations of one batch have in common: all but the values of floats."""
    values = vars(config).items()
    fixed = ((name, "" if isinstance(x, float) else x) for name, x in values)
    return type(config), *fixed


# -- networks --------------------------------------------------------------------------------


class Single(NamedTuple):
    """Say where a run's own network is in a row of `Networks`, and what is written back to."""

    places: Tensor
    """Places of its parameters in the row."""
    parts: list[list[Tensor]]
    """Its parameters, and their moments by the names in `MOMENTS`."""
    states: list[dict[str, Tensor]]
    """Each parameter's state of its Adam."""


class Networks:
    """Hold one network of each run in one tensor, `flat` (E, parameters), and its Adam.

    Inputs that a run does not have are zero, and so stay their weights.
    """

    def __init__(
        self,
        runs: Sequence[tuple[MLP, Sequence[nn.Parameter], Sequence[torch.optim.Adam]]],
        columns: Sequence[Tensor],
        width: int,
        device: torch.device,
    ) -> None:
        """Stack each run's network, more parameters of no layer, and the moments of its Adams.

        `columns` are the places of each one's inputs among all `width`.
        """
        first, more, _ = runs[0]
        self.is_tanh = isinstance(first[-1], nn.Tanh)
        sizes = [width, *(linear.out_features for linear in first.linears)]
        self.shapes = layer_shapes(sizes)
        self.sizes = [*map(math.prod, self.shapes), sum(p.numel() for p in more)]
        shape = len(runs), sum(self.sizes)
        self.flat, *self.moments = (torch.zeros(shape, device=device) for _ in range(3))
        self.n_steps = torch.zeros(len(runs), 1, device=device)
        self.singles = list[Single]()
        for i, (network, more, adams) in enumerate(runs):
            weights, others = torch.arange(shape[1]).tensor_split([self.sizes[0]])
            own = weights.view(self.shapes[0])[:, columns[i]].ravel()
            parameters = [*network.parameters(), *more]
            owners = {p: adam for adam in adams for p in adam.param_groups[0]["params"]}
            states = [_moments(p, owners.get(p)) for p in parameters]
            parts = [[s[name] for s in states] for name in MOMENTS]
            parts = [[p.detach() for p in parameters], *parts]
            single = Single(torch.cat([own, others]), parts, states)
            self.singles.append(single)
            for row, tensors in zip((self.flat, *self.moments), parts, strict=True):
                row[i, single.places] = parameters_to_vector(tensors).to(device)
            self.n_steps[i] = max(float(state["step"]) for state in states)
        self.state = self.flat.detach(), self.n_steps, *self.moments
        self.flat.requires_grad_()

    @torch.no_grad()
    def write(self, i: int) -> None:
        """Write run `i` into its own network and Adams."""
        single = self.singles[i]
        for row, tensors in zip((self.flat, *self.moments), single.parts, strict=True):
            own, sizes = row[i].cpu()[single.places], [part.numel() for part in tensors]
            values = own.split(sizes)  # type: ignore[no-untyped-call]
            for part, value in zip(tensors, values, strict=True):
                part.copy_(value.view_as(part))
        for state in single.states:
            state["step"].copy_(self.n_steps[i, 0])

    def __call__(self, x: Tensor) -> Tensor:
        """Return outputs (E, n, outputs) for inputs (E, n, width)."""
        pieces = self.flat.split(self.sizes, dim=1)  # type: ignore[no-untyped-call]
        last = len(self.shapes) - 2
        for k in range(0, last + 1, 2):
            weight = pieces[k].unflatten(1, self.shapes[k])
            x = torch.baddbmm(pieces[k + 1][:, None], x, weight.transpose(1, 2))
            x = x.relu() if k < last else x
        return x.tanh() if self.is_tanh else x

    @torch.no_grad()
    def scale_outputs(self, factor: Tensor) -> None:
        """Multiply what each run's last layer returns by a factor (E, 1), as MLP's does."""
        for piece in self.flat.split(self.sizes, dim=1)[-3:-1]:  # type: ignore[no-untyped-call]
            piece.mul_(factor)

    @torch.no_grad()
    def step(self, gradient: Tensor, lr: Tensor, on: Tensor) -> None:
        """Take an Adam step of the runs where `on` (E, 1) is 1; `lr` is (E, 1) or (E, parameters)."""
        mean, square = self.moments
        gradient = torch.where(on == 1, gradient, 0.0)  # 0 * inf is NaN
        self.n_steps += on
        mean.lerp_(gradient, on * (1 - BETAS[0]))
        square.lerp_(gradient.square(), on * (1 - BETAS[1]))
        n = self.n_steps.double().clamp(min=1.0)
        first, second = ((1 - beta**n).float() for beta in BETAS)
        size = (square.sqrt() / second.sqrt()).add_(EPS)
        self.flat.sub_(mean / size * (on * lr / first))

    @torch.no_grad()
    def take(self, others: Networks, on: Tensor) -> None:
        """Become like others, with their Adams, in the runs where `on` (E, 1) is 1."""
        for own, other in zip(self.state, others.state, strict=True):
            own.copy_(torch.where(on == 1, other, own))


def _moments(p: nn.Parameter, adam: torch.optim.Adam | None) -> dict[str, Tensor]:
    """Return an Adam's state of a parameter, in which nothing was done where it has none."""
    state = {name: torch.zeros_like(p).detach() for name in MOMENTS}
    state["step"] = torch.tensor(0.0)
    if adam is None or not p.requires_grad:
        return state
    mine: dict[str, Tensor] = adam.state.setdefault(p, state)
    return mine


def stacked(
    stats: Sequence[Normalizer], columns: Sequence[Tensor], width: int, device: Any
) -> Scaling:
    """Return what normalizers do to values now, (E, 1, width); where a run has no column it is 0."""
    parts = torch.zeros(4, len(stats), 1, width)
    for i, one in enumerate(stats):
        parts[:, i, 0, columns[i]] = torch.stack([*one.scaling()])
    return Scaling(*parts.to(device))


# -- episodes --------------------------------------------------------------------------------


class Worlds:
    """Play whole episodes of E runs in a vector environment, in W worlds each.

    Worlds `i` W to `(i + 1)` W are run `i`'s. They begin together, which resets them once; a run that
    has enough waits for the others.
    """

    def __init__(self, env: Any, n_runs: int) -> None:
        """Take Gymnasium's VectorEnv, whose observations are tensors, with autoreset off.

        Where its info has ``holding``, a step of those worlds is not over: it ends with the call that
        says so no more, and all actions but its first are ignored.
        """
        self.env, self.shape = env, (n_runs, env.num_envs // n_runs)

    @torch.no_grad()
    def play(
        self,
        keys: Mapping[int, Key],
        wants_more: Callable[[int, list[Episode]], bool],
        act: Callable[[Tensor], Tensor],
        explore: Callable[[Rngs], Explore],
    ) -> tuple[Tensor, dict[int, list[Episode]]]:
        """Play episodes 0, 1, 2, ... of the runs with these keys until each has enough of them.

        `act` returns actions (E, W, d) of observations (E, W, width); `explore` what adds noise from
        the generators of worlds that begin. Returns all observations (E, n, steps + 1, width), of
        which the first are those of a run's episodes, and these.
        """
        episodes = {i: list[Episode]() for i in keys}
        waves, wanted = list[Tensor](), dict(keys)
        while wanted:
            obs, played = self._wave(wanted, len(waves) * self.shape[1], act, explore)
            waves.append(obs)
            for world, episode in played.items():
                mine = episodes[i := world // self.shape[1]]
                if wants_more(i, mine):
                    mine.append(episode)
            wanted = {i: keys[i] for i in wanted if wants_more(i, episodes[i])}
        return torch.cat(waves, dim=1), episodes

    def _wave(
        self, keys: Mapping[int, Key], first: int, act: Any, explore: Any
    ) -> tuple[Tensor, dict[int, Episode]]:
        """Play one episode, number `first` and following, in each world of the runs with keys."""
        env, n, (_, n_worlds) = self.env, self.env.num_envs, self.shape
        rngs = {
            i * n_worlds + w: np.random.default_rng([*key, first + w])
            for i, key in keys.items()
            for w in range(n_worlds)
        }
        seeds: list[int | None] = [None] * n
        for world, rng in rngs.items():
            seeds[world] = int(rng.integers(2**31))
        with_noise = explore(rngs)
        live = np.isin(np.arange(n), [*rngs])
        obs, info = env.reset(seed=seeds, options={"reset_mask": live})
        seen, steps = self._whole(obs), env.max_episode_steps
        diverged = live & self._flags(info, "diverged")
        live = live & ~diverged
        views = seen.new_zeros(n, steps + 1, seen.shape[-1])
        views[:, 0] = seen
        actions = np.zeros((n, steps, *env.single_action_space.shape), np.float32)
        rewards, lengths = np.zeros((n, steps)), np.zeros(n, np.int64)
        success, terminated, takes_action = live & False, live & False, live
        while live.any():
            by_run = seen.unflatten(0, self.shape)  # type: ignore[no-untyped-call]
            chosen = with_noise(act(by_run).flatten(0, 1).cpu().numpy(), lengths)
            chosen = np.where(np.isnan(chosen), 0.0, chosen)  # of runs that fail
            actions[takes_action, lengths[takes_action]] = chosen[takes_action]
            on_device = torch.from_numpy(chosen.clip(-1.0, 1.0)).to(seen.device)
            obs, *results, info = env.step(on_device)
            reward, is_end, is_cut = (result.cpu().numpy() for result in results)
            seen, broken = self._whole(obs), live & self._flags(info, "diverged")
            is_over = live & ~self._flags(info, "holding")  # the step
            completed = is_over & ~broken
            rewards[completed, lengths[completed]] = reward[completed]
            lengths += completed
            at = np.flatnonzero(completed)
            views[at, lengths[at]] = seen[at]
            success = np.where(
                completed, self._flags(info, "is_success"), success & ~broken
            )
            terminated |= completed & is_end
            diverged |= broken
            live = live & ~broken & ~(completed & (is_end | is_cut))
            takes_action = is_over & live
        on_host = views.cpu().numpy()
        played = {
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
        return views.unflatten(0, self.shape), played  # type: ignore[no-untyped-call]

    def _flags(self, info: dict[str, Any], name: str) -> Array:
        flags = torch.as_tensor(info.get(name, False), dtype=torch.bool)
        return np.broadcast_to(flags.cpu().numpy(), self.env.num_envs)

    def _whole(self, obs: dict[str, Tensor]) -> Tensor:
        return torch.cat([obs[key] for key in VIEW], dim=-1)


# -- learners --------------------------------------------------------------------------------


class BatchLearner:
    """Learn E runs at once; `collect` and `update` in turn, as a single learner does.

    A run is active until it has its steps, or fails: `failures` says why, by run.
    """

    own: list[Tensor]
    """Places of a run's own in whole observations."""

    def __init__(self, learners: Sequence[Any], env: Any) -> None:
        """Stack learners whose configurations are `alike`; `env` has the same worlds for each."""
        self.learners, self.env = learners, env
        self.device = torch.device(env.device)
        self.worlds = Worlds(env, len(learners))
        self.cycles_per_epoch = learners[0].cycles_per_epoch
        self.config = learners[0].config  # but for floats, which are in `hyper`
        spaces = env.single_observation_space
        self.width, self.n_goal = (
            math.prod(spaces[key].shape) for key in ("observation", "desired_goal")
        )
        self.n_actions = math.prod(env.single_action_space.shape)
        self.e = torch.arange(len(learners), device=self.device)[:, None]
        self.failures, self.on = dict[int, str](), list[int]()
        values = vars(self.config).items()
        names = [name for name, value in values if isinstance(value, int | float)]
        each = [vars(one.config) for one in learners]
        self.hyper = {name: self.numbers(x[name] for x in each) for name in names}
        self.build()

    def build(self) -> None:
        """Stack the learners' networks; set `own`."""
        raise NotImplementedError

    def act(self, seen: Tensor) -> Tensor:
        """Return actions without exploration (E, W, d) from whole observations (E, W, ...)."""
        raise NotImplementedError

    def explore(self, rngs: Rngs) -> Explore:
        """Return the exploration of an episode in each of some worlds, with their generators."""
        raise NotImplementedError

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
    def active(self) -> list[bool]:
        """True for runs that go on."""
        return [
            one.env_steps < one.total_timesteps and i not in self.failures
            for i, one in enumerate(self.learners)
        ]

    def collect(self) -> Rows:
        """Play the episodes of each active run that it learns from next; return counts and means."""
        self.on, rows = [*compress(count(), self.active)], Rows()
        for i in self.on:
            self.learners[i].begin()
        keys = {i: self.learners[i].key(rollout.TRAIN) for i in self.on}
        self.obs, self.episodes = self.worlds.play(
            keys,
            lambda i, played: bool(self.tried(i, self.learners[i].wants_more, played)),
            self.act,
            self.explore,
        )
        for i in self.on:
            if row := self.tried(i, self._keep, i):
                rows[i] = row
        return rows

    def _keep(self, i: int) -> dict[str, float]:
        """Let run `i` keep its episodes, with its own part of the observations."""
        for episode in (episodes := _finite(self.episodes[i])):
            episode.obs = episode.obs[:, self.own[i]]  # type: ignore[call-overload]
        row: dict[str, float] = self.learners[i].keep(episodes)
        return row

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
            self.tried(i, self.learners[i].require_finite, rows[i])
        n = sums.shape[1]
        return {i: [x / n_updates[i] for x in rows[i][:n]] for i in self.on}

    def play_best(self, keys: Mapping[int, Key], n: int) -> Rows:
        """Return counts and means of `n` episodes without exploration of the runs with keys."""
        if not keys:
            return {}
        _, episodes = self.worlds.play(
            keys,
            lambda _, played: len(played) < n,
            self.act,
            lambda rngs: lambda actions, steps: actions,
        )
        usable = {i: self.tried(i, _finite, mine) for i, mine in episodes.items()}
        return {i: summary(mine) for i, mine in usable.items() if mine}

    def test(self, asked: Sequence[bool]) -> Rows:
        """Return how good the runs that are asked for (E,) are without exploration; may be empty."""
        return {}

    def write(self, i: int) -> None:
        """Write the state of run `i` into its single learner."""
        raise NotImplementedError


def _finite(episodes: list[Episode]) -> list[Episode]:
    """Return episodes; DivergenceError where one has what is not finite, as in a single run."""
    for episode in episodes:
        finite(episode.obs, "an observation of the environment")
        finite(episode.rewards, "the reward of the environment")
    return episodes


class BatchPPO(BatchLearner):
    """Learn E runs by PPO."""

    def build(self) -> None:
        """Stack networks, and the actors to which an undone update goes back."""
        self.own, self.size = self.columns(self.n_goal), self.width + self.n_goal
        place = self.own, self.size, self.device
        critics = [(one.critic, (), (one.critic_adam,)) for one in self.learners]
        self.critic = Networks(critics, *place)
        acting = [{n: getattr(one, n) for n in one.undoable} for one in self.learners]
        self.kept = copy.deepcopy(acting)
        self.has_before = set[int]()
        for i, one in enumerate(self.learners):
            if one.before_update:
                self.has_before.add(i)
                restore(self.kept[i], one.before_update)

        def networks(parts: Sequence[dict[str, Any]]) -> Networks:
            names = "actor", "gaussian", "actor_adam", "std_adam"
            each = (itemgetter(*names)(p) for p in parts)
            runs = [(actor, [g.log_std], adams) for actor, g, *adams in each]
            return Networks(runs, *place)

        self.actor, self.before = networks(acting), networks(self.kept)
        self.look()

    def look(self) -> None:
        """Scale what networks are given as the runs' normalizers now do."""
        stats = [one.obs_stats for one in self.learners]
        self.scale = stacked(stats, self.own, self.size, self.device)

    def _inputs(self, seen: Tensor) -> Tensor:
        """Return the networks' inputs (E, n, size) from whole observations (E, n, ...)."""
        return self.scale(seen[..., : self.size])

    def act(self, seen: Tensor) -> Tensor:
        return self.actor(self._inputs(seen))

    def _std(self) -> Tensor:
        """Return each run's standard deviation of actions, (E, 1, d)."""
        at_start = self.hyper["action_variance"].sqrt()[..., None]
        return at_start * self.actor.flat[:, None, -self.n_actions :].exp()

    def _policy(self, inputs: Tensor) -> torch.distributions.Normal:
        normal = torch.distributions.Normal
        return normal(self.actor(inputs), self._std(), validate_args=False)

    def explore(self, rngs: Rngs) -> Explore:
        """Draw the noise of whole episodes at once."""
        n, steps = self.env.num_envs, self.env.max_episode_steps
        noise = np.zeros((n, steps, self.n_actions), np.float32)
        stds = self._std()[:, 0].cpu().numpy()
        for world, rng in rngs.items():
            drawn = rng.standard_normal(noise.shape[1:], dtype=np.float32)
            noise[world] = stds[world // self.worlds.shape[1]] * drawn
        return lambda actions, steps: (
            actions + noise[np.arange(n), steps.clip(max=noise.shape[1] - 1)]
        )

    def update(self) -> Rows:
        """Take `n_passes` over each run's batch, in minibatches of its own."""
        batch, columns = self._batch()
        verdicts = {i: self.learners[i].judge() for i in self.on}
        learns = self._keep_or_undo(verdicts)
        actor, std, critic = map(self.rate, ("actor_adam", "std_adam", "critic_adam"))
        n = self.actor.flat.shape[1] - self.n_actions
        rates = [actor.expand(-1, n), std.expand(-1, self.n_actions)]
        lr = torch.cat(rates, dim=1), critic
        passes = {i: self.learners[i].shuffled(len(columns[i])) for i in self.on}
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
                kl, configs = last_kl.tolist(), [one.config for one in self.learners]
                going = [i for i in going if not kl[i] > configs[i].target_kl]
            if not going:
                break
        return self._report(sums, columns, verdicts, n_updates)

    @torch.no_grad()
    def _batch(self) -> tuple[list[Tensor], list[Tensor]]:
        """Return all runs' transitions (E, n, ...), and the columns (n, ...) of each by itself.

        The last columns are advantages, returns and values.
        """
        each = enumerate(self.learners)
        factors = (one.rescale() if i in self.on else 1.0 for i, one in each)
        self.critic.scale_outputs(self.numbers(factors))
        inputs = self._inputs(self.obs.flatten(1, 2))
        values = self.critic(inputs).view(self.obs.shape[:3]).cpu().double().numpy()
        n_rows = values.shape[2]
        places = [torch.zeros(0, dtype=torch.long)] * len(self.learners)
        columns = [torch.zeros(0, self.n_actions + 3)] * len(self.learners)
        for i in self.on:
            usable = [(k, len(e)) for k, e in enumerate(self.episodes[i]) if len(e)]
            mine = [values[i, k, : n + 1] for k, n in usable]
            if targets := self.tried(i, self.learners[i].targets, mine):
                taken = np.concatenate([e.actions for e in self.learners[i].episodes])
                whole = np.column_stack([taken, *targets]).astype(np.float32)
                rows = [k * n_rows + np.arange(n) for k, n in usable]
                columns[i] = torch.from_numpy(whole)
                places[i] = torch.from_numpy(np.concatenate(rows))
        padded = (
            pad_sequence(x, batch_first=True).to(self.device) for x in (places, columns)
        )
        where, parts = padded
        obs, actions = inputs[self.e, where], parts[..., : self.n_actions]
        log_prob = self._policy(obs).log_prob(actions).sum(dim=-1)  # type: ignore[no-untyped-call]
        return [obs, actions, log_prob, parts[..., -3], parts[..., -2]], columns

    def _keep_or_undo(self, verdicts: Mapping[int, str]) -> Tensor:
        """Keep actors, or go back to those kept, as the single learner does; return which learn."""
        learns, undone = (
            [i for i, verdict in verdicts.items() if verdict == one]
            for one in ("learn", "undo")
        )
        kept = [i for i in learns if self.learners[i].silence.can_undo]
        self.before.take(self.actor, self.mask(kept))
        self.actor.take(self.before, self.mask(undone))
        self.has_before |= {*kept}
        return self.mask(learns)

    def _rows_of(self, minibatches: Mapping[int, Sequence[Tensor]]) -> Iterator[Tensor]:
        """Yield the rows of each minibatch of all runs, (E, size); -1 where a run has none."""
        none = torch.zeros(0, dtype=torch.long)
        each = (minibatches.get(i, ()) for i in range(len(self.learners)))
        for parts in zip_longest(*each, fillvalue=none):
            yield pad_sequence([*parts], True, padding_value=-1).to(self.device)

    def _step(
        self,
        batch: Sequence[Tensor],
        rows: Tensor,
        learns: Tensor,
        lr: Sequence[Tensor],
    ) -> Tensor:
        """Take an Adam step of critics, and of actors that learn, on a minibatch of each run.

        Returns policy loss, KL estimate, clipped fraction and value loss, (E, 4).
        """
        mask, is_any = rows >= 0, (rows >= 0).any(dim=1, keepdim=True).float()
        share = mask / mask.sum(dim=1, keepdim=True).clamp(min=1)
        obs, actions, log_prob, advantages, returns = (
            part[self.e, rows.clamp(min=0)] for part in batch
        )
        log_ratio = self._policy(obs).log_prob(actions).sum(dim=-1) - log_prob  # type: ignore[no-untyped-call]
        result = surrogate(log_ratio, advantages, self.hyper["clip_range"])
        errors = (self.critic(obs)[..., 0] - returns).square()
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
        share = self.hyper["max_grad_norm"] / (
            gradient.norm(dim=1, keepdim=True) + 1e-6
        )
        return gradient * share.clamp(max=1.0)

    def _report(
        self, sums: Tensor, columns: Any, verdicts: Any, n_updates: Any
    ) -> Rows:
        """Return the rows of the table, as the single learner does, once moments are updated."""
        rows, names = Rows(), (*ActorLoss._fields, "value_loss")
        log_std = self.actor.flat[:, -self.n_actions :].detach().cpu()
        for i, means in self.means(sums, n_updates, self.actor, self.critic).items():
            one = self.learners[i]
            one.gaussian.log_std.data.copy_(log_std[i])
            explained = explained_variance(columns[i][:, -1], columns[i][:, -2])
            rows[i] = dict(zip(names, means, strict=True))
            rows[i] |= one.after_update(explained, verdicts[i], n_updates[i])
        self.look()
        return rows

    def write(self, i: int) -> None:
        one = self.learners[i]
        if i in self.has_before:
            self.before.write(i)
            states = {name: part.state_dict() for name, part in self.kept[i].items()}
            one.before_update = copy.deepcopy(states)
        self.actor.write(i)
        self.critic.write(i)


class BatchDDPGHER(BatchLearner):
    """Learn E runs by DDPG with hindsight."""

    def build(self) -> None:
        """Stack networks and their targets, and what networks see of the replays."""
        n_goal, n_actions = self.n_goal, self.n_actions
        self.own = self.columns(2 * n_goal)

        def networks(name: str, n_more: int, adam: str = "") -> Networks:
            runs = [
                (getattr(one, name), (), (getattr(one, adam),) if adam else ())
                for one in self.learners
            ]
            return Networks(
                runs, self.columns(n_more), self.width + n_more, self.device
            )

        self.actor = networks("actor", n_goal, "actor_adam")
        self.target_actor = networks("target_actor", n_goal)
        self.critic = networks("critic", n_goal + n_actions, "critic_adam")
        self.target_critic = networks("target_critic", n_goal + n_actions)
        n_steps = self.learners[0].replay.max_steps + 1
        shape = len(self.learners), 32, n_steps, self.width + n_actions
        self.memory = torch.zeros(shape, device=self.device)  # observations and actions
        for i, one in enumerate(self.learners):
            self._memorize(i, range(one.replay.n_episodes))
        self.look()

    def look(self) -> None:
        """Scale what networks are given as the runs' normalizers now do."""
        obs, goals = (
            [getattr(one, name) for one in self.learners]
            for name in ("obs_stats", "goal_stats")
        )
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
        of_worlds = np.repeat(values, self.worlds.shape[1], axis=0)
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

    def test(self, asked: Sequence[bool]) -> Rows:
        runs = [i for i in compress(count(), asked) if i not in self.failures]
        keys = {i: self.learners[i].key(rollout.TEST) for i in runs}
        n = self.config.n_test_rollouts * self.config.n_rollouts
        rows = self.play_best(keys, n) if n else {}
        return {i: tested(row) for i, row in rows.items()}

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
        drawn, factors = dict[int, Relabelled[Array]](), [1.0] * len(singles)
        for i in self.on:
            one = singles[i]
            drawn[i] = one.replay.relabel(n * config.batch_size, one.config.replay_p)
            factors[i] = one.rescale(drawn[i].reward)
            one.updates += n
        for critic in (self.critic, self.target_critic):
            critic.scale_outputs(self.numbers(factors))
        self.unit = self.numbers(one.rewards.unit for one in singles)
        bounds = [(one.rewards.lowest, one.rewards.highest) for one in singles]
        self.span = [
            self.numbers(each) / self.unit for each in zip(*bounds, strict=True)
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
            rows[i]["mean_q"] *= singles[i].rewards.unit
        return rows

    def _step(self, batch: Batch[Tensor]) -> Tensor:
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
    def _targets(self, batch: Batch[Tensor]) -> Tensor:
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

    def write(self, i: int) -> None:
        for networks in (
            self.actor,
            self.critic,
            self.target_actor,
            self.target_critic,
        ):
            networks.write(i)

    def _minibatches(
        self, drawn: Mapping[int, Relabelled[Array]]
    ) -> Iterator[Batch[Tensor]]:
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


BATCHED: dict[type, type[Any]] = {PPO: BatchPPO, DDPGHER: BatchDDPGHER}
"""Learners that a batch has a form of."""
