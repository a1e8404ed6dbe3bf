"""Learn many runs of one kind at once, each as it would learn alone.

The runs' networks are stacked: every tensor has the runs in front, (E, ...). What belongs to one run
(weights, moments, rewards' scale, random numbers) never meets another's. Episodes are whole, and
numbered as those of a single learner: an epoch is as many of them as its `steps_per_epoch` takes.

Each run has a single learner, PPO or DDPGHER, which gives the start and takes the end: what is saved
is its state, and whoever reads it need not know of the batch.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from . import rollout
from .ddpg_her import DDPGHER, td_targets
from .learner import Learner, restore
from .networks import MLP
from .normalizer import BLOCK_NORM, MIN_STD, PRIOR_ROWS, Normalizer, Scaling
from .ppo import PPO, surrogate
from .replay import Batch, Replay

GOLDEN = -7046029254386353131  # 2^64 / the golden ratio, as int64
MIX = ((30, -4658895280553007687), (27, -7723592293110705685), (31, 1))
# What random numbers are for, besides the purposes in `rollout`.
ORDER, PICK, SLOT = 11, 12, 13
REACH = (
    "first_values",
    "lowest_return",
    "highest_return",
)  # what PPO's values are held against
BETAS, EPS = (0.9, 0.999), 1e-8  # Adam's
Act = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
"""Return actions (E, W, d) from observations (E, W, width), the episodes' numbers, the numbers of their
steps, and a mask of worlds that act now, (E, W) each.
"""


def alike(config: Any) -> tuple[Any, ...]:
    """Return what configurations of one batch have in common: all but the values of floats."""
    values = {field.name: getattr(config, field.name) for field in fields(config)}
    free = {name: "" for name, value in values.items() if isinstance(value, float)}
    return (type(config), *{**values, **free}.items())


class Draws:
    """Draw random numbers that follow from a run's seed and counters alone (splitmix64)."""

    def __init__(self, seeds: Tensor) -> None:
        """Take the seeds of all runs, int64 (E,)."""
        self.seeds = seeds

    def __call__(self, purpose: int, *counters: Tensor | int, width: int) -> Tensor:
        """Return uniform numbers inside (0, 1), float64 (E, ..., width).

        Counters (E, ...) or int tell draws apart.
        """
        shape = torch.broadcast_shapes(  # type: ignore[no-untyped-call]
            *(c.shape for c in counters if not isinstance(c, int))
        )
        x = self.seeds.view(-1, *[1] * (len(shape) - 1))
        for counter in (purpose, *counters):
            x = _mixed((x ^ counter) + GOLDEN)
        columns = torch.arange(width, device=x.device)
        x = _mixed(x.expand(shape)[..., None] + GOLDEN * (columns + 1))
        return ((x >> 11 & (1 << 53) - 1).double() + 0.5) * 2.0**-53


def _mixed(x: Tensor) -> Tensor:
    for shift, factor in MIX:
        x = (x ^ (x >> shift & (1 << 64 - shift) - 1)) * factor
    return x


def _normal(uniform: Tensor) -> Tensor:
    return torch.special.ndtri(uniform).float()


# -- networks --------------------------------------------------------------------------------


class Networks:
    """Hold one network of each run in one tensor, `flat` (E, parameters), and its Adam.

    `n_extra` parameters at its end belong to no layer. Inputs that a run does not have are zero, and
    so stay their weights.
    """

    def __init__(
        self,
        networks: Sequence[MLP],
        columns: Sequence[Tensor],
        width: int,
        n_extra: int = 0,
    ) -> None:
        """Stack networks; `columns` are the places of each one's inputs among all `width`."""
        first = networks[0]
        self.columns, self.is_tanh = columns, isinstance(first[-1], torch.nn.Tanh)
        sizes = [width, *(linear.out_features for linear in first.linears)]
        pairs = zip(sizes[1:], sizes, strict=False)
        self.shapes = [
            shape for out, inputs in pairs for shape in ((out, inputs), (out,))
        ]
        self.sizes = [*map(math.prod, self.shapes), n_extra]
        flat = torch.zeros(len(networks), sum(self.sizes), device=columns[0].device)
        self.flat, self.m, self.v = flat, flat.clone(), flat.clone()
        self.n_steps = flat.new_zeros(len(networks), 1)
        for i, network in enumerate(networks):
            for part, values in zip(
                self.parts(i, flat), network.parameters(), strict=False
            ):
                part.copy_(values.detach())
        flat.requires_grad_()

    def parts(self, i: int, flat: Tensor) -> list[Tensor]:
        """Return views of run `i` in a tensor such as `flat`, shaped as its own network's.

        The first weights, of which it has not all columns, are a view only where none is missing: see
        `assign`.
        """
        pieces = flat.detach()[i].split(self.sizes)  # type: ignore[no-untyped-call]
        views = [
            piece.view(shape) for piece, shape in zip(pieces, self.shapes, strict=False)
        ]
        return [_Columns(views[0], self.columns[i]), *views[1:], pieces[-1]]  # type: ignore[list-item]

    def __call__(self, x: Tensor, flat: Tensor | None = None) -> Tensor:
        """Return outputs (E, n, outputs) for inputs (E, n, width), by other weights where given."""
        pieces = (self.flat if flat is None else flat).split(self.sizes, dim=1)  # type: ignore[no-untyped-call]
        last = len(self.shapes) - 2
        for k in range(0, last + 1, 2):
            weight = pieces[k].unflatten(1, self.shapes[k])
            x = torch.baddbmm(pieces[k + 1][:, None], x, weight.transpose(1, 2))
            x = x.relu() if k < last else x
        return x.tanh() if self.is_tanh else x

    def scale_outputs(self, factor: Tensor, flat: Tensor | None = None) -> None:
        """Multiply what each run's last layer returns by a factor (E,), as MLP's does."""
        pieces = (self.flat if flat is None else flat).detach().split(self.sizes, dim=1)  # type: ignore[no-untyped-call]
        for piece in pieces[-3:-1]:
            piece.mul_(factor[:, None])

    @torch.no_grad()
    def step(self, gradient: Tensor, lr: Tensor, mask: Tensor) -> None:
        """Take an Adam step of the runs in `mask` (E,); rates `lr` are (E, 1) or (E, parameters)."""
        on = mask[:, None].float()
        self.n_steps += on
        self.m.lerp_(gradient, on * (1 - BETAS[0]))
        self.v.lerp_(gradient.square(), on * (1 - BETAS[1]))
        n = self.n_steps.double().clamp(min=1.0)
        first, second = ((1 - beta**n).float() for beta in BETAS)
        size = (self.v.sqrt() / second.sqrt()).add_(EPS)
        self.flat.sub_(self.m / size * (on * lr / first))


class _Columns:
    """Copy to and from the columns that a run has of stacked weights."""

    def __init__(self, weight: Tensor, columns: Tensor) -> None:
        self.weight, self.columns = weight, columns

    def copy_(self, values: Tensor) -> None:
        self.weight[:, self.columns] = values.detach().to(self.weight)

    def cpu(self) -> Tensor:
        return self.weight[:, self.columns].cpu()


