"""Learn many runs of one kind at once, each as it would learn alone.

Each run has its single learner, PPO or DDPGHER. That keeps and relabels episodes, follows rewards and
computes advantages, as it does by itself, and its equations are used for all. Here are the two things
that are faster for all runs together: playing, in a vector environment, and the networks. Those are
stacked: every tensor has the runs in front, (E, ...).

Episodes are whole, and those of the single learner: number and key give their start and their noise.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import zip_longest
from types import SimpleNamespace
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from . import Array, DivergenceError, rollout
from .ddpg_her import DDPGHER, VIEW, Exploration, tested
from .normalizer import Scaling
from .policy import OBS, SEEN, Noise, finite
from .ppo import PPO, ActorLoss, GaussianNoise, Transitions, surrogate
from .replay import Batch, Relabelled
from .rollout import REWARD, Episode, Key, summary

BETAS, EPS = (0.9, 0.999), 1e-8  # Adam's
MOMENTS = ("exp_avg", "exp_avg_sq")  # their names in the state of PyTorch's Adam
T = TypeVar("T")
Rows = dict[int, dict[str, float]]  # of the progress table, by run
Rngs = Mapping[int, np.random.Generator]  # of worlds that begin
Run = tuple[nn.Module, torch.optim.Adam | None]


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

    on: Tensor
    """1 for the runs whose Adams take a step, 0 for others, (E, 1)."""

    def __init__(
        self, runs: Sequence[Run], columns: Sequence[Tensor], device: torch.device
    ) -> None:
        """Stack the module of each run, with its Adam; `columns`, bool (width,), are its inputs."""
        self.runs, self.device = runs, device
        first, *rest = (p.shape for p in runs[0][0].parameters())
        self.shapes = [(*first[:-1], len(columns[0])), *rest]
        self.sizes = [*map(math.prod, self.shapes)]
        others = torch.ones(sum(self.sizes[1:]), dtype=torch.bool)
        self.places = [
            torch.cat([own.expand(self.shapes[0]).ravel(), others]) for own in columns
        ]
        self.rows = torch.zeros(3, len(runs), sum(self.sizes), device=device)
        self.flat = self.rows[0]
        self.n_steps = torch.zeros(len(runs), 1, device=device)
        for i in range(len(runs)):
            self.read(i)
        self.flat.requires_grad_()

    @torch.no_grad()
    def read(self, i: int) -> None:
        """Copy what run `i` has alone into its rows."""
        (module, adam), parts = self.runs[i], list[Tensor]()
        for p in module.parameters():
            state = adam.state.get(p, {}) if adam else {}
            moments = (state.get(name, torch.zeros_like(p)) for name in MOMENTS)
            parts.append(torch.stack([p, *moments]).flatten(1))
            self.n_steps[i] = state.get("step", 0.0)
        self.rows[:, i, self.places[i]] = torch.cat(parts, dim=1)

    @torch.no_grad()
    def write(self, i: int) -> None:
        """Copy the rows of run `i` into what it has alone."""
        (module, adam), rows = self.runs[i], self.rows[:, i, self.places[i]]
        parameters = [*module.parameters()]
        parts = torch.split(rows, [p.numel() for p in parameters], dim=1)
        for p, part in zip(parameters, parts, strict=True):
            value, *moments = part.unflatten(1, p.shape)  # type: ignore[no-untyped-call]
            p.copy_(value)
            if adam:
                adam.state[p]["step"] = self.n_steps[i, 0].clone()
                for name, moment in zip(MOMENTS, moments, strict=True):
                    adam.state[p][name] = moment.clone()

    def __call__(self, x: Tensor) -> Tensor:
        """Return what MLPs return (E, n, outputs) for inputs (E, n, width)."""
        pieces = self.flat.split(self.sizes, dim=1)  # type: ignore[no-untyped-call]
        parts = [p.unflatten(1, s) for p, s in zip(pieces, self.shapes, strict=True)]
        for layer in self.runs[0][0].children():
            if isinstance(layer, nn.Linear):
                weight, bias, *parts = parts
                x = torch.baddbmm(bias[:, None], x, weight.mT)
            else:
                x = layer(x)
        return x

    def parameters(self) -> list[Tensor]:
        """Return all parameters, as a module does."""
        return [self.flat]

    @torch.no_grad()
    def scale_outputs(self, i: int, factor: float) -> None:
        """Multiply what the last layer of run `i` returns by `factor`."""
        self.flat[i, -sum(self.sizes[-2:]) :] *= factor

    def zero_grad(self) -> None:
        """Forget the last gradient, as Adam does."""
        self.flat.grad = None

    def take_rates(self) -> None:
        """Learn at the rates that the runs' own Adams have now."""
        rates = [[adam.param_groups[0]["lr"]] for _, adam in self.runs if adam]
        self.lr = torch.tensor(rates, device=self.device)

    @torch.no_grad()
    def step(self) -> None:
        """Take an Adam step in the runs where `on` is 1."""
        (flat, mean, square), on = self.rows, self.on
        gradient: Any = self.flat.grad
        gradient = torch.where(on == 1, gradient, 0.0)  # 0 * inf is NaN
        self.n_steps += on
        mean.lerp_(gradient, on * (1 - BETAS[0]))
        square.lerp_(gradient.square(), on * (1 - BETAS[1]))
        n = self.n_steps.double().clamp(min=1.0)
        first, second = ((1 - beta**n).float() for beta in BETAS)
        size = (square.sqrt() / second.sqrt()).add_(EPS)
        flat.sub_(mean / size * (on * self.lr / first))


