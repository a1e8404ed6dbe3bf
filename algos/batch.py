"""Learn many runs of one kind at once, each as it would learn alone.

Each run has its single learner, PPO or DDPGHER. That keeps and relabels episodes,
follows rewards and computes advantages, as it does by itself, and its equations are
used for all. Here are the two things that are faster for all runs together: playing, in
a vector environment, and the networks. Those are stacked: every tensor has the runs in
front, (E, ...).

Episodes are whole, and those of the single learner: number and key give their start and
their noise.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import zip_longest
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from . import Array, DivergenceError, rollout
from .ddpg_her import DDPGHER, VIEW, Exploration
from .learner import tested
from .normalizer import Scaling
from .policy import OBS, SEEN, Noise, finite
from .ppo import PPO, ActorLoss, GaussianNoise, Transitions, surrogate
from .replay import Batch, Relabelled, minibatches
from .rollout import REWARD, Episode, Key, summary

MORE_SLOTS = 32  # of episodes, by which the memory of a batch grows
BETAS, EPS = (0.9, 0.999), 1e-8  # Adam's
MOMENTS = ("exp_avg", "exp_avg_sq")  # their names in the state of PyTorch's Adam
Rows = dict[int, dict[str, float]]  # of the progress table, by run
Rngs = Mapping[int, np.random.Generator]  # of worlds that begin
Run = tuple[nn.Module, torch.optim.Adam | None]


def alike(config: Any) -> tuple[Any, ...]:
    """Return what configurations of one batch have in common: all but the values of floats."""
    return type(config), *(
        (name, "" if isinstance(value, float) else value)
        for name, value in vars(config).items()
    )


# -- networks --------------------------------------------------------------------------------


class Networks:
    """Hold one network of each run in one tensor, `flat` (E, parameters), and its Adam.

    What a run has alone are the last numbers of its row, weights as (inputs, outputs):
    its module and its Adam keep them there. Before them are weights of inputs that only
    others have, for which it is given zeros: they stay zero.
    """

    on: Tensor
    """1 for the runs whose Adams take a step, 0 for others, (E, 1)."""

    def __init__(self, runs: Sequence[Run], device: torch.device) -> None:
        """Stack the module of each run, with its Adam."""
        self.runs = runs
        modules = (module for module, _ in runs)
        widest = max(modules, key=lambda module: next(module.parameters()).numel())
        self.shapes = [p.t().shape for p in widest.parameters()]
        self.sizes = [*map(math.prod, self.shapes)]
        self.rows = torch.zeros(3, len(runs), sum(self.sizes), device=device)
        self.flat = self.rows[0]
        self.n_steps = torch.zeros(len(runs), 1, device=device)
        for i in range(len(runs)):
            self.take_in(i)
        self.flat.requires_grad_()

    @torch.no_grad()
    def take_in(self, i: int) -> None:
        """Move what run `i` has alone into its row."""
        module, adam = self.runs[i]
        parameters = [*module.parameters()]
        sizes = [*map(torch.numel, parameters)]
        own = self.rows[:, i, -sum(sizes) :].split(sizes, dim=1)  # type: ignore[no-untyped-call]
        for p, numbers in zip(parameters, own, strict=True):
            state = adam.state[p] if adam else {}
            value, *moments = (row.view(p.t().shape).t() for row in numbers)
            value[...] = p
            p.data = value
            for name, moment in zip(MOMENTS, moments, strict=True):
                moment[...] = state.get(name, 0.0)
                state[name] = moment
            self.n_steps[i] = state.get("step", 0.0)
            state["step"] = self.n_steps[i, 0]

    def __call__(self, x: Tensor) -> Tensor:
        """Return what MLPs return (E, n, outputs) for inputs (E, n, width)."""
        pieces = self.flat.split(self.sizes, dim=1)  # type: ignore[no-untyped-call]
        parts = [p.unflatten(1, s) for p, s in zip(pieces, self.shapes, strict=True)]
        for layer in self.runs[0][0].children():
            if isinstance(layer, nn.Linear):
                weight, bias, *parts = parts
                x = torch.baddbmm(bias[:, None], x, weight)
            else:
                x = layer(x)
        return x

    def parameters(self) -> list[Tensor]:
        """Return all parameters, as a module does."""
        return [self.flat]

    def zero_grad(self) -> None:
        """Forget the last gradient, as Adam does."""
        self.flat.grad = None

    def take_rates(self) -> None:
        """Learn at the rates that the runs' own Adams have now."""
        rates = [[adam.param_groups[0]["lr"]] for _, adam in self.runs if adam]
        self.lr = torch.tensor(rates, device=self.flat.device)

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