class Stats:
    """Hold the moments of each run's inputs, as `Normalizer` has them, (E, 1, width)."""

    def __init__(
        self, normalizers: Sequence[Normalizer], columns: Sequence[Tensor], width: int
    ) -> None:
        """Stack normalizers; inputs that a run does not have stay as they are."""
        self.columns, device = columns, columns[0].device
        n = len(normalizers)
        own = [[s.count, s._block_squares, s.clip] for s in normalizers]
        numbers = torch.tensor(own, dtype=torch.float64, device=device)
        self.count, self.block_squares, self.clip = numbers.view(n, 1, 3).split(  # type: ignore[no-untyped-call]
            1, dim=2
        )
        self.mean, self.squares = torch.zeros(
            2, n, 1, width, dtype=torch.float64, device=device
        )
        self.as_is = torch.ones(n, 1, width, dtype=torch.bool, device=device)
        self.block = torch.zeros_like(self.as_is)
        for i, one in enumerate(normalizers):
            for mine, its in self._arrays(one):
                mine[i, 0, columns[i]] = torch.from_numpy(its).to(device)
        self.scaling()

    def _arrays(self, one: Normalizer) -> list[tuple[Tensor, Any]]:
        return [
            (self.mean, one.mean),
            (self.squares, one._squares),
            (self.as_is, one.as_is),
            (self.block, one.block),
        ]

    def update(self, rows: Tensor, mask: Tensor) -> None:
        """Take in the rows (E, n, width) in `mask` (E, n)."""
        rows, on = rows.double(), mask[..., None].double()
        count = on.sum(dim=1, keepdim=True)
        mean = (rows * on).sum(dim=1, keepdim=True) / count.clamp(min=1.0)
        squares = ((rows - mean).square() * on).sum(dim=1, keepdim=True)
        in_block = (rows * on * self.block).square().sum(dim=(1, 2), keepdim=True)
        gap, total = mean - self.mean, self.count + count
        share = count / total.clamp(min=1.0)
        has_moments = ~(self.as_is | self.block)
        self.squares += has_moments * (squares + gap.square() * self.count * share)
        self.mean += has_moments * gap * share
        self.count, self.block_squares = total, self.block_squares + in_block
        self.scaling()

    def scaling(self) -> None:
        """Compute what it does to values from now on."""
        variance = self.squares / self.count.clamp(min=1.0)
        variance = torch.where(self.count > 0, variance, 1.0)
        norm = (PRIOR_ROWS + self.block_squares) / (PRIOR_ROWS + self.count)
        variance = torch.where(self.block, norm / BLOCK_NORM, variance)
        std = torch.where(self.as_is, 1.0, variance.sqrt().clamp(min=MIN_STD))
        high = self.mean.float()
        low = (self.mean - high).float()
        limit = torch.where(self.as_is, torch.inf, self.clip).float()
        self.scale = Scaling(high, low, std.reciprocal().float(), limit)

    def write(self, i: int, one: Normalizer) -> None:
        """Write the moments of run `i` into its own normalizer."""
        one.count, one._block_squares = (
            float(self.count[i]),
            float(self.block_squares[i]),
        )
        for mine, its in self._arrays(one)[:2]:
            its[:] = mine[i, 0, self.columns[i]].cpu().numpy()


# -- episodes --------------------------------------------------------------------------------


class Played(NamedTuple):
    """Hold episodes by run and number, (E, K, ...); steps are padded to the longest."""

    obs: Tensor
    """Observation, achieved and desired goal side by side, (E, K, T + 1, width)."""
    actions: Tensor
    rewards: Tensor
    """0 beyond an episode's end, (E, K, T)."""
    lengths: Tensor
    terminated: Tensor
    success: Tensor
    diverged: Tensor
    taken: Tensor
    """False for episodes that no run asked for."""

    @property
    def usable(self) -> Tensor:
        """The episodes (E, K) that are learned from."""
        return self.taken & (self.lengths > 0)

    def rows(self, n_more: int = 0) -> Tensor:
        """Return a mask (E, K, T + n_more) of steps, and of one observation more where asked."""
        steps = torch.arange(self.rewards.shape[2] + n_more, device=self.rewards.device)
        return (steps < self.lengths[..., None] + n_more) & self.usable[..., None]


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

    def play(
        self,
        act: Act,
        seed: Callable[[int, int], int],
        is_taken: Callable[[Tensor, Tensor], Tensor],
        active: Tensor,
    ) -> Played:
        """Play episodes 0, 1, 2, ... of the runs in `active` (E,) until each has those it takes.

        `seed(run, number)` is that of an episode's start. `is_taken(lengths, indices)` says which
        episodes (E, K) are taken, and whether one beyond them would be, while there are too few.
        """
        waves, wanted, taken = list[Played](), active, active[:, None]
        while bool(wanted.any()) and len(waves) < rollout.MAX_FAILURES:
            waves.append(self._wave(act, seed, wanted, len(waves)))
            lengths = torch.cat([wave.lengths for wave in waves], dim=1)
            more = torch.cat([lengths, torch.zeros_like(lengths[:, :1])], dim=1)
            taken = is_taken(more, torch.arange(more.shape[1], device=more.device))
            wanted = active & taken[:, -1]
        longest = max(wave.rewards.shape[2] for wave in waves)
        padded = [
            wave._replace(
                obs=_padded(wave.obs, longest + 1),
                actions=_padded(wave.actions, longest),
                rewards=_padded(wave.rewards, longest),
            )
            for wave in waves
        ]
        played = Played(
            *(torch.cat(parts, dim=1) for parts in zip(*padded, strict=True))
        )
        return played._replace(taken=played.taken & taken[:, :-1])

    def _wave(self, act: Act, seed: Any, wanted: Tensor, wave: int) -> Played:
        """Play one episode in each world of the runs that are wanted."""
        shape, n_worlds = self.shape, self.shape[1]
        started = live = wanted[:, None].expand(shape)
        numbers = wave * n_worlds + torch.arange(n_worlds, device=wanted.device)
        numbers = numbers.expand(shape)
        seeds = [
            seed(i, wave * n_worlds + w) if is_on else None
            for i, is_on in enumerate(wanted.tolist())
            for w in range(n_worlds)
        ]
        mask = live.reshape(-1).cpu().numpy()
        obs, info = self.env.reset(seed=seeds, options={"reset_mask": mask})
        void = live & self._flags(info, "diverged")
        live, diverged, moving = live & ~void, void.long(), ~void
        views, actions = [self._whole(obs)], list[Tensor]()
        rewards, counts = list[Tensor](), list[Tensor]()
        lengths, terminated, success = diverged * 0, live & False, live & False
        while bool(live.any()) or not actions:
            chosen = act(views[-1], numbers, lengths, moving)
            kept = (
                torch.where(moving[..., None], chosen, actions[-1])
                if actions
                else chosen
            )
            actions.append(kept)
            obs, reward, is_end, is_cut, info = self.env.step(
                kept.clamp(-1.0, 1.0).flatten(0, 1)
            )
            moving = ~self._flags(info, "holding")
            void = live & self._flags(info, "diverged")
            counts.append(live & moving & ~void)
            views.append(self._whole(obs))
            rewards.append(reward.view(shape))
            diverged += void
            is_success = self._flags(info, "is_success")
            success = torch.where(counts[-1], is_success, success & ~void)
            lengths = lengths + counts[-1]
            terminated = terminated | (counts[-1] & is_end.view(shape))
            live = live & ~void & ~(moving & (is_end | is_cut).view(shape))
        steps = _packed(*map(torch.stack, (views, actions, rewards, counts)), lengths)  # type: ignore[call-arg]
        return Played(*steps, lengths, terminated, success, diverged, started)

    def _flags(self, info: dict[str, Any], name: str) -> Tensor:
        flags = info.get(name, False)
        flags = torch.as_tensor(flags, dtype=torch.bool, device=self.env.device)
        return flags.expand(self.env.num_envs).view(self.shape)

    def _whole(self, obs: dict[str, Tensor]) -> Tensor:
        keys = ("observation", "achieved_goal", "desired_goal")
        return torch.cat([obs[key] for key in keys], dim=-1).unflatten(0, self.shape)  # type: ignore[no-untyped-call]