def spread(values: Tensor, columns: Tensor) -> Tensor:
    """Return values (..., n) in the n columns of (..., width) that are True, and 0 in the others."""
    whole = values.new_zeros(*values.shape[:-1], len(columns))
    whole[..., columns] = values
    return whole


# -- learners --------------------------------------------------------------------------------


class BatchLearner:
    """Learn E runs at once; `collect` and `update` in turn, as a single learner does.

    A run is active until it has its steps, or fails: `failures` says why, by run. It plays in W worlds
    of its own, `i` W to `(i + 1)` W, all at once; one that has enough episodes waits for the others.
    """

    view: ClassVar[Sequence[str]]
    """Parts of observations that a single learner keeps; networks see the first two."""
    stats: ClassVar[Sequence[str]]
    """Names of the normalizers of what networks see."""
    n_tests = 0
    """Number of episodes of a test at the end of an epoch."""
    networks: Sequence[Networks]
    """All that `write` gives back to the single learners."""

    def __init__(self, learners: Sequence[Any], env: Any) -> None:
        """Stack learners whose configurations are `alike`; `env` has the same worlds for each.

        It is Gymnasium's VectorEnv, whose observations are tensors, with autoreset off. Where its info
        has ``holding``, a step of those worlds is not over: it ends with the call that says so no more,
        and all actions but its first are ignored. The episode ends with that step.
        """
        self.learners, self.env = learners, env
        self.n_worlds = env.num_envs // len(learners)
        self.device = torch.device(env.device)
        self.cycles_per_epoch = learners[0].cycles_per_epoch
        config = learners[0].config
        floats = {
            name: self.numbers(getattr(one.config, name) for one in learners)
            for name, value in vars(config).items()
            if isinstance(value, float)
        }
        self.config = dataclasses.replace(config, **floats)
        """The hyperparameters, of which floats are (E, 1)."""
        spaces = env.single_observation_space
        self.width, self.n_goal = (
            spaces[key].shape[0] for key in ("observation", "desired_goal")
        )
        self.n_actions = env.single_action_space.shape[0]
        self.e = torch.arange(len(learners), device=self.device)[:, None]
        self.kept = self.columns(self.n_goal * (len(self.view) - 1))
        self.failures, self.on = dict[int, str](), list[int]()
        self.inputs = self.columns(self.n_goal)
        self.actor = self.stacked("actor", self.inputs, "actor_adam")
        self.build()

    def build(self) -> None:
        """Stack the critics, and all else that an algorithm has; set `networks`."""
        raise NotImplementedError

    def look(self) -> None:
        """Scale what networks are given as the single learners' normalizers now do."""
        each = list[Tensor]()
        for one, own in zip(self.learners, self.inputs, strict=True):
            stats = (getattr(one, name).scaling() for name in self.stats)
            parts = torch.cat([torch.stack([*scaling]) for scaling in stats], dim=1)
            each.append(spread(parts, own))
        self.scale = Scaling(*torch.stack(each, dim=1)[:, :, None].to(self.device))

    def scaled(self, seen: Tensor) -> Tensor:
        """Return what networks are given for observations and goals side by side, (E, n, ...)."""
        return self.scale(seen)

    def explore(self, rngs: Rngs) -> Noise:
        """Return the exploration of an episode in each of some worlds, with their generators."""
        raise NotImplementedError

    def write(self, i: int) -> None:
        """Write the state of run `i` into its single learner."""
        for networks in self.networks:
            networks.write(i)

    def columns(self, n_more: int) -> list[Tensor]:
        """Return which inputs each run has: its own part of the observation, and all of `n_more`."""
        columns = torch.ones(len(self.learners), self.width + n_more, dtype=torch.bool)
        for own, one in zip(columns, self.learners, strict=True):
            own[one.n_inputs - self.n_goal : self.width] = False
        return [*columns]

    def stacked(self, name: str, columns: Sequence[Tensor], adam: str = "") -> Networks:
        """Return the networks that single learners have by this name, with their Adams, if any."""
        runs = [(getattr(one, name), getattr(one, adam, None)) for one in self.learners]
        return Networks(runs, columns, self.device)

    def numbers(self, values: Iterable[float]) -> Tensor:
        """Return a number of each run, (E, 1)."""
        return torch.tensor([[float(x)] for x in values], device=self.device)

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

    def checked(self, names: Iterable[str], means: Tensor) -> Rows:
        """Return means (k, E) by run; one with means or parameters that are not finite fails."""
        weights = [networks.flat.sum(dim=1) for networks in self.networks]
        rows = torch.stack([*means, *weights], dim=1).tolist()
        for i in self.on:
            self.tried(i, self.learners[i].check_learned, rows[i])
        return {i: dict(zip(names, rows[i], strict=False)) for i in self.on}

    # -- episodes ----------------------------------------------------------------------------

    def collect(self) -> Rows:
        """Play the episodes of each active run that it learns from next; return counts and means."""
        self.on = self.active
        for i in self.on:
            self.learners[i].begin()
        episodes = self.play({i: self.learners[i].key(rollout.TRAIN) for i in self.on})
        rows = Rows()
        for i in self.on:
            if row := self.tried(i, self.learners[i].keep, episodes[i]):
                rows[i] = row
        return rows

    def play_best(self, keys: Mapping[int, Key], n: int) -> Rows:
        """Return counts and means of `n` episodes without exploration of the runs with keys."""
        played = self.play(keys, n)
        return {
            i: summary(mine) for i, mine in played.items() if i not in self.failures
        }

    def test(self, runs: Iterable[int]) -> Rows:
        """Return how good these runs are without exploration, where their learner tests that."""
        playing = [i for i in runs if self.n_tests and i not in self.failures]
        keys = {i: self.learners[i].key(rollout.TEST) for i in playing}
        return {i: tested(row) for i, row in self.play_best(keys, self.n_tests).items()}

    @torch.no_grad()
    def play(
        self, keys: Mapping[int, Key], n: int | None = None
    ) -> dict[int, list[Episode]]:
        """Play episodes 0, 1, 2, ... of the runs with these keys until each has enough to learn from.

        Or `n` episodes of each, without exploration.
        """
        self.look()
        episodes = {i: list[Episode]() for i in keys}

        def wants_more(i: int) -> bool:
            if n is not None:
                return len(episodes[i]) < n
            return bool(self.tried(i, self.learners[i].wants_more, episodes[i]))

        wanted, first = [*keys], 0
        while wanted:
            now = {i: keys[i] for i in wanted}
            for world, episode in self._wave(now, first, n is None).items():
                if wants_more(i := world // self.n_worlds):
                    episodes[i].append(episode)
            wanted = [*filter(wants_more, wanted)]
            first += self.n_worlds
        return episodes

    def _wave(
        self, keys: Mapping[int, Key], first: int, explores: bool
    ) -> dict[int, Episode]:
        """Play one episode, number `first` and following, in each world of the runs with keys."""
        env, n, n_worlds = self.env, self.env.num_envs, self.n_worlds
        rngs = {
            i * n_worlds + w: np.random.default_rng([*key, first + w])
            for i, key in keys.items()
            for w in range(n_worlds)
        }
        seeds: list[int | None] = [None] * n
        for world, rng in rngs.items():
            seeds[world] = int(rng.integers(2**31))
        explore: Noise = self.explore(rngs) if explores else np.asarray
        every, n_rows = np.arange(n), env.max_episode_steps + 1
        live = np.isin(every, [*rngs])
        obs, info = env.reset(seed=seeds, options={"reset_mask": live})
        diverged = live & info["diverged"]
        seen = self._whole(obs)
        # Rows of a world from its length on mean nothing.
        views = seen.new_zeros(n, n_rows, seen.shape[-1])
        views[:, 0] = seen
        actions = np.zeros((n, n_rows, self.n_actions), np.float32)
        rewards, lengths = np.zeros((n, n_rows)), np.zeros(n, np.int64)
        success, terminated = live & False, live & False
        begins = live = live & ~diverged
        while live.any():
            by_run = seen[:, : len(self.inputs[0])].unflatten(0, (-1, n_worlds))  # type: ignore[no-untyped-call]
            chosen = self.actor(self.scaled(by_run)).flatten(0, 1)
            taken = np.nan_to_num(explore(chosen.cpu().numpy()))  # of runs that fail
            actions[begins, lengths[begins]] = taken[begins]
            on_device = torch.from_numpy(taken.clip(-1.0, 1.0)).to(seen.device)
            obs, *results, info = env.step(on_device)
            rewards[every, lengths], *ends = (part.cpu().numpy() for part in results)
            broken, holds, is_success = (
                live & info[name] for name in ("diverged", "holding", "is_success")
            )
            stepped = live & ~(broken | holds)
            lengths += stepped
            seen = self._whole(obs)  # in a hold test, that after the step already
            views[stepped, lengths[stepped]] = seen[stepped]
            success = np.where(live & ~holds, is_success, success)
            terminated |= stepped & ends[0]
            diverged |= broken
            begins = stepped & ~(ends[0] | ends[1])
            live = begins | holds
        on_host, episodes = views.cpu().numpy(), dict[int, Episode]()
        for world in rngs:
            i, length = world // n_worlds, lengths[world]
            mine: Any = on_host[world, : length + 1][:, self.kept[i]]
            episodes[world] = Episode(
                obs=mine,
                actions=actions[world, :length],  # type: ignore[arg-type]
                rewards=rewards[world, :length].tolist(),
                terminated=bool(terminated[world]),
                success=float(success[world]),
                faults={"diverged": int(diverged[world]), "warnings": 0},
            )
            self.tried(i, finite, mine, OBS)
            self.tried(i, finite, episodes[world].rewards, REWARD)
        return episodes

    def _whole(self, obs: dict[str, Tensor]) -> Tensor:
        return torch.cat([obs[key] for key in self.view], dim=-1)


class Draws:
    """Generators of many worlds as one: what they draw has the worlds in front, 0 in all others."""

    def __init__(self, rngs: Rngs, n_ahead: int = 1) -> None:
        """Take the generators; draw so often at once where they are asked for the same all the time."""
        self._rngs, self._n_ahead, self._left = rngs, n_ahead, list[Array]()

    def __getattr__(self, name: str) -> Any:
        """Return a method of generators; its last argument is the shape."""
        return partial(self._draw, name)

    def _draw(self, name: str, *arguments: Any, **dtype: Any) -> Array:
        if not self._left:
            *bounds, (n, *shape) = arguments
            drawn = np.zeros((n, self._n_ahead, *shape), **dtype)
            for world, rng in self._rngs.items():
                drawn[world] = getattr(rng, name)(*bounds, drawn.shape[1:], **dtype)
            self._left = [*drawn.swapaxes(0, 1)]
        return self._left.pop(0)


class BatchPPO(BatchLearner):
    """Learn E runs by PPO."""

    view, stats = SEEN, ("obs_stats",)

    def build(self) -> None:
        """Stack standard deviations of actors, and critics."""
        every = [torch.ones(self.n_actions, dtype=torch.bool)] * len(self.e)
        self.log_std = self.stacked("gaussian", every, "std_adam")
        self.critic = self.stacked("critic", self.inputs, "critic_adam")
        is_fixed = self.config.exploration == "fixed"
        self.actors = [self.actor] if is_fixed else [self.actor, self.log_std]
        self.networks = [*self.actors, self.critic]

    def _std(self) -> Tensor:
        """Return each run's standard deviation of actions, (E, 1, d)."""
        at_start = self.config.action_variance.sqrt()[..., None]
        return at_start * self.log_std.flat[:, None].exp()

    def explore(self, rngs: Rngs) -> Noise:
        stds = self._std()[:, 0].cpu().numpy().repeat(self.n_worlds, axis=0)
        each = [[one.config.noise_correlation] for one in self.learners]
        lasts = np.repeat(each, self.n_worlds, axis=0)
        draws: Any = Draws(rngs, self.env.max_episode_steps)
        return GaussianNoise(draws, stds, lasts)

    def update(self) -> Rows:
        """Take `n_passes` over each run's batch, in minibatches of its own."""
        every, mine = range(len(self.learners)), dict[int, tuple[Transitions, Any]]()
        for i in self.on:
            if prepared := self.tried(i, self.learners[i].prepare):
                own, verdict = prepared
                mine[i] = own._replace(obs=spread(own.obs, self.inputs[i])), verdict
        if not mine:
            return {}
        for networks in self.networks:
            networks.take_rates()
            for i in mine:  # critics have another unit of rewards, actors may be undone
                networks.read(i)
        first = next(iter(mine.values()))
        each = zip(*(mine.get(i, first)[0] for i in every), strict=True)
        batch = Transitions(
            *(pad_sequence([*parts], batch_first=True) for parts in each)
        )
        learns = self.numbers(i in mine and mine[i][1] == "learn" for i in every)
        passes: list[Any] = [iter(()) for _ in every]
        for i, (own, _) in mine.items():
            passes[i] = self.learners[i].passes(len(own.obs))
        sums = torch.zeros(4, len(passes), device=self.device)
        n_updates, none = torch.zeros_like(learns), self.e[:0, 0]
        while any(minibatches := [next(each, ()) for each in passes]):
            last_kl = torch.zeros_like(sums[0])
            for parts in zip_longest(*minibatches, fillvalue=none):
                rows = pad_sequence([*parts], batch_first=True, padding_value=-1)
                stats, is_any = self._step(batch, rows, learns)
                sums += stats
                n_updates += is_any
                last_kl = torch.where(is_any[:, 0] == 1, stats[1], last_kl)
            if self.config.target_kl is not None:
                is_far = last_kl > self.config.target_kl[:, 0]
                for i in is_far.nonzero()[:, 0].tolist():
                    passes[i] = iter(())
        names = *ActorLoss._fields, "value_loss"
        said = self.checked(names, sums / n_updates[:, 0])
        for i, row in said.items():
            self.write(i)
            row |= self.learners[i].after_update(*mine[i], int(n_updates[i]))
        return said

    def _step(
        self, batch: Transitions, rows: Tensor, learns: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Take an Adam step of critics, and of actors that learn, on a minibatch of each run.

        `rows` (E, n) are -1 where a run has fewer than others. Returns policy loss, KL estimate,
        clipped fraction and value loss, (4, E), and where there is any, (E, 1).
        """
        has_row = rows >= 0
        is_any = has_row.any(dim=1, keepdim=True).float()
        share = has_row / has_row.sum(dim=1, keepdim=True).clamp(min=1)
        batch = Transitions(*(part[self.e, rows.clamp(min=0)] for part in batch))
        normal = torch.distributions.Normal(
            self.actor(batch.obs), self._std(), validate_args=False
        )
        log_prob = normal.log_prob(batch.actions).sum(dim=-1)  # type: ignore[no-untyped-call]
        result = surrogate(
            log_prob - batch.log_prob, batch.advantages, self.config.clip_range
        )
        errors = (self.critic(batch.obs)[..., 0] - batch.returns).square()
        parts = [*result, errors]
        stats = torch.stack([(part * share).sum(dim=1) for part in parts])
        for networks in self.networks:
            networks.zero_grad()
        (stats[0].sum() + stats[3].sum()).backward()  # type: ignore[no-untyped-call]
        self._take_step(self.actors, is_any * learns)
        self._take_step([self.critic], is_any)
        stats = stats.detach()
        return torch.cat([stats[:3] * learns[:, 0], stats[3:]]), is_any

    def _take_step(self, parts: Sequence[Networks], on: Tensor) -> None:
        """Take an Adam step in the runs where `on` is 1; gradients of all parts are clipped as one."""
        gradients: Any = [networks.flat.grad for networks in parts]
        squares = [g.square().sum(dim=1, keepdim=True) for g in gradients]
        norm = torch.stack(squares).sum(dim=0).sqrt()
        share = (self.config.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
        for networks, gradient in zip(parts, gradients, strict=True):
            gradient *= share
            networks.on = on
            networks.step()


class BatchDDPGHER(BatchLearner):
    """Learn E runs by DDPG with hindsight."""

    view, stats = VIEW, ("obs_stats", "goal_stats")

    def build(self) -> None:
        """Stack critics and target networks, and what networks see of the replays."""
        config, singles = self.config, self.learners
        self.n_tests = config.n_test_rollouts * config.n_rollouts
        with_actions = self.columns(self.n_goal + self.n_actions)
        self.critic = self.stacked("critic", with_actions, "critic_adam")
        targets = (
            self.stacked("target_actor", self.inputs),
            self.stacked("target_critic", with_actions),
        )
        self.networks = [self.actor, self.critic, *targets]
        # It learns for all: its networks are stacks, so what it computes has the runs in front.
        self.whole = whole = copy.copy(singles[0])
        whole.actor = whole.actor_adam = self.actor
        whole.critic = whole.critic_adam = self.critic
        whole.target_actor, whole.target_critic = targets
        whole.actor_parameters, whole.critic_parameters = (
            [self.actor.flat],
            [self.critic.flat],
        )
        n_steps = singles[0].replay.max_steps + 1
        shape = len(singles), 32, n_steps, self.width + self.n_actions
        self.memory = torch.zeros(shape, device=self.device)  # observations and actions
        for i, one in enumerate(singles):
            self._memorize(i, np.arange(one.replay.n_episodes))

    def scaled(self, seen: Tensor) -> Tensor:
        limit = self.config.clip_obs[..., None]
        return super().scaled(seen.clamp(-limit, limit))

    def explore(self, rngs: Rngs) -> Noise:
        acting = [one.config.acting(one.progress_remaining) for one in self.learners]
        values = [[c.noise_eps, c.random_eps, c.random_hold] for c in acting]
        by_world = np.repeat(values, self.n_worlds, axis=0)
        draws: Any = Draws(rngs)
        return Exploration(draws, *np.split(by_world, 3, axis=1))

    def _memorize(self, i: int, slots: Array) -> None:
        """Copy episodes of a run's replay to the device."""
        while max(slots, default=0) >= self.memory.shape[1]:
            more = torch.zeros_like(self.memory)
            self.memory = torch.cat([self.memory, more], dim=1)
        obs, action = map(torch.from_numpy, self.learners[i].replay.episodes(slots))
        mine, where = self.memory[i], torch.from_numpy(slots)
        mine[where, :, : obs.shape[-1]] = obs.to(self.device)
        mine[where, :, self.width :] = action.to(self.device)

    def update(self) -> Rows:
        """Take one cycle's updates of each active run, and move its target networks."""
        if not self.on:
            return {}
        self.look()
        n, singles, whole = self.config.n_batches, self.learners, self.whole
        drawn = dict[int, Relabelled]()
        for i in self.on:
            one = singles[i]
            self._memorize(i, one.new_slots)
            size = n * self.config.batch_size
            drawn[i] = one.replay.relabel(size, one.config.replay_p)
            factor = one.rescale(drawn[i].reward)
            for critic in (self.critic, whole.target_critic):
                critic.scale_outputs(i, factor)
            one.updates += n
        on = self.numbers(i in drawn for i in range(len(singles)))
        for networks in (self.actor, self.critic):
            networks.on = on
            networks.take_rates()
        polyak = torch.where(on == 1, self.config.polyak, 1.0)
        whole.config = dataclasses.replace(self.config, polyak=polyak)
        whole.action_l2 = self.numbers(one.action_l2 for one in singles)[:, 0]
        scale = whole.reward_scale = SimpleNamespace()
        for name in ("unit", "lowest", "highest"):
            values = (getattr(one.reward_scale, name) for one in singles)
            setattr(scale, name, self.numbers(values))
        means = whole.learn(self._batch(drawn)) / n
        means[2] *= scale.unit[:, 0]
        rows = self.checked(("critic_loss", "actor_loss", "mean_q"), means)
        return {i: {**row, "updates": n} for i, row in rows.items()}

    def _batch(self, drawn: Mapping[int, Relabelled]) -> Batch:
        """Return drawn transitions (E, n, ...); of runs that are off, any."""
        first = next(iter(drawn.values()))
        each = [drawn.get(i, first) for i in range(len(self.learners))]
        stacks = (torch.from_numpy(np.stack(part)) for part in zip(*each, strict=True))
        one = Relabelled(*(part.to(self.device) for part in stacks))
        rows = [self.memory[self.e, one.slot, one.step + k] for k in (0, 1)]
        whole = (torch.cat([r[..., : self.width], one.goal], dim=-1) for r in rows)
        obs, next_obs = map(self.scaled, whole)
        action = rows[0][..., self.width :]
        return Batch(obs, one.goal, action, one.reward, next_obs, one.terminal)


BATCHED: dict[type, type[Any]] = {PPO: BatchPPO, DDPGHER: BatchDDPGHER}
"""Learners that a batch has a form of."""