# -- learners --------------------------------------------------------------------------------


class BatchLearner:
    """Learn E runs at once; `collect` and `update` in turn, as a single learner does.

    A run is active until it has its steps, or fails: `failures` says why, by run. It
    plays in W worlds of its own, `i` W to `(i + 1)` W, all at once; one that has enough
    episodes waits for the others.
    """

    view: ClassVar[Sequence[str]]
    """Parts of observations that a single learner keeps; networks see the first two."""
    networks: Sequence[Networks]
    """All that must stay finite."""

    def __init__(self, learners: Sequence[Any], env: Any, test_env: Any = None) -> None:
        """Stack learners whose configurations are `alike`; `env` has as many worlds for each.

        Episodes without exploration are played in `test_env`, if there is one: it may
        have more worlds.

        It is Gymnasium's VectorEnv with autoreset off, whose observations are tensors;
        of worlds whose episodes have ended, it says False. Where its info has
        ``holding``, a step of those worlds is not over: it ends with the call that says
        so no more, and all actions but its first are ignored. The episode ends with
        that step.
        """
        self.learners, self.env, self.test_env = learners, env, test_env or env
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
        self.width, n_goal = (
            spaces[key].shape[0] for key in ("observation", "desired_goal")
        )
        self.n_inputs = self.width + n_goal
        (self.n_actions,) = env.single_action_space.shape
        self.e = torch.arange(len(learners), device=self.device)[:, None]
        self.pads = [self.n_inputs - one.n_inputs for one in learners]
        """Number of inputs that each run does not have; here they come first, and are
        zero."""
        order = (np.arange(self.width) - np.c_[self.pads]) % self.width
        self.order = torch.tensor(order, device=self.device)
        self.failures, self.on = dict[int, str](), list[int]()
        self.actor = self.stacked("actor", "actor_adam")
        self.build()

    def build(self) -> None:
        """Stack the critics, and all else that an algorithm has; set `networks`."""
        raise NotImplementedError

    def look(self) -> None:
        """Scale what networks are given as the single learners' normalizers now do."""
        scalings = (torch.stack([*one.scaling()]) for one in self.learners)
        each = torch.stack([*map(self.padded, scalings)], dim=1)
        self.scale = Scaling(*each[:, :, None].to(self.device))

    def padded(self, own: Tensor) -> Tensor:
        """Return values (..., n) of a run's own inputs with zeros for those of others before them."""
        return nn.functional.pad(own, (self.n_inputs - own.shape[-1], 0))

    def explore(self, rngs: Rngs) -> Noise:
        """Return the exploration of an episode in each of some worlds, with their generators."""
        raise NotImplementedError

    def stacked(self, name: str, adam: str = "") -> Networks:
        """Return the networks that single learners have by this name, with their Adams, if any."""
        runs = [(getattr(one, name), getattr(one, adam, None)) for one in self.learners]
        return Networks(runs, self.device)

    def numbers(self, values: Iterable[float]) -> Tensor:
        """Return a number of each run, (E, 1)."""
        return torch.tensor([[float(x)] for x in values], device=self.device)

    @property
    def active(self) -> list[int]:
        """Runs that go on."""
        return [
            i
            for i, one in enumerate(self.learners)
            if one.progress_remaining > 0.0 and i not in self.failures
        ]

    def tried(self, i: int, function: Callable[..., Any], *args: Any) -> Any:
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
        for networks in self.networks:
            networks.take_rates()
        episodes = self.play({i: self.learners[i].key(rollout.TRAIN) for i in self.on})
        rows = Rows()
        for i in self.on:
            if row := self.tried(i, self.learners[i].keep, episodes[i]):
                rows[i] = row
        return rows

    def play_best(self, keys: Mapping[int, Key], n: int) -> Rows:
        """Return counts and means of `n` episodes without exploration of the runs with keys."""
        played = self.play(keys, n)
        return {i: summary(played[i]) for i in played.keys() - self.failures}

    def test(self, runs: Iterable[int]) -> Rows:
        """Return how good these runs are without exploration, where their learner tests that."""
        singles = self.learners
        tests = {i for i in runs if singles[i].n_tests and i not in self.failures}
        keys = {i: singles[i].key(rollout.TEST) for i in tests if singles[i].is_tested}
        played = self.play_best(keys, singles[0].n_tests)
        return {i: tested(played.get(i, {})) for i in tests}

    @torch.no_grad()
    def play(
        self, keys: Mapping[int, Key], n: int | None = None
    ) -> dict[int, list[Episode]]:
        """Play episodes 0, 1, 2, ... of the runs with these keys until each has enough to learn from.

        Or `n` episodes of each, without exploration.
        """
        self.look()
        env = self.env if n is None else self.test_env
        episodes, first = {i: list[Episode]() for i in keys}, 0

        def wants_more(i: int) -> bool:
            if n is not None:
                return len(episodes[i]) < n
            return bool(self.tried(i, self.learners[i].wants_more, episodes[i]))

        while keys:
            for i, episode in self._wave(env, keys, first, n is None):
                if wants_more(i):
                    episodes[i].append(episode)
            keys = {i: key for i, key in keys.items() if wants_more(i)}
            first += env.num_envs // len(self.learners)
        return episodes

    def _wave(
        self, env: Any, keys: Mapping[int, Key], first: int, explores: bool
    ) -> Iterator[tuple[int, Episode]]:
        """Play an episode, number `first` and following, in each world of the runs with keys.

        Yields them by run.
        """
        n_worlds = env.num_envs // len(self.learners)
        rngs = {
            i * n_worlds + w: np.random.default_rng([*key, first + w])
            for i, key in keys.items()
            for w in range(n_worlds)
        }
        every = np.arange(env.num_envs)
        seeds = [int(rngs[w].integers(2**31)) if w in rngs else None for w in every]
        explore: Noise = self.explore(rngs) if explores else np.asarray
        begins = live = np.isin(every, [*rngs])
        seen = self._whole(env.reset(seed=seeds, options={"reset_mask": live})[0])
        # Rows of a world from its length on mean nothing.
        shape = len(every), env.max_episode_steps + 1
        views = seen.new_zeros(*shape, seen.shape[1])
        views[:, 0], lengths = seen, np.zeros(len(every), int)
        actions = np.zeros((*shape, self.n_actions), np.float32)
        rewards = np.zeros(shape)
        success, terminated, diverged = (live & False for _ in range(3))
        while live.any():
            by_run = seen[:, : self.n_inputs].unflatten(0, (-1, n_worlds))  # type: ignore[no-untyped-call]
            chosen = self.actor(self.scale(by_run)).flatten(0, 1)
            taken = np.nan_to_num(explore(chosen.cpu().numpy()))  # of runs that fail
            actions[begins, lengths[begins]] = taken[begins]
            on_device = torch.from_numpy(taken.clip(-1.0, 1.0)).to(seen.device)
            obs, *results, info = env.step(on_device)
            reward, terminates, truncates = (part.cpu().numpy() for part in results)
            returns = live & ~info["holding"]
            stepped = returns & ~info["diverged"]
            rewards[every, lengths] = reward
            lengths += stepped
            seen = self._whole(obs)  # in a hold test, that after the step already
            views[stepped, lengths[stepped]] = seen[stepped]
            success = np.where(returns, info["is_success"], success)
            terminated |= terminates
            diverged |= info["diverged"]
            live = live & ~(terminates | truncates)
            begins = live & returns
        on_host = views.cpu().numpy()
        for world in rngs:
            i, length = world // n_worlds, lengths[world]
            mine: Any = on_host[world, : length + 1, self.pads[i] :]
            self.tried(i, finite, mine, OBS)
            self.tried(i, finite, rewards[world, :length], REWARD)
            # Of tests, observations are not kept: those of all would fill the memory.
            episode = Episode(
                obs=mine if explores else [],
                actions=actions[world, :length],  # type: ignore[arg-type]
                rewards=rewards[world, :length].tolist(),
                terminated=bool(terminated[world]),
                success=float(success[world]),
                faults={"diverged": int(diverged[world]), "warnings": 0},
            )
            yield i, episode

    def _whole(self, obs: dict[str, Tensor]) -> Tensor:
        """Return what is kept of observations, where what a run does not have comes first."""
        own = obs["observation"].reshape(len(self.learners), -1, self.width)
        own = own.take_along_dim(self.order[:, None], dim=2).flatten(0, 1)
        return torch.cat([own, *(obs[key] for key in self.view[1:])], dim=-1)


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

    view = SEEN

    def build(self) -> None:
        """Stack standard deviations of actors, and critics."""
        is_learned = self.config.exploration == "learned"
        self.log_std = self.stacked("gaussian", "std_adam" if is_learned else "")
        self.critic = self.stacked("critic", "critic_adam")
        self.actors = [self.actor, self.log_std] if is_learned else [self.actor]
        self.networks = [*self.actors, self.critic]

    def _std(self) -> Tensor:
        """Return each run's standard deviation of actions, (E, 1, d)."""
        at_start = self.config.action_variance.sqrt()[..., None]
        return at_start * self.log_std.flat[:, None].exp()

    def explore(self, rngs: Rngs) -> Noise:
        parts = self._std()[:, 0], self.config.noise_correlation
        by_world = (part.cpu().numpy().repeat(self.n_worlds, axis=0) for part in parts)
        draws = Draws(rngs, self.env.max_episode_steps)
        return GaussianNoise(draws, *by_world)  # type: ignore[arg-type]

    def update(self) -> Rows:
        """Take `n_passes` over each run's batch, in minibatches of its own."""
        prepared = {i: self.tried(i, self.learners[i].prepare) for i in self.on}
        if not self.on:
            return {}
        first, _ = prepared[self.on[0]]
        nothing: Any = Transitions(*(part[:0] for part in first)), "wait"
        each = [prepared.get(i) or nothing for i in range(len(self.learners))]
        for networks in self.networks:
            for i in self.on:
                if each[i][1] == "undo":  # which gives Adams memory of their own
                    networks.take_in(i)
        owns = [own._replace(obs=self.padded(own.obs)) for own, _ in each]
        padded = (pad_sequence([*parts], True) for parts in zip(*owns, strict=True))
        batch = Transitions(*padded)
        learns = self.numbers(verdict == "learn" for _, verdict in each)
        passes: list[Any] = [iter(()) for _ in each]
        for i in self.on:
            passes[i] = self.learners[i].passes(len(owns[i].obs))
        sums, last = torch.zeros(2, 5, len(each), device=self.device)
        while any(minibatches := [next(each, ()) for each in passes]):
            for parts in zip_longest(*minibatches, fillvalue=self.e[0, :0]):
                rows = pad_sequence(parts, True, -1)  # type: ignore[arg-type]
                stats = self._step(batch, rows, learns)
                sums += stats
                last = torch.where(stats[4] == 1, stats, last)
            if self.config.target_kl is not None:
                is_far = last[1] > self.config.target_kl[:, 0]
                for i in is_far.nonzero()[:, 0].tolist():
                    passes[i] = iter(())
        said = self.checked((*ActorLoss._fields, "value_loss"), sums[:4] / sums[4])
        for i, row in said.items():
            row |= self.learners[i].after_update(*each[i], int(sums[4, i]))
        return said

    def _step(self, batch: Transitions, rows: Tensor, learns: Tensor) -> Tensor:
        """Take an Adam step of critics, and of actors that learn, on a minibatch of each run.

        `rows` (E, n) are -1 where a run has fewer than others. Returns policy loss, KL
        estimate, clipped fraction and value loss, and 1 where there is any row, (5, E).
        """
        has_row = rows >= 0
        is_any = has_row[:, :1].float()
        share = has_row / has_row.sum(dim=1, keepdim=True).clamp(min=1)
        batch = Transitions(*(part[self.e, rows] for part in batch))
        normal = torch.distributions.Normal(
            self.actor(batch.obs), self._std(), validate_args=False
        )
        log_prob = normal.log_prob(batch.actions).sum(dim=-1)  # type: ignore[no-untyped-call]
        result = surrogate(
            log_prob - batch.log_prob, batch.advantages, self.config.clip_range
        )
        errors = (self.critic(batch.obs)[..., 0] - batch.returns).square()
        stats = torch.stack([(part * share).sum(dim=1) for part in (*result, errors)])
        for networks in self.networks:
            networks.zero_grad()
        stats[[0, 3]].sum().backward()  # type: ignore[no-untyped-call]
        self._take_step(self.actors, is_any * learns)
        self._take_step([self.critic], is_any)
        stats = torch.cat([stats.detach(), is_any.T])
        stats[:3] *= learns.T
        return stats

    def _take_step(self, parts: Sequence[Networks], on: Tensor) -> None:
        """Take an Adam step in the runs where `on` is 1; gradients of all parts are clipped as one."""
        gradients: Any = [networks.flat.grad for networks in parts]
        norm = torch.cat(gradients, dim=1).norm(dim=1, keepdim=True)
        share = (self.config.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
        for networks, gradient in zip(parts, gradients, strict=True):
            gradient *= share
            networks.on = on
            networks.step()


class BatchDDPGHER(BatchLearner):
    """Learn E runs by DDPG with hindsight."""

    view = VIEW

    def build(self) -> None:
        """Stack critics and target networks, and what networks see of the replays."""
        singles = self.learners
        self.critic = self.stacked("critic", "critic_adam")
        targets = self.stacked("target_actor"), self.stacked("target_critic")
        self.networks = [self.actor, self.critic, *targets]
        # It learns for all: its networks are stacks, so what it computes has the runs
        # in front.
        self.whole = whole = copy.copy(singles[0])
        whole.actor = whole.actor_adam = self.actor
        whole.critic = whole.critic_adam = self.critic
        whole.target_actor, whole.target_critic = targets
        whole.actor_parameters = self.actor.parameters()
        whole.critic_parameters = self.critic.parameters()
        replay, longest = singles[0].replay, max(one.total_timesteps for one in singles)
        # Room for episodes of half their longest on average; more is added as it is
        # needed.
        n_slots = min(replay.n_slots, 2 * longest // replay.max_steps + MORE_SLOTS)
        shape = len(singles), n_slots, replay.max_steps + 1, self.width + self.n_actions
        self.memory = torch.zeros(shape, device=self.device)  # observations and actions
        for i, one in enumerate(singles):
            self._memorize(i, np.arange(one.replay.n_episodes))

    def explore(self, rngs: Rngs) -> Noise:
        acting = [one.config.acting(one.progress_remaining) for one in self.learners]
        values = [[c.noise_eps, c.random_eps, c.random_hold] for c in acting]
        columns = np.split(np.repeat(values, self.n_worlds, axis=0), 3, axis=1)
        return Exploration(Draws(rngs), *columns)  # type: ignore[arg-type]

    def _memorize(self, i: int, slots: Array) -> None:
        """Copy episodes of a run's replay to the device."""
        while max(slots, default=0) >= self.memory.shape[1]:
            more = torch.zeros_like(self.memory[:, :MORE_SLOTS])
            self.memory = torch.cat([self.memory, more], dim=1)
        rows = torch.from_numpy(self.learners[i].replay.episodes(slots))
        self.memory[i, slots, :, self.pads[i] :] = rows.to(self.device)

    def update(self) -> Rows:
        """Take one cycle's updates of each active run, and move its target networks."""
        if not self.on:
            return {}
        self.look()
        n, singles, whole = self.config.n_batches, self.learners, self.whole
        size = n * self.config.batch_size
        drawn = dict[int, Relabelled]()
        for i in self.on:
            one = singles[i]
            self._memorize(i, one.new_slots)
            drawn[i] = one.replay.relabel(size, one.config.replay_p)
            one.rescale(drawn[i].reward)
            one.updates += n
        on = self.numbers(i in drawn for i in range(len(singles)))
        self.actor.on = self.critic.on = on
        polyak = torch.where(on == 1, self.config.polyak, 1.0)
        whole.config = dataclasses.replace(self.config, polyak=polyak)
        whole.action_l2 = self.numbers(one.action_l2 for one in singles)[:, 0]
        scale = whole.reward_scale = SimpleNamespace()
        for name in ("unit", "lowest", "highest"):
            values = (getattr(one.reward_scale, name) for one in singles)
            setattr(scale, name, self.numbers(values))
        means = whole.learn(self._minibatches(drawn)) / n
        means[2] *= scale.unit[:, 0]
        rows = self.checked(("critic_loss", "actor_loss", "mean_q"), means)
        return {i: {**row, "updates": n} for i, row in rows.items()}

    def _minibatches(self, drawn: Mapping[int, Relabelled]) -> Iterator[Batch]:
        """Yield drawn transitions (E, batch_size, ...); of runs that are off, any.

        One after the other, since all of a large batch would fill a GPU's memory.
        """
        each = [drawn.get(i, drawn[self.on[0]]) for i in range(len(self.learners))]
        one = Relabelled(
            *(
                torch.as_tensor(np.stack(part), device=self.device)
                for part in zip(*each, strict=True)
            )
        )
        for part in minibatches(one, self.config.batch_size, axis=1):
            now, then = (self.memory[self.e, part.slot, part.step + k] for k in (0, 1))
            obs, next_obs = (
                self.scale(torch.cat([rows[..., : self.width], part.goal], dim=-1))
                for rows in (now, then)
            )
            action = now[..., self.width :]
            yield Batch(obs, part.goal, action, part.reward, next_obs, part.terminal)


BATCHED: dict[type, type[Any]] = {PPO: BatchPPO, DDPGHER: BatchDDPGHER}
"""Learners that a batch has a form of."""