def _packed(
    views: Tensor, actions: Tensor, rewards: Tensor, counts: Tensor, lengths: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the steps that count of each world, in order and from 0 on, (E, W, T, ...).

    Arguments are (calls, E, W, ...), `views` with one more. Of observations there is one more as well.
    """
    n = max(1, int(lengths.max()))
    calls = (~counts).int().argsort(dim=0, stable=True)[:n]
    last = (
        torch.arange(1, len(counts) + 1, device=counts.device)[:, None, None] * counts
    )
    with_last = torch.cat([calls, calls[:1]]).scatter(
        0, lengths[None], last.amax(dim=0)[None]
    )
    e, w = (torch.arange(size, device=counts.device) for size in lengths.shape)
    within = torch.arange(n, device=counts.device) < lengths[..., None]
    calls, with_last = calls.permute(1, 2, 0), with_last.permute(1, 2, 0)
    e, w = e[:, None, None], w[None, :, None]
    return views[with_last, e, w], actions[calls, e, w], rewards[calls, e, w] * within


def _padded(steps: Tensor, n: int) -> Tensor:
    """Return values (E, K, n, ...), zero beyond what there is."""
    missing = n - steps.shape[2]
    return torch.cat(
        [steps, steps.new_zeros(*steps.shape[:2], missing, *steps.shape[3:])], 2
    )


def _discounted(values: Tensor, factor: Tensor) -> Tensor:
    """Return the discounted sums of values (E, K, T) and all that follow; factors are (E, 1)."""
    sums, total = torch.empty_like(values), torch.zeros_like(values[..., 0])
    for t in reversed(range(values.shape[2])):
        total = values[..., t] + factor * total
        sums[..., t] = total
    return sums


# -- learners --------------------------------------------------------------------------------


class BatchLearner:
    """Learn E runs at once; `collect` and `update` in turn, as a single learner does.

    A run is active until it has its steps, or fails: `failures` says why, by run.
    """

    cycles_per_epoch = 1
    on: Tensor
    """The runs (E,) that take part now."""

    def __init__(
        self, learners: Sequence[Any], env: Any, draws: Draws | None = None
    ) -> None:
        """Stack learners whose configurations are `alike`; `env` has the same worlds for each."""
        self.learners, self.env = learners, env
        self.device = torch.device(env.device)
        self.worlds = Worlds(env, len(learners))
        self.cycles_per_epoch = learners[0].cycles_per_epoch
        self.config = learners[0].config
        spaces = env.single_observation_space
        self.width, self.n_goal = (
            math.prod(spaces[key].shape) for key in ("observation", "desired_goal")
        )
        self.n_actions = math.prod(env.single_action_space.shape)
        seeds = torch.tensor([one.seed for one in learners], device=self.device)
        self.draws = draws or Draws(seeds)
        self.runs = torch.arange(len(learners), device=self.device)
        self.failures, self._numbers = dict[int, str](), dict[str, Tensor]()
        rewards = [[r.scale, r.lowest, r.highest] for r in self._of("rewards")]
        numbers = torch.tensor(rewards, dtype=torch.float64, device=self.device)
        self.scale, self.lowest, self.highest = numbers.unbind(dim=1)
        self.build()

    def build(self) -> None:
        """Stack the learners' parts."""
        raise NotImplementedError

    def numbers(self, name: str) -> Tensor:
        """Return a hyperparameter of each run, (E, 1)."""
        if name not in self._numbers:
            values = [[float(getattr(one.config, name))] for one in self.learners]
            self._numbers[name] = torch.tensor(values, device=self.device)
        return self._numbers[name]

    def _of(self, name: str) -> list[Any]:
        return [getattr(one, name) for one in self.learners]

    def counters(self, name: str) -> Tensor:
        """Return a number that each single learner counts or keeps, (E,)."""
        return torch.tensor(self._of(name), device=self.device)

    @property
    def unit(self) -> Tensor:
        """Return what rewards are divided by, (E, 1); see `RewardScale`."""
        return torch.where(self.scale == 0, 1.0, self.scale)[:, None]

    def _see(self, rewards: Tensor) -> None:
        """Widen the bounds of the runs that are on to hold these rewards (E, n)."""
        mine = rewards.double()
        lowest = torch.minimum(self.lowest, mine.amin(dim=1))
        highest = torch.maximum(self.highest, mine.amax(dim=1))
        self.lowest = torch.where(self.on, lowest, self.lowest)
        self.highest = torch.where(self.on, highest, self.highest)

    def _grow(self, scale: Tensor, *critics: Networks) -> None:
        """Raise running scales of rewards to these (E,), and the critics with them."""
        if not self.config.normalize_rewards:
            return
        is_new = (scale > self.scale) & self.on
        factor = torch.where(is_new & (self.scale > 0), self.scale / scale, 1.0)
        for critic in critics:
            critic.scale_outputs(factor.float())
        self.scale = torch.where(is_new, scale, self.scale)

    def _write_rewards(self, i: int) -> None:
        values = torch.stack([self.scale, self.lowest, self.highest], dim=1)[i].tolist()
        rewards = self.learners[i].rewards
        rewards.scale, rewards.lowest, rewards.highest = values

    def columns(self, *more: int) -> list[Tensor]:
        """Return the places of each run's inputs: of its own observation, and all of `more`."""
        rest = torch.arange(self.width, self.width + sum(more), device=self.device)
        sizes = [
            one.spaces.observation["observation"].shape[0] for one in self.learners
        ]
        return [torch.cat([torch.arange(n, device=self.device), rest]) for n in sizes]

    @property
    def active(self) -> list[bool]:
        """True for runs that go on."""
        return [
            one.env_steps < one.total_timesteps and i not in self.failures
            for i, one in enumerate(self.learners)
        ]

    def _mask(self) -> Tensor:
        return torch.tensor(self.active, device=self.device)

    def _seed(self, purpose: int, counter: str) -> Callable[[int, int], int]:
        """Return the seeds of starts: those of the single learners' episodes."""

        def seed(i: int, number: int) -> int:
            one = self.learners[i]
            key = one.seed, 0, purpose, getattr(one, counter)
            return rollout.start_seed(key, number)

        return seed

    def _remaining(self, is_annealed: bool) -> Tensor:
        """Return what is left of each run, (E, 1); 1 where nothing is annealed."""
        left = [
            [one.progress_remaining if is_annealed else 1.0] for one in self.learners
        ]
        return torch.tensor(left, device=self.device)

    def _rows(self, **columns: Tensor) -> list[dict[str, float]]:
        """Return columns (E,) as one dict for each run; one transfer."""
        values = torch.stack([column.double() for column in columns.values()], dim=1)
        return [dict(zip(columns, row, strict=True)) for row in values.tolist()]

    def _summary(self, played: Played) -> list[dict[str, float]]:
        """Return counts and means over the episodes taken, as `rollout.summary` does."""
        taken = played.taken
        n = taken.sum(dim=1).clamp(min=1).double()
        steps = (played.lengths * taken).sum(dim=1)
        return self._rows(
            steps=steps,
            episodes=taken.sum(dim=1),
            success_rate=(played.success & taken).sum(dim=1) / n,
            mean_return=(played.rewards.sum(dim=2).double() * taken).sum(dim=1) / n,
            mean_length=steps / n,
            diverged=(played.diverged * taken).sum(dim=1),
            warnings=0.0 * n,
        )

    def _best(self, obs: Tensor) -> Tensor:
        """Return actions without exploration (E, W, d) from whole observations (E, W, ...)."""
        raise NotImplementedError

    @torch.no_grad()
    def play_best(
        self, asked: Sequence[bool], seed: Callable[[int, int], int], n: int
    ) -> list[dict[str, float]]:
        """Return counts and means of `n` episodes without exploration of the runs asked for (E,)."""

        def act(obs: Tensor, *_: Tensor) -> Tensor:
            return self._best(obs)

        def is_taken(lengths: Tensor, indices: Tensor) -> Tensor:
            return (indices < n).expand_as(lengths)

        on = torch.tensor(asked, device=self.device)
        return self._summary(self.worlds.play(act, seed, is_taken, on))

    def _count(self, played: Played) -> list[dict[str, float]]:
        """Add the steps of the active runs; one without a step to learn from has failed."""
        rows = self._summary(played)
        for i, is_active in enumerate(self.active):
            n_steps = int(rows[i].pop("steps"))
            if is_active and not n_steps:
                self.failures[i] = "all episodes diverged at their first step"
            self.learners[i].env_steps += n_steps * is_active
        return rows

    def _require_finite(self, losses: Tensor, *networks: Networks) -> None:
        """Fail runs with losses (E, n) or parameters that are not finite."""
        is_finite = torch.isfinite(losses).all(dim=1)
        for network in networks:
            is_finite &= torch.isfinite(network.flat).all(dim=1)
        for i, one in enumerate(is_finite.tolist()):
            if not one:
                steps = self.learners[i].env_steps
                reason = f"a loss or a parameter is not finite after {steps} steps"
                self.failures.setdefault(i, reason)

    def test(self, asked: Sequence[bool]) -> list[dict[str, float]]:
        """Return how good the runs that are asked for (E,) are without exploration; may be empty."""
        return []

    def write(self, i: int) -> Learner:
        """Write the state of run `i` into its single learner, and return that."""
        raise NotImplementedError


def _write_network(
    i: int, networks: Networks, network: MLP, flat: Tensor | None = None
) -> None:
    parts = networks.parts(i, networks.flat if flat is None else flat)
    for values, part in zip(network.parameters(), parts, strict=False):
        values.data.copy_(part.cpu())


def _write_adam(
    i: int,
    networks: Networks,
    adam: torch.optim.Adam,
    first: int,
    moments: Sequence[Tensor],
) -> None:
    """Write moments and the number of steps into the Adam of parameters from number `first` on."""
    m, v, n_steps = moments
    step, parameters = n_steps[i, 0].cpu(), adam.param_groups[0]["params"]
    parts = zip(networks.parts(i, m)[first:], networks.parts(i, v)[first:], strict=True)
    for parameter, (mean, square) in zip(parameters, parts, strict=False):
        if step and parameter.requires_grad:
            state = {
                "step": step.clone(),
                "exp_avg": mean.cpu(),
                "exp_avg_sq": square.cpu(),
            }
            adam.state[parameter] = state


def _read_adam(
    i: int, networks: Networks, adam: torch.optim.Adam, first: int = 0
) -> None:
    parts = zip(
        networks.parts(i, networks.m), networks.parts(i, networks.v), strict=True
    )
    for parameter, (mean, square) in zip(
        adam.param_groups[0]["params"], [*parts][first:], strict=False
    ):
        if state := adam.state.get(parameter):
            mean.copy_(state["exp_avg"])
            square.copy_(state["exp_avg_sq"])
            networks.n_steps[i] = float(state["step"])


class BatchPPO(BatchLearner):
    """Learn E runs by PPO."""

    def build(self) -> None:
        """Stack networks, moments and what the rewards were."""
        learners, config = self.learners, self.config
        columns, width = self.columns(self.n_goal), self.width + self.n_goal
        actors, critics = (
            [getattr(one, name) for one in learners] for name in ("actor", "critic")
        )
        self.actor = Networks(actors, columns, width, self.n_actions)
        self.critic = Networks(critics, columns, width)
        self.stats = Stats([one.obs_stats for one in learners], columns, width)
        for i, one in enumerate(learners):
            self._read_actor(i, one)
            _read_adam(i, self.critic, one.critic_adam)
        self.has_before = [bool(one.before_update) for one in learners]
        self.before = [part.clone() for part in self._actor_state()]
        for i in itertools.compress(range(len(learners)), self.has_before):
            self._read_before(i, learners[i].before_update)
        self.variance = self.numbers("action_variance")[..., None]
        rates = self.numbers("actor_lr"), self.numbers("critic_lr")
        std_lr = self.numbers("std_lr") if config.std_lr else rates[0]
        learned = float(config.exploration == "learned")
        n = self.actor.flat.shape[1] - self.n_actions
        self.actor_lr = torch.cat(
            [rates[0].expand(-1, n), std_lr.expand(-1, self.n_actions)], 1
        )
        self.is_learned = torch.ones_like(self.actor_lr)
        self.is_learned[:, n:] = learned
        self.critic_lr = rates[1]
        self.reach = {name: self.counters(name).double() for name in REACH}
        self.played: Played

    def _actor_state(self) -> list[Tensor]:
        return [
            self.actor.flat.detach(),
            self.actor.m,
            self.actor.v,
            self.actor.n_steps,
        ]

    def std(self) -> Tensor:
        """Return the standard deviation of each run's actions, (E, 1, d)."""
        return self.variance.sqrt() * self._log_std().exp()

    def _log_std(self) -> Tensor:
        return self.actor.flat[:, None, -self.n_actions :]

    def _log_prob(self, actions: Tensor, mean: Tensor) -> Tensor:
        residual = (actions - mean) / self._log_std().exp()
        constant = self.n_actions * torch.log(2 * math.pi * self.variance[..., 0])
        squared = residual.square().sum(dim=-1) / self.variance[..., 0]
        return -0.5 * (squared + constant) - self._log_std().sum(dim=-1)

    def _inputs(self, whole: Tensor) -> Tensor:
        """Return the networks' inputs (E, n, width) from whole observations (E, n, ...)."""
        parts = whole[..., : self.width], whole[..., -self.n_goal :]
        return torch.cat(parts, dim=-1)

    def _best(self, obs: Tensor) -> Tensor:
        return self.actor(self.stats.scale(self._inputs(obs)))

    @torch.no_grad()
    def collect(self) -> list[dict[str, float]]:
        """Play whole episodes until each active run has its `steps_per_epoch`."""
        epochs, std = self.counters("epochs")[:, None], self.std()

        def act(obs: Tensor, numbers: Tensor, steps: Tensor, moving: Tensor) -> Tensor:
            uniform = self.draws(
                rollout.TRAIN, epochs, numbers, steps, width=self.n_actions
            )
            return self._best(obs) + std * _normal(uniform)

        def is_taken(lengths: Tensor, indices: Tensor) -> Tensor:
            weights = lengths.clamp(min=1)
            return weights.cumsum(dim=1) - weights < self.config.steps_per_epoch

        self.left = self._remaining(self.config.anneal_lr)
        self.on = self._mask()
        seed = self._seed(rollout.TRAIN, "epochs")
        self.played = self.worlds.play(act, seed, is_taken, self.on)
        for one, is_on in zip(self.learners, self.active, strict=True):
            one.epochs += is_on
        rows = self._count(self.played)
        return rows

    def update(self) -> list[dict[str, float]]:
        """Take `n_passes` over each run's batch, in minibatches of its own."""
        config, n_runs = self.config, len(self.learners)
        rows, batch, lengths = self._batch()
        n = lengths.tolist()
        silent, undone = self._look_at_returns()
        counts = torch.tensor(
            [config.minibatches(max(1, k)) for k in n], device=self.device
        )
        entropy = 0.5 * self.n_actions * torch.log(2 * math.pi * math.e * self.variance)
        explained = _explained(batch.pop(), batch[-1], lengths)
        going, sums = self.on.clone(), torch.zeros(n_runs, 4, device=self.device)
        n_updates = torch.zeros_like(counts)
        epochs = self.counters("epochs")
        places = torch.arange(batch[0].shape[1], device=self.device)
        is_beyond = places >= lengths[:, None]
        for number in range(config.n_passes):
            keys = self.draws(ORDER, epochs, epochs * 0 + number, width=len(places))
            order = torch.where(is_beyond, 2.0, keys).argsort(dim=1, stable=True)
            kl = torch.zeros(n_runs, device=self.device)
            for index, mask in _minibatches(order, lengths, counts):
                stats = self._step(batch, index, mask & going[:, None], silent)
                sums += stats
                is_in = mask.any(dim=1)
                kl = torch.where(is_in, stats[:, 1], kl)
            n_updates += counts * going
            if config.target_kl is not None:
                going = going & (silent | ~(kl > self.numbers("target_kl")[:, 0]))
                if not bool(going.any()):
                    break
        means = sums / n_updates.clamp(min=1)[:, None]
        self._require_finite(means, self.actor, self.critic)
        self.stats.update(*rows)
        return self._rows(
            policy_loss=means[:, 0],
            value_loss=means[:, 3],
            kl=means[:, 1],
            clip_fraction=means[:, 2],
            explained_variance=explained,
            entropy=entropy[:, 0, 0] + self._log_std().detach().sum(dim=(1, 2)),
            action_std=self.std().detach().mean(dim=(1, 2)),
            undone=undone,
            updates=n_updates,
        )

    def _step(
        self, batch: Sequence[Tensor], index: Tensor, mask: Tensor, silent: Tensor
    ) -> Tensor:
        """Take an Adam step of actors and critics on a minibatch of each run, (E, size).

        Returns policy loss, KL estimate, clipped fraction and value loss, (E, 4).
        """
        obs, *others = batch
        x = obs.gather(1, index[..., None].expand(-1, -1, obs.shape[2]))
        actions = others[0].gather(1, index[..., None].expand(-1, -1, self.n_actions))
        log_prob, advantages, returns = (part.gather(1, index) for part in others[1:])
        share = mask / mask.sum(dim=1, keepdim=True).clamp(min=1)
        log_ratio = self._log_prob(actions, self.actor(x)) - log_prob
        result = surrogate(log_ratio, advantages, self.numbers("clip_range"))
        acts = mask.any(dim=1) & ~silent
        losses = (result.loss * share).sum(dim=1)
        errors = ((self.critic(x)[..., 0] - returns).square() * share).sum(dim=1)
        gradients = torch.autograd.grad(
            losses.sum() + errors.sum(), [self.actor.flat, self.critic.flat]
        )
        actor_lr = self.left * self.actor_lr
        self.actor.step(self._clipped(gradients[0] * self.is_learned), actor_lr, acts)
        self.critic.step(
            self._clipped(gradients[1]), self.left * self.critic_lr, mask.any(dim=1)
        )
        parts = losses, (result.kl * share).sum(1), (result.is_clipped * share).sum(1)
        of_actor = torch.stack([part.detach() for part in parts], dim=1) * acts[:, None]
        return torch.cat([of_actor, errors.detach()[:, None]], dim=1)

    def _clipped(self, gradient: Tensor) -> Tensor:
        norm = gradient.norm(dim=1, keepdim=True)
        return gradient * (self.numbers("max_grad_norm") / (norm + 1e-6)).clamp(max=1.0)

    def _look_at_returns(self) -> tuple[Tensor, Tensor]:
        """Return which runs' epochs say nothing to the actor, and how many updates were undone.

        As the single learner decides it; see there.
        """
        n_runs, device = len(self.learners), self.device
        verdicts = [(False, False, False)] * n_runs
        if not self.config.undo_silent:
            return (*torch.zeros(2, n_runs, dtype=torch.bool, device=device),)
        is_whole = (self.played.usable & (self.played.diverged == 0)).tolist()
        sums = self.played.rewards.double().sum(dim=2).tolist()
        for i, (one, is_on) in enumerate(
            zip(self.learners, self.on.tolist(), strict=True)
        ):
            returns = [*itertools.compress(sums[i], is_whole[i])]
            if returns and is_on:
                verdict = one.silence.judge(returns)
                is_kept = verdict == "learn" and one.silence.can_undo
                self.has_before[i] |= is_kept
                verdicts[i] = verdict != "learn", verdict == "undo", is_kept
        silent, undone, kept = torch.tensor(verdicts, device=device).unbind(dim=1)
        for now, before in zip(self._actor_state(), self.before, strict=True):
            before.copy_(torch.where(kept[:, None], now, before))
            now.copy_(torch.where(undone[:, None], before, now))
        return silent, undone

    @torch.no_grad()
    def _batch(self) -> tuple[tuple[Tensor, Tensor], list[Tensor], Tensor]:
        """Return all inputs with their mask, the transitions (E, n, ...), and how many each run has."""
        played = self.played
        raised = played.rewards.double() * played.usable[..., None]
        gamma, lam = self.numbers("gamma").double(), self.numbers("gae_lambda").double()
        self._grow(_discounted(raised, gamma).abs().amax(dim=(1, 2)), self.critic)
        raw = self._inputs(played.obs.flatten(1, 2))
        x = self.stats.scale(raw)
        values = self.critic(x)[..., 0].view(played.obs.shape[:3]).double()
        is_row, lengths = played.rows() & self.on[:, None, None], played.lengths
        self._see((played.rewards * is_row).flatten(1))
        inside = torch.where(is_row, values[..., :-1], torch.nan).flatten(1)
        lowest = inside.nan_to_num(torch.inf).amin(dim=1, keepdim=True)
        highest = inside.nan_to_num(-torch.inf).amax(dim=1, keepdim=True)
        goes_on = played.diverged > 0
        if self.config.truncation == "bootstrap":
            goes_on = goes_on | ~played.terminated
        self._follow_returns(torch.maximum(-lowest, highest)[:, 0], goes_on)
        last = values.gather(2, lengths[..., None])[..., 0]
        last = last.clamp(lowest, highest) * goes_on
        is_last = (
            torch.arange(values.shape[2] - 1, device=self.device)
            == lengths[..., None] - 1
        )
        following = torch.where(is_last, last[..., None], values[..., 1:])
        rewards = played.rewards.double() / self.unit[..., None]
        deltas = (rewards + gamma[..., None] * following - values[..., :-1]) * is_row
        advantages = _discounted(deltas, gamma * lam)
        returns = advantages + values[..., :-1]
        order = (~is_row.flatten(1)).int().argsort(dim=1, stable=True)
        counts = is_row.sum(dim=(1, 2))
        order = order[:, : max(1, int(counts.max()))]
        obs = x.view(*played.obs.shape[:3], -1)[:, :, :-1].flatten(1, 2)
        obs = obs.gather(1, order[..., None].expand(-1, -1, obs.shape[2]))
        actions = played.actions.flatten(1, 2)
        actions = actions.gather(1, order[..., None].expand(-1, -1, self.n_actions))
        log_prob = self._log_prob(actions, self.actor(obs))
        normal = _normalized(advantages.flatten(1).gather(1, order), counts)
        target = returns.flatten(1).gather(1, order)
        learned = values[..., :-1].flatten(1).gather(1, order)
        batch = [obs, actions, log_prob, normal, target, learned]
        batch = [part.float() for part in batch]
        return (raw, played.rows(1).flatten(1) & self.on[:, None]), batch, counts

    def _follow_returns(self, reach: Tensor, goes_on: Tensor) -> None:
        """Keep how far the first values (E,) reach, and the returns that episodes could have had.

        They are those with which the single learner judges whether its critic has diverged.
        """
        played, gamma = self.played, self.numbers("gamma").double()
        usable = played.usable & self.on[:, None]
        first, low, high = self.reach.values()
        first = torch.where((first == 0) & self.on, reach, first)
        rewards = _padded(played.rewards.double(), played.rewards.shape[2] + 1)
        for extreme in (self.lowest[:, None], self.highest[:, None]):
            rest = torch.where(goes_on & (extreme != 0), extreme / (1.0 - gamma), 0.0)
            whole = rewards.scatter(2, played.lengths[..., None], rest[..., None])
            sums = torch.where(usable[..., None], _discounted(whole, gamma), 0.0)
            low = torch.minimum(low, sums.amin(dim=(1, 2)))
            high = torch.maximum(high, sums.amax(dim=(1, 2)))
        self.reach = dict(zip(REACH, (first, low, high), strict=True))

    def _read_before(self, i: int, saved: dict[str, Any]) -> None:
        """Take the actor to which an undone update of run `i` goes back from its saved states."""
        one, kept = copy.deepcopy(self.learners[i]), self._actor_state()
        restore({name: getattr(one, name) for name in one.acting}, saved)
        now = [part[i].clone() for part in kept]
        self._read_actor(i, one)
        for part, before, before_read in zip(kept, self.before, now, strict=True):
            before[i] = part[i]
            part[i] = before_read

    def _read_actor(self, i: int, one: PPO) -> None:
        parts = self.actor.parts(i, self.actor.flat)
        values = [*one.actor.parameters(), one.gaussian.log_std]
        for part, value in zip(parts, values, strict=True):
            part.copy_(value.detach())
        _read_adam(i, self.actor, one.actor_adam)
        _read_adam(i, self.actor, one.std_adam, len(self.actor.shapes))

    def _write_actor(self, i: int, one: PPO, state: Sequence[Tensor]) -> None:
        flat, *moments = state
        _write_network(i, self.actor, one.actor, flat)
        one.gaussian.log_std.data.copy_(self.actor.parts(i, flat)[-1].cpu())
        _write_adam(i, self.actor, one.actor_adam, 0, moments)
        _write_adam(i, self.actor, one.std_adam, len(self.actor.shapes), moments)

    def write(self, i: int) -> PPO:
        """Write the state of run `i` into its single learner, and return that."""
        one: PPO = self.learners[i]
        if self.has_before[i]:
            self._write_actor(i, one, self.before)
            states = {name: getattr(one, name).state_dict() for name in one.acting}
            one.before_update = copy.deepcopy(states)
        self._write_actor(i, one, self._actor_state())
        _write_network(i, self.critic, one.critic)
        critic = self.critic
        _write_adam(i, critic, one.critic_adam, 0, (critic.m, critic.v, critic.n_steps))
        self.stats.write(i, one.obs_stats)
        self._write_rewards(i)
        for name, values in self.reach.items():
            setattr(one, name, float(values[i]))
        return one


def _minibatches(
    order: Tensor, lengths: Tensor, counts: Tensor
) -> Iterator[tuple[Tensor, Tensor]]:
    """Split each run's rows (E, n) evenly into so many minibatches (E,), as `tensor_split` does.

    Yields rows (E, size), and a mask of those that are there, which are none once a run has no more.
    """
    small, n_larger = (lengths // counts)[:, None], (lengths % counts)[:, None]
    places = torch.arange(int(small.max()) + 1, device=order.device)
    for j in range(int(counts.max())):
        start = j * small + n_larger.clamp(max=j)
        mask = (places < small + (j < n_larger)) & (j < counts[:, None])
        yield order.gather(1, (start + places).clamp(max=order.shape[1] - 1)), mask


def _normalized(advantages: Tensor, counts: Tensor) -> Tensor:
    """Return advantages (E, n) with mean 0 and standard deviation 1 over the first `counts` (E,)."""
    mask = torch.arange(advantages.shape[1], device=counts.device) < counts[:, None]
    n = counts[:, None].clamp(min=1)
    centred = (advantages - (advantages * mask).sum(1, keepdim=True) / n) * mask
    std = (centred.square().sum(1, keepdim=True) / n).sqrt()
    is_spread = std > 1e-10 * (advantages * mask).abs().amax(1, keepdim=True)
    return torch.where(is_spread, centred / std, 0.0)


def _explained(values: Tensor, returns: Tensor, counts: Tensor) -> Tensor:
    """Return what `explained_variance` does of the first `counts` (E,) values (E, n)."""
    mask = torch.arange(values.shape[1], device=counts.device) < counts[:, None]
    n, spreads = counts.clamp(min=1), list[Tensor]()
    for part in (returns - values, returns):
        mean = (part * mask).sum(dim=1) / n
        spreads.append(((part - mean[:, None]) * mask).square().sum(dim=1))
    return torch.where(spreads[1] > 0, 1.0 - spreads[0] / spreads[1], 0.0)


class BatchDDPGHER(BatchLearner):
    """Learn E runs by DDPG with hindsight."""

    def build(self) -> None:
        """Stack networks, their targets, moments and replays."""
        learners, n_runs = self.learners, len(self.learners)
        width, device = self.width + self.n_goal, self.device
        names = ("actor", "target_actor", "critic", "target_critic")
        actors, old_actors, critics, old_critics = (
            [getattr(one, name) for one in learners] for name in names
        )
        columns = self.columns(self.n_goal)
        self.actor = Networks(actors, columns, width)
        self.target_actor = Networks(old_actors, columns, width)
        columns, width = (
            self.columns(self.n_goal, self.n_actions),
            width + self.n_actions,
        )
        self.critic = Networks(critics, columns, width)
        self.target_critic = Networks(old_critics, columns, width)
        goals = [torch.arange(self.n_goal, device=device)] * n_runs
        own = self.columns()
        self.obs_stats = Stats([one.obs_stats for one in learners], own, self.width)
        self.goal_stats = Stats(
            [one.goal_stats for one in learners], goals, self.n_goal
        )
        for i, one in enumerate(learners):
            _read_adam(i, self.actor, one.actor_adam)
            _read_adam(i, self.critic, one.critic_adam)
        self.largest = torch.zeros_like(self.highest)
        one_return = rollout.largest_return
        steps = learners[0].replay.max_steps
        of_ones = [one_return([1.0] * steps, one.config.gamma) for one in learners]
        self.of_ones = torch.tensor(of_ones, device=device, dtype=torch.float64)
        self.is_relabelled = any(one.config.replay_p for one in learners)
        whole = self.width + 2 * self.n_goal
        self.memory = torch.zeros(
            n_runs, 0, steps + 1, whole + self.n_actions + 2, device=device
        )
        self.lengths = torch.zeros(n_runs, 0, dtype=torch.long, device=device)
        self.n_stored = [0] * n_runs
        for i, one in enumerate(learners):
            self._read_memory(i, one.replay)

    def _inputs(self, whole: Tensor) -> Tensor:
        """Return the actor's inputs (E, n, width) from whole observations (E, n, ...)."""
        return self._scaled(whole[..., : self.width], whole[..., -self.n_goal :])

    def _scaled(self, obs: Tensor, goals: Tensor) -> Tensor:
        limit = self.numbers("clip_obs")[..., None]
        obs, goals = (part.clamp(-limit, limit) for part in (obs, goals))
        return torch.cat(
            [self.obs_stats.scale(obs), self.goal_stats.scale(goals)], dim=-1
        )

    def _best(self, obs: Tensor) -> Tensor:
        return self.actor(self._inputs(obs))

    def _play(self, n: int) -> Played:
        """Play `n` episodes of each active run that have steps."""
        cycles, purpose = self.counters("cycles")[:, None], rollout.TRAIN
        left = self._remaining(self.config.anneal_noise)
        noise_eps, random_eps = (
            left * self.numbers(name) for name in ("noise_eps", "random_eps")
        )
        hold = self.numbers("random_hold")
        begin = random_eps / (random_eps + hold * (1.0 - random_eps))
        is_random = torch.zeros(self.worlds.shape, dtype=torch.bool, device=self.device)
        drawn = torch.zeros(*self.worlds.shape, self.n_actions, device=self.device)

        def act(obs: Tensor, numbers: Tensor, steps: Tensor, moving: Tensor) -> Tensor:
            nonlocal is_random, drawn
            actions, d = self._best(obs), self.n_actions
            uniform = self.draws(purpose, cycles, numbers, steps, width=2 * d + 1)
            noise, chance = (
                noise_eps[..., None] * _normal(uniform[..., :d]),
                uniform[..., d],
            )
            noisy = (actions + noise).clamp(-1.0, 1.0)
            new = (2 * uniform[..., d + 1 :] - 1).float()
            is_first = steps == 0
            after = torch.where(is_random, begin / hold, begin)
            is_new = chance < torch.where(is_first, random_eps, after)
            is_held = is_random & ~is_first & (chance >= 1.0 / hold)
            drawn = torch.where((is_new & moving)[..., None], new, drawn)
            is_random = torch.where(moving, is_new | is_held, is_random)
            return torch.where(is_random[..., None], drawn, noisy)

        def is_taken(lengths: Tensor, indices: Tensor) -> Tensor:
            has_steps = lengths > 0
            return has_steps.cumsum(dim=1) - has_steps.long() < n

        with torch.no_grad():
            return self.worlds.play(
                act, self._seed(purpose, "cycles"), is_taken, self.on
            )

    @torch.no_grad()
    def collect(self) -> list[dict[str, float]]:
        """Play one cycle's episodes: into the replays, and relabelled into the moments."""
        self.on = self._mask()
        self.lr_left = self._remaining(self.config.anneal_lr)
        self.l2_left = self._remaining(self.config.anneal_action_l2)
        played = self._play(self.config.n_rollouts)
        sums = _discounted(played.rewards.double(), self.numbers("gamma").double())
        usable = played.usable & self.on[:, None]
        self.largest = (sums.abs() * usable[..., None]).amax(dim=(1, 2))
        self.key = self.counters("cycles")
        for one, is_on in zip(self.learners, self.active, strict=True):
            one.cycles += is_on
        rows = self._count(played)
        slots = self._store(played, usable)
        n = (played.lengths * usable).sum(dim=1)
        batch = self._sample(n, int(n.max()), slots, 0)
        rows_in = torch.arange(batch.reward.shape[1], device=self.device) < n[:, None]
        limit = self.numbers("clip_obs")[..., None]
        self.obs_stats.update(batch.obs.clamp(-limit, limit), rows_in)
        self.goal_stats.update(batch.goal.clamp(-limit, limit), rows_in)
        return rows

    def test(self, asked: Sequence[bool]) -> list[dict[str, float]]:
        """Return how good the runs that are asked for (E,) are without exploration."""
        n = self.config.n_test_rollouts * self.config.n_rollouts
        if not n:
            return []
        rows = self.play_best(asked, self._seed(rollout.TEST, "cycles"), n)
        names = ("success_rate", "mean_return", *rollout.FAULTS)
        return [{f"test_{name}": row[name] for name in names} for row in rows]

    # -- replay ------------------------------------------------------------------------------

    def _store(self, played: Played, usable: Tensor) -> Tensor:
        """Keep each run's episodes; return their slots (E, k), -1 where a run has fewer."""
        n_slots, k = self.learners[0].replay.n_slots, int(usable.sum(dim=1).max())
        slots = torch.full((len(self.learners), k), -1)
        for i, n in enumerate(usable.sum(dim=1).tolist()):
            free = range(self.n_stored[i], min(self.n_stored[i] + n, n_slots))
            slots[i, : len(free)] = torch.tensor([*free], dtype=torch.long)
            self.n_stored[i] += len(free)
            if len(free) < n:  # full: random ones
                u = self.draws(SLOT, self.key, width=n)[i].cpu()
                slots[i, len(free) : n] = (u * n_slots).long()[len(free) :]
        slots = slots.to(self.device)
        self._make_room(max(self.n_stored))
        order = (~usable).int().argsort(dim=1, stable=True)[:, :k]
        e = torch.arange(len(order), device=self.device)[:, None]
        steps = played.rewards.shape[2]
        ends = torch.arange(steps, device=self.device) == played.lengths[..., None] - 1
        ends = ends & played.terminated[..., None]
        done = [played.actions, played.rewards[..., None], ends[..., None]]
        columns = torch.cat([part.float() for part in done], dim=-1)
        columns = torch.cat([columns, torch.zeros_like(columns[:, :, :1])], dim=2)
        rows = torch.cat([played.obs, columns], dim=-1)[e, order]
        is_in = slots >= 0
        where = e.expand_as(slots)[is_in], slots[is_in]
        self.memory[where[0], where[1], : steps + 1] = rows[is_in]
        self.lengths[where] = played.lengths[e, order][is_in]
        for one, mine in zip(self.learners, slots.tolist(), strict=True):
            unsaved = self.unsaved.setdefault(id(one), {})
            unsaved.update(dict.fromkeys(slot for slot in mine if slot >= 0))
        return slots

    def _make_room(self, n: int) -> None:
        if missing := max(0, n - self.lengths.shape[1]):
            more = max(missing, self.lengths.shape[1], 32)
            shape = (len(self.memory), more, *self.memory.shape[2:])
            self.memory = torch.cat([self.memory, self.memory.new_zeros(shape)], dim=1)
            self.lengths = torch.cat(
                [self.lengths, self.lengths.new_zeros(shape[:2])], dim=1
            )

    def _sample(
        self, n: Tensor, width: int, slots: Tensor | None, number: int
    ) -> Batch[Tensor]:
        """Return `width` relabelled transitions of each run, of which `n` (E,) count; see `Replay`."""
        e = torch.arange(len(self.learners), device=self.device)[:, None]
        lengths = self.lengths
        if slots is not None:
            lengths = torch.where(slots >= 0, lengths[e, slots.clamp(min=0)], 0)
        ends = lengths.cumsum(dim=1)
        u = self.draws(
            PICK,
            self.key[:, None],
            n[:, None],
            torch.arange(width, device=e.device) * 2 + number,
            width=3,
        )
        pick = (u[..., 0] * ends[:, -1:]).long()
        which = torch.searchsorted(ends, pick, right=True).clamp(max=ends.shape[1] - 1)
        length = lengths.gather(1, which)
        t = pick - (ends.gather(1, which) - length)
        slot = which if slots is None else slots.gather(1, which).clamp(min=0)
        row, following = self.memory[e, slot, t], self.memory[e, slot, t + 1]
        a, b = self.width, self.width + self.n_goal
        goal, reward = row[..., b : b + self.n_goal], row[..., -2]
        terminal = row[..., -1]
        if self.is_relabelled:
            is_new = u[..., 1] < self.numbers("replay_p")
            future = t + 1 + (u[..., 2] * (length - t)).long()
            goal = torch.where(
                is_new[..., None], self.memory[e, slot, future][..., a:b], goal
            )
            reward, over = self._judged(following[..., a:b], goal)
            if slots is None and self.learners[0].replay.ends:
                terminal = self._terminal(reward, terminal, is_new, over)
        first = b + self.n_goal
        action = row[..., first : first + self.n_actions]
        return Batch(row[..., :a], goal, action, reward, following[..., :a], terminal)

    def _judged(
        self, achieved: Tensor, desired: Tensor
    ) -> tuple[Tensor, Tensor | None]:
        """Return rewards (E, n) of goals (E, n, goal), and whether they end an episode, if known.

        The environment computes them with NumPy.
        """
        replay, shape = self.learners[0].replay, achieved.shape[:2]
        goals = [part.flatten(0, 1).cpu().numpy() for part in (achieved, desired)]
        ends = replay.ends(*goals) if replay.ends else None
        rewards, over = (
            None
            if part is None
            else torch.as_tensor(part, dtype=torch.float32, device=self.device)
            for part in (replay.reward(*goals), ends)
        )
        assert rewards is not None
        return rewards.view(shape), None if over is None else over.view(shape)

    def _terminal(
        self, reward: Tensor, was: Tensor, is_new: Tensor, ends: Tensor | None
    ) -> Tensor:
        """Return whether transitions (E, n) end the episode, as the single learner's replay does."""
        if ends is not None:
            return torch.where(is_new, ends, was)
        rows = (self.lengths - 1).clamp(min=0)[..., None, None].expand(-1, -1, -1, 2)
        last = self.memory[..., -2:].gather(2, rows)[:, :, 0]
        has_ended = (self.lengths > 0) & (last[..., 1] == 1)
        lowest = torch.where(has_ended, last[..., 0], torch.inf).amin(dim=1)
        others = torch.where(is_new | (was == 1), -torch.inf, reward).amax(dim=1)
        is_told = ((lowest > others) & (others > -torch.inf))[:, None]
        return torch.where(is_told & is_new, (reward >= lowest[:, None]).float(), was)

    # -- learning ----------------------------------------------------------------------------

    def update(self) -> list[dict[str, float]]:
        """Take one cycle's updates of each active run, and move its target networks."""
        config, n = self.config, self.config.n_batches
        size, counts = (
            n * config.batch_size,
            torch.full_like(self.runs, n * config.batch_size),
        )
        drawn = self._sample(counts, size, None, 1)
        self._see(drawn.reward)
        extreme = torch.stack([-self.lowest, self.highest, self.largest]).amax(dim=0)
        self._grow(extreme / self.of_ones, self.critic, self.target_critic)
        batch = drawn._replace(
            obs=self._scaled(drawn.obs, drawn.goal),
            next_obs=self._scaled(drawn.next_obs, drawn.goal),
        )
        parts = (torch.split(part, config.batch_size, dim=1) for part in batch)
        sums = torch.zeros(len(self.learners), 3, device=self.device)
        for i, minibatch in enumerate(zip(*parts, strict=True), start=1):
            sums += self._step(Batch(*minibatch))
            if i % (config.target_update_interval or n) == 0 or i == n:
                self._move_targets()
        for one, is_on in zip(self.learners, self.on.tolist(), strict=True):
            one.updates += n * is_on
        means = sums / n
        self._require_finite(means, self.actor, self.critic)
        return self._rows(
            critic_loss=means[:, 0],
            actor_loss=means[:, 1],
            mean_q=means[:, 2] * self.unit[:, 0],
            updates=counts * 0 + n,
        )

    def _step(self, batch: Batch[Tensor]) -> Tensor:
        """Take one Adam step of critics and actors, both from the same parameters.

        Returns the critics' losses, the actors' and the mean Q of the actors' actions, (E, 3).
        """
        targets = self._targets(batch)
        values = self.critic(torch.cat([batch.obs, batch.action], dim=2))[..., 0]
        errors = (values - targets).square().mean(dim=1)
        (of_critic,) = torch.autograd.grad(errors.sum(), [self.critic.flat])
        actions = self.actor(batch.obs)
        inputs = torch.cat([batch.obs, actions], dim=2)
        mean_q = self.critic(inputs, self.critic.flat.detach())[..., 0].mean(dim=1)
        action_l2 = (self.l2_left * self.numbers("action_l2"))[:, 0]
        losses = action_l2 * actions.square().mean(dim=(1, 2)) - mean_q
        (of_actor,) = torch.autograd.grad(losses.sum(), [self.actor.flat])
        self.critic.step(of_critic, self.lr_left * self.numbers("critic_lr"), self.on)
        self.actor.step(of_actor, self.lr_left * self.numbers("actor_lr"), self.on)
        return torch.stack([errors, losses, mean_q], dim=1).detach()

    @torch.no_grad()
    def _targets(self, batch: Batch[Tensor]) -> Tensor:
        """Return the critics' targets (E, n), from the target networks."""
        actions = self.target_actor(batch.next_obs)
        values = self.target_critic(torch.cat([batch.next_obs, actions], dim=2))[..., 0]
        unit, gamma = self.unit, self.numbers("gamma")
        terminal = batch.terminal * (self.config.termination == "terminal")
        rewards = batch.reward / unit.float()
        targets = td_targets(rewards, values, terminal, gamma, None)  # type: ignore[arg-type]
        if not self.config.clip_target:
            return targets
        span = self.lowest[:, None] / unit, self.highest[:, None] / unit
        return targets.clamp(*((reward / (1.0 - gamma)).float() for reward in span))

    @torch.no_grad()
    def _move_targets(self) -> None:
        """Move the target networks by 1 - polyak towards actors and critics."""
        share = (1.0 - self.numbers("polyak")) * self.on[:, None]
        for target, network in (
            (self.target_actor, self.actor),
            (self.target_critic, self.critic),
        ):
            target.flat.lerp_(network.flat, share)

    # -- saving ------------------------------------------------------------------------------

    def _read_memory(self, i: int, replay: Replay) -> None:
        """Take what a single learner's replay holds."""
        self.unsaved = getattr(self, "unsaved", {})
        self.n_stored[i] = replay.n_episodes
        self._make_room(replay.n_episodes)
        for slot in range(replay.n_episodes):
            episode = replay.episode(slot)
            n = len(episode["obs"])
            goals = torch.from_numpy(
                np.concatenate([episode["achieved"], episode["desired"]], 1)
            )
            width = episode["obs"].shape[1]
            rewards = np.zeros(n, np.float32)
            achieved, desired = episode["achieved"][1:], episode["desired"][1:]
            rewards[:-1] = self.learners[i].workers.compute_reward(achieved, desired)
            row = self.memory[i, slot, :n]
            row[:, :width] = torch.from_numpy(episode["obs"])
            row[:, self.width : self.width + 2 * self.n_goal] = goals
            first = self.width + 2 * self.n_goal
            row[:, first:-2] = torch.from_numpy(episode["action"])
            row[:, -2] = torch.from_numpy(rewards)
            row[:, -1] = torch.from_numpy(episode["terminal"][:, 0].astype(np.float32))
            self.lengths[i, slot] = n - 1

    def write(self, i: int) -> DDPGHER:
        """Write the state of run `i`, with what is new in its replay, into its single learner."""
        one: DDPGHER = self.learners[i]
        networks = (
            (self.actor, one.actor),
            (self.target_actor, one.target_actor),
            (self.critic, one.critic),
            (self.target_critic, one.target_critic),
        )
        for stacked, network in networks:
            _write_network(i, stacked, network)
        for stacked, adam in (
            (self.actor, one.actor_adam),
            (self.critic, one.critic_adam),
        ):
            _write_adam(i, stacked, adam, 0, (stacked.m, stacked.v, stacked.n_steps))
        self.obs_stats.write(i, one.obs_stats)
        self.goal_stats.write(i, one.goal_stats)
        self._write_rewards(i)
        width, goal = len(self.obs_stats.columns[i]), self.n_goal
        for slot in self.unsaved.pop(id(one), {}):
            n = int(self.lengths[i, slot])
            rows = self.memory[i, slot, : n + 1].cpu().numpy()
            a, first = self.width, self.width + 2 * goal
            columns = {
                "obs": rows[:, :width],
                "achieved": rows[:, a : a + goal],
                "desired": rows[:, a + goal : first],
                "action": rows[:, first:-2],
                "terminal": rows[:, -1:],
            }
            one.replay.put(slot, columns)
        return one


BATCHED: dict[type, type[Any]] = {PPO: BatchPPO, DDPGHER: BatchDDPGHER}
"""Learners that a batch has a form of."""
