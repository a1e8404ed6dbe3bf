"""BatchEnv: what `GraspEnv` plays, in many worlds at once; a Gymnasium VectorEnv.

Its parts are `GraspEnv`'s own, whose arrays have a leading axis here: touch and senses PyTorch's, on the
device, tasks, hold tests and what an episode draws NumPy's. Taxels move nothing: worlds with other
layouts, other faults or no touch at all share one batch of physics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import fields, is_dataclass, replace
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple, TypeVar

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from torch import Tensor

from . import tasks, touch
from .grasp import EJECTED, LIMIT, GraspConfig, GraspEnv
from .hold import Trial
from .objects import host
from .observations import Observer
from .simulators import batch as simulators
from .state import Array, Contacts, State

T = TypeVar("T")
Obs = dict[str, Any]
BY_GROUP = frozenset(
    (
        "layout",
        "touch",
        "hand_seed",
        *(f.name for f in fields(GraspConfig) if f.name.startswith("taxel_")),
    )
)
"""Fields in which the groups of a batch may differ."""


def require_batched(configs: Sequence[GraspConfig]) -> None:
    """Raise ValueError naming what keeps these scenes from being one batch."""
    first = configs[0]
    for field in fields(GraspConfig):
        values = {getattr(config, field.name) for config in configs}
        if field.name not in BY_GROUP and len(values) > 1:
            raise ValueError(
                f"{field.name}: found {values} in a batch, allowed one value"
            )
    if first.simulator != "mujoco":
        raise ValueError(
            f"simulator: found {first.simulator!r} in a batch, allowed: mujoco"
        )
    for name, known in (("touch_rule", touch.RULES), ("task", tasks.TASKS)):
        found = getattr(first, name)
        if not vars(known[found]).get(
            "is_batched"
        ):  # of its own: it may override what its base does
            allowed = [
                key for key, kind in known.items() if vars(kind).get("is_batched")
            ]
            raise ValueError(
                f"{name}: found {found!r} in a batch, allowed: {', '.join(allowed)}, or a class of yours "
                "that says is_batched = True"
            )
    if "," in first.object:
        raise ValueError(f"object: found {first.object!r} in a batch, allowed one kind")


class BatchEnv(gym.vector.VectorEnv[Any, Any, Any]):
    """Many worlds of one scene, in groups that may differ in layout, touch and the taxels' faults.

    Worlds of a group are consecutive. Observations are a dict of float32 tensors (n, ...) on the
    device: ``observation``, each group's own at the front and zeros behind (`widths`),
    ``achieved_goal`` and ``desired_goal``. Rewards are float32, the rest bool, (n,): tensors as well;
    NumPy's with `numpy=True`. In ``info``, each (n,) and NumPy's: ``is_success``; ``diverged``, as in
    `GraspEnv`, or because a world had no room for its contacts (``overflowed``); and ``holding``.

    A step that ends in a hold test is not over before the test is, which takes several calls of `step`:
    until then the world is ``holding``, shows what it showed before that step, has reward 0 and ignores
    actions. The call that says ``holding`` no more ends the step: it returns observation, reward and
    end as `GraspEnv` returns them at once. So a learner keeps the observation and the action with which
    it began a step until that step comes back without ``holding``.

    With `AutoresetMode.DISABLED` a world that has ended stands still until it is reset.
    """

    def __init__(
        self,
        hand: str,
        groups: Sequence[tuple[GraspConfig, int]],
        device: str = "cuda",
        autoreset: AutoresetMode = AutoresetMode.NEXT_STEP,
        numpy: bool = False,
        draws: str | None = None,
        **simulator: Any,
    ) -> None:
        """Make groups of worlds: the scene of each, and how many.

        `device` is PyTorch's for MuJoCo Warp, or "loop": MuJoCo in a loop, on the CPU. `draws` says
        what the noise of each step comes from: "host", `GraspEnv`'s own generators, the same numbers
        (usual with "loop"), or "device" (else), a counter hashed with the episode's key. What an
        episode draws at its start is the same with both. `simulator` are options of the simulator.

        Raise ValueError for scenes that do not go together.
        """
        configs = [config for config, _ in groups]
        require_batched(configs)
        self.group_sizes = sizes = tuple(size for _, size in groups)
        """Number of worlds in each group."""
        self.num_envs = n = sum(sizes)
        kinds = [replace(config, hand_seed=None) for config in configs]
        made = {kind: GraspEnv(hand, kind) for kind in dict.fromkeys(kinds)}
        envs = [made[kind] for kind in kinds]
        self._single = single = envs[0]
        self.config, self.hand, self.task = single.config, single.hand, single.task
        self.max_episode_steps = single.max_episode_steps
        self.widths = tuple(len(env.observation_names()) for env in envs)
        """Length of each group's own ``observation``."""
        self.simulator = simulators.make(single.simulator.scene, n, device, **simulator)
        self.device = self.simulator.device
        self._draws = _DRAWS[draws or ("host" if device == "loop" else "device")]
        tensor = self.simulator.tensor
        self._observer = _together([single._observer], [n], tensor)
        self._members = []
        groups_of_worlds = np.repeat(np.arange(len(groups)), sizes)
        for env in made.values():
            own = [number for number, other in enumerate(envs) if other is env]
            observers = [env.observer(configs[number]) for number in own]
            observer = _together(observers, [sizes[number] for number in own], tensor)
            rule = (
                _together([env._touch], [n], tensor)
                if env.config.touch == "on"
                else None
            )
            worlds = np.flatnonzero(np.isin(groups_of_worlds, own))
            m = 0 if env.config.touch == "absent" else len(env.taxels)
            self._members.append(
                _Member(
                    worlds,
                    torch.as_tensor(worlds, device=self.device),
                    m,
                    rule,
                    observer,
                )
            )
        rules = [member.rule for member in self._members if member.rule is not None]
        self._wants_contacts = self.task.by_contacts or any(
            rule.by_contacts for rule in rules
        )
        self.metadata = {"autoreset_mode": autoreset}
        self._autoreset, self._numpy = autoreset, numpy
        self.single_action_space = single.action_space
        self.action_space = batch_space(single.action_space, n)
        self.group_observation_spaces = tuple(env.observation_space for env in envs)
        widest = envs[int(np.argmax(self.widths))]
        self.single_observation_space: Any = widest.observation_space
        self.observation_space = batch_space(self.single_observation_space, n)
        self._rng, self._rngs = np.random.default_rng(), np.full(n, None)
        self._keys = (
            np.full(n, None) if self._draws is HostDraws else np.zeros(n, np.int64)
        )
        self._targets = np.tile(single.hand.start_targets(), (n, 1))
        self._steps, self._position = np.zeros(n, int), np.zeros((n, 3))
        self._holding, self._over = np.zeros(n, bool), np.ones(n, bool)
        self._trial = Trial(
            *(np.zeros((n, *shape)) for shape in ((), (), (), (), (8, 3)))
        )
        self._achieved, self._desired, self._shown, self._held, self._lost = np.zeros(
            (5, n, self.task.goal_size), np.float32
        )
        self._obs = torch.zeros((n, max(self.widths)), device=self.device)
        self._pending = self._obs.clone()
        self._felt = tensor(
            np.zeros((n, max(member.n_taxels for member in self._members)))
        )
        self.n_diverged = self.n_overflowed = 0
        """Episodes that ended so, since the batch was made."""

    # -- episodes ----------------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Obs, dict[str, Any]]:
        """Begin an episode in all worlds, or those of ``options["reset_mask"]``, bool (n,).

        A seed is a number, to which each world adds its index, or one for each of the n worlds. A world
        plays the episode that `GraspEnv` plays after ``reset(seed=...)`` with its seed. Without one, a
        world's generator goes on with draws from the "host"; else starts come from a generator of the
        batch, which follows from the last seeds given.
        """
        n = self.num_envs
        mask = np.asarray((options or {}).get("reset_mask", np.ones(n, bool)), bool)
        seeds: Any = [None] * n if seed is None else seed
        if isinstance(seed, int | np.integer):
            seeds = [seed + i for i in range(n)]
        worlds = np.flatnonzero(mask).tolist()
        given = {i: int(seeds[i]) for i in worlds if seeds[i] is not None}
        if given:
            self._rng = np.random.default_rng([*given.values()])
        is_own = bool(given) or self._draws is HostDraws
        for i in worlds if is_own else ():
            if i in given or self._rngs[i] is None:
                self._rngs[i], _ = gym.utils.seeding.np_random(given.get(i))
        self._begin(mask, is_own)
        self._observe(*self._look(), mask, mask)
        return self._out(self._obs_dict()), self._info()

    def _begin(self, mask: Array, is_own: bool) -> None:
        """Put worlds at the start of their next episodes, from their own generators or the batch's."""
        worlds = np.flatnonzero(mask)
        if not (k := len(worlds)):
            return
        rng = (
            HostDraws(self._rngs[worlds])
            if is_own
            else OneForAll(self._rng, np.ones(k, bool))
        )
        item, start, observer_rng, self._task_rng = self._single.draw_start(rng)
        is_host = self._draws is HostDraws
        self._keys[worlds] = (
            observer_rng.keys if is_host else observer_rng.integers(2**63)
        )
        half_size = np.stack(item.shape.half_size, axis=-1)
        self.simulator.change_object(worlds, half_size, item.mass, item.friction)
        place = [
            np.broadcast_to(part, (k, *np.shape(part)[-rank:][:rank]))
            for part, rank in zip(start, (1, 1, 0, 1), strict=True)
        ]
        self.simulator.reset(worlds, *place)
        self._targets[worlds] = place[-1]
        self._steps[mask], self._over[mask], self._holding[mask] = 0, False, False

    def _give(self, steps: Array) -> None:
        """Let the task's giver do what is due before actions of these numbers; below 0, nothing."""
        giving = partial(self.task.giving, steps)
        goal, *does = _in_some(steps >= 0, [self.task], giving)
        sets_off, lets_go = (np.flatnonzero((steps >= 0) & part) for part in does)
        if len(sets_off):
            self.simulator.carry(sets_off, goal[sets_off])
        if len(lets_go):
            self.simulator.let_go(lets_go)

    def _look(self) -> tuple[State, State]:
        """Return the state on the device, and what tasks and hold tests look at, NumPy's."""
        state = self.simulator.state(self._wants_contacts)
        state = replace(state, targets=self.simulator.tensor(self._targets))
        contacts = state.contacts
        if not self.task.by_contacts:  # what nobody looks at stays where it is
            contacts = Contacts(*(part[:, :0] for part in contacts))
        poses = state.link_positions[:, :0], state.link_rotations[:, :0]
        truth = replace(
            state,
            contacts=contacts,
            links=(),
            link_positions=poses[0],
            link_rotations=poses[1],
        )
        return state, truth.map(
            lambda part: host(part.double() if part.is_floating_point() else part)
        )

    # -- a step ------------------------------------------------------------------------------

    def step(self, actions: Any) -> tuple[Obs, Any, Any, Any, dict[str, Any]]:
        """Take a step by actions (n, n_actions); see the class for worlds that are holding."""
        actions, held = self._checked(actions), np.flatnonzero(self._holding)
        were_holding, playing = self._holding.copy(), ~self._holding & ~self._over
        fresh = self._over & (self._autoreset == AutoresetMode.NEXT_STEP)
        trial = self._advance(actions, playing, held)
        self._begin(fresh, self._draws is HostDraws)
        state, truth = self._look()
        overflowed = self.simulator.overflowed & (playing | were_holding)
        broken = (self.simulator.diverged & (playing | were_holding)) | overflowed
        moved = np.linalg.norm(truth.object_position - self._position, axis=1)
        broken |= playing & ~(moved / self.config.control_dt < EJECTED)
        broken |= self._observe(state, truth, (playing & ~broken) | fresh, fresh)
        self._position[playing] = truth.object_position[playing]
        stepped, is_last = playing & ~broken, self._steps >= self.max_episode_steps
        after_step = partial(self.task.after_step, truth, is_last)
        achieved, ended = _in_some(playing, [self.task], after_step)
        self._achieved[stepped] = achieved[stepped]
        ended = stepped & ended
        due = stepped & ~ended & self.task.is_hold_due(truth)
        over = self._judge(held, trial, truth, broken)
        self._hold(due, truth)
        self._holding = due | (were_holding & ~over & ~broken)
        returned = (stepped & ~due) | over
        terminated = ended | over
        truncated = (returned & is_last & ~terminated) | broken
        self._show(returned | fresh)
        self._over = (self._over & ~fresh) | terminated | truncated
        self.n_overflowed += int(overflowed.sum())
        self.n_diverged += int((broken & ~overflowed).sum())
        goals = self._shown, self._desired
        reward = np.where(returned, self.task.compute_reward(*goals), 0.0)
        success = returned & self.task.is_success(*goals)
        info = self._info(is_success=success, diverged=broken, overflowed=overflowed)
        obs = self._obs_dict()
        if self._autoreset == AutoresetMode.SAME_STEP and self._over.any():
            info |= {"final_obs": self._out(obs), "_final_obs": self._over.copy()}
            again = self._over.copy()
            self._begin(again, self._draws is HostDraws)
            self._observe(*self._look(), again, again)
            obs = self._obs_dict()
        results = map(self._out, (reward.astype(np.float32), terminated, truncated))
        return (self._out(obs), *results, info)  # type: ignore[return-value]

    def _checked(self, actions: Any) -> Array:
        values, shape = np.asarray(host(actions), np.float64), self.action_space.shape
        if values.shape != shape:
            raise ValueError(f"actions: found shape {values.shape}, allowed {shape}")
        if not np.isfinite(values).all():
            raise ValueError("actions: found NaN or infinity, allowed finite numbers")
        return np.clip(values, -1.0, 1.0)

    def _advance(self, actions: Array, playing: Array, held: Array) -> Trial:
        """Run the physics of a step, and of a hold test's next look; return the tests."""
        self._steps[playing] += 1
        self._targets[playing] = self.hand.action_map(actions, self._targets)[playing]
        self._give(np.where(playing, self._steps, -1))
        n_substeps, targets = (
            np.where(playing, self.config.n_substeps, 0),
            self._targets.copy(),
        )
        trial, creep = (
            Trial(*(part[held] for part in self._trial)),
            np.ones(self.num_envs),
        )
        creep[held] = self.task.hold.creep_in(trial)
        self.simulator.set_creep(creep)
        trial, n_substeps[held] = self.task.hold.rise(trial, self.config.timestep)
        targets[held, 2] = trial.slide
        self.simulator.step(targets, n_substeps)
        self.simulator.check()
        return trial

    def _judge(self, held: Array, trial: Trial, truth: State, broken: Array) -> Array:
        """Look at the objects of worlds that hold; return whose tests are over, bool (n,)."""
        trial, is_over, is_held = self.task.hold.judge(
            trial, truth.map(itemgetter(held))
        )
        over = np.zeros(self.num_envs, bool)
        over[held] = is_over & ~broken[held]
        self._remember(held, trial)
        ends = np.where(is_held[:, None], self._held[held], self._lost[held])
        self._achieved[over] = ends[over[held]]
        return over

    def _remember(self, worlds: Array, trial: Trial) -> None:
        for whole, part in zip(self._trial, trial, strict=True):
            whole[worlds] = part

    def _hold(self, due: Array, truth: State) -> None:
        """Begin hold tests in worlds."""
        if due.any():
            self._held[due], self._lost[due] = (
                self.task.after_hold(truth, np.full(len(due), is_held))[due]
                for is_held in (True, False)
            )
            self._remember(
                due,
                self.task.hold.begin(truth.map(itemgetter(due)), self.config.timestep),
            )

    def _observe(self, state: State, truth: State, which: Array, first: Array) -> Array:
        """Compute the observations of some worlds, the first of their episodes or not.

        Return bool (n,): whose are broken.
        """
        shared, chosen = self._observer, torch.as_tensor(which, device=self.device)
        senses = [*shared.senses, shared.past]
        taxel_rng: Any = None
        if first.any():
            draws = self._draws(self._keys, first, self.simulator.tensor)
            sight, joints, taxel_rng = draws.spawn(3)
            _in_some(first, senses, partial(shared.reset_senses, sight, joints))
            goals = _in_some(
                first,
                [self.task],
                partial(self.task.reset, truth, self._task_rng.over(first)),
            )
            for mine, goal in zip((self._achieved, self._desired), goals, strict=True):
                mine[first] = np.broadcast_to(goal, mine.shape)[first]
            self._position[first] = truth.object_position[first]
            self._give(np.where(first, 0, -1))
        entries = _in_some(which, senses, partial(shared.sense, state))
        pending = torch.zeros_like(self._obs)
        pending[:, : entries.shape[1]] = entries
        for member in self._members:
            told = member.feel(state, which, first, taxel_rng, self._felt)
            pending[
                member.index, entries.shape[1] : entries.shape[1] + told.shape[1]
            ] = told.float()
        self._pending = torch.where(chosen[:, None], pending, self._pending)
        largest = host(self._pending.abs().amax(1))
        self._show(first)
        return which & ~(largest < LIMIT)

    def _show(self, which: Array) -> None:
        chosen = torch.as_tensor(which, device=self.device)
        self._obs = torch.where(chosen[:, None], self._pending, self._obs)
        self._shown[which] = self._achieved[which]

    # -- what comes out ----------------------------------------------------------------------

    def _obs_dict(self) -> Obs:
        goals = {
            "achieved_goal": self._shown.copy(),
            "desired_goal": self._desired.copy(),
        }
        return {"observation": self._obs, **goals}

    def _out(self, value: Any) -> Any:
        if isinstance(value, dict):
            return {key: self._out(part) for key, part in value.items()}
        return (
            host(value) if self._numpy else torch.as_tensor(value, device=self.device)
        )

    def _info(self, **values: Any) -> dict[str, Any]:
        no = dict.fromkeys(
            ("is_success", "diverged", "overflowed"), np.zeros(self.num_envs, bool)
        )
        return {**no, "holding": self._holding.copy(), **values}

    def compute_reward(
        self, achieved_goal: Array, desired_goal: Array, info: Any
    ) -> Array:
        """Return the rewards (...) of goals (..., goal_size), by them alone."""
        return self.task.compute_reward(achieved_goal, desired_goal)

    def taxel_readings(self) -> Tensor:
        """Return what the taxels felt last, (n, most taxels), before any fault; zeros behind."""
        return self._felt

    def close_extras(self, **kwargs: Any) -> None:
        """Release what the simulator holds."""
        self.simulator.close()


class _Member(NamedTuple):
    """Hold the worlds of one layout and kind of touch."""

    worlds: Array
    index: Tensor
    """The worlds' indices (k,), NumPy's and on the device."""
    n_taxels: int
    rule: Any
    """Touch rule; None where nothing is felt."""
    observer: Observer

    def feel(
        self, state: State, which: Array, first: Array, rng: Any, felt: Tensor
    ) -> Tensor:
        """Return what policies are told of the taxels; put what these felt into `felt` (n, most taxels)."""
        things = [*self.observer.stages, *([self.rule] if self.rule else [])]
        which, first = which[self.worlds], first[self.worlds]
        if first.any():
            _in_some(first, things, partial(self._reset, rng.at(self.worlds)))
        return _in_some(which, things, partial(self._read, state, felt))

    def _reset(self, rng: Any) -> None:
        self.observer.reset_taxels(rng)
        if self.rule:
            self.rule.reset()

    def _read(self, state: State, felt: Tensor) -> Tensor:
        if self.rule:
            readings = self.rule.read(state.map(itemgetter(self.index)))
            felt[self.index, : self.n_taxels] = readings.to(felt.dtype)
        told: Any = self.observer.feel(felt[self.index, : self.n_taxels])  # type: ignore[arg-type]
        return told  # type: ignore[no-any-return]


def _together(
    parts: Sequence[Any], sizes: Sequence[int], tensor: Callable[[Any], Tensor]
) -> Any:
    """Return the same part of groups of worlds as one, its arrays on the device.

    Arrays that differ between the groups get a row for each world.
    """
    first = parts[0]
    if isinstance(first, np.ndarray):
        is_alike = all(np.array_equal(part, first) for part in parts)
        return tensor(first if is_alike else np.repeat(parts, sizes, axis=0))
    if isinstance(first, list):
        return [_together(same, sizes, tensor) for same in zip(*parts, strict=True)]
    if not hasattr(first, "__dict__") or is_dataclass(first):
        return first
    whole = copy(first)
    for name in vars(first):
        setattr(
            whole, name, _together([vars(part)[name] for part in parts], sizes, tensor)
        )
    return whole


def _in_some(which: Array, things: Iterable[Any], act: Callable[[], T]) -> T:
    """Return what `act` does to things that remember it in some worlds only, those of `which` (n,).

    What a thing remembers are those of its attributes that are numbers, arrays or draws.
    """
    before = [(thing, dict(vars(thing))) for thing in things]
    for _, values in before:
        for value in values.values():
            if isinstance(value, HostDraws):
                value.which = which
    result = act()
    for thing, values in before:
        for name, value in vars(thing).items():
            setattr(thing, name, _where(which, value, values.get(name, value)))
    return result


def _where(which: Array, new: Any, old: Any) -> Any:
    """Return the new value of some worlds, and the old of the others."""
    if new is old:
        return new
    if isinstance(new, HostDraws):
        new.keys = np.where(which, new.keys, old.keys)
        new.counts = np.where(which, new.counts, old.counts)
    if not isinstance(new, bool | int | float | np.generic | Array | Tensor):
        return new
    mask: Any = which.reshape(-1, *[1] * (max(np.ndim(new), np.ndim(old)) - 1))
    for value in (new, old):
        if isinstance(value, Tensor):
            return torch.where(torch.as_tensor(mask, device=value.device), new, old)
    return np.where(mask, new, old)


# -- draws -----------------------------------------------------------------------------------


class OneForAll:
    """A generator that draws for many episodes at once; zeros where `which` (n,) is False."""

    def __init__(self, rng: np.random.Generator, which: Array) -> None:
        """Take the generator."""
        self._rng, self.which = rng, which

    def over(self, which: Array) -> OneForAll:
        """Return what draws for those of all worlds."""
        return OneForAll(self._rng, which)

    def spawn(self, n: int) -> list[OneForAll]:
        """Return itself: all come from one generator."""
        return [self] * n

    def __getattr__(self, name: str) -> Any:
        """Return a method of generators with a leading axis; `size`, without it, is a keyword."""
        return partial(self._draw, name)

    def _draw(self, name: str, *bounds: Any, size: Any = (), **options: Any) -> Array:
        rows = (int(self.which.sum()), *np.empty(size).shape)
        drawn = getattr(self._rng, name)(*bounds, size=rows, **options)
        whole = np.zeros((len(self.which), *rows[1:]), drawn.dtype)
        whole[self.which] = drawn
        return whole


class HostDraws:
    """Generators (n,) as one: each draws a row, the numbers of `GraspEnv`; zeros where `which` is False."""

    def __init__(
        self,
        keys: Array,
        which: Array | None = None,
        convert: Callable[[Any], Any] = np.asarray,
    ) -> None:
        """Take the generators, and what makes of arrays what is wanted."""
        self.keys, self._convert = keys, convert
        self.which = np.ones(len(keys), bool) if which is None else which
        self.counts = np.zeros(len(keys), np.int64)

    def at(self, worlds: Array) -> HostDraws:
        """Return what draws for some of these worlds."""
        return type(self)(self.keys[worlds], self.which[worlds], self._convert)

    def over(self, which: Array) -> HostDraws:
        """Return what draws for those of all worlds."""
        keys = np.full(len(which), None)
        keys[which] = self.keys
        return HostDraws(keys, which)

    def spawn(self, n: int) -> list[HostDraws]:
        """Return draws that are independent of these and of each other."""
        children = np.full((n, len(self.keys)), None)
        for i in np.flatnonzero(self.which):
            children[:, i] = self.keys[i].spawn(n)
        return [HostDraws(keys, self.which, self._convert) for keys in children]

    def __getattr__(self, name: str) -> Any:
        """Return a method of generators with a leading axis; `size`, without it, is a keyword."""
        return partial(self._draw, name)

    def _draw(self, name: str, *bounds: Any, size: Any = (), **options: Any) -> Any:
        whole = np.zeros((len(self.keys), *np.empty(size).shape))
        for i in np.flatnonzero(self.which):
            whole[i] = getattr(self.keys[i], name)(*bounds, size=size, **options)
        return self._convert(whole)


class DeviceDraws(HostDraws):
    """Numbers from a counter and an episode's key, hashed where they are needed (SplitMix64)."""

    def spawn(self, n: int) -> list[HostDraws]:
        """Return draws with other keys."""
        keys = torch.as_tensor(self.keys)
        others = (host(_mixed(keys + number)) for number in range(1, n + 1))
        return [DeviceDraws(other, self.which, self._convert) for other in others]

    def random(self, size: Any) -> Tensor:
        """Return even numbers from 0 to 1, (n, size)."""
        self.counts = self.counts + self.which
        like, (width,) = self._convert(0.0), np.empty(size).shape
        starts = torch.as_tensor(self.keys + (self.counts << 20), device=like.device)
        steps = torch.arange(width, device=like.device) * -7046029254386353131
        bits = _mixed(starts[:, None] + steps)
        return (((bits >> 11) & 0x1FFFFFFFFFFFFF).double() * 2.0**-53).to(like.dtype)

    def standard_normal(self, size: int) -> Tensor:
        """Return numbers of the standard normal distribution, (n, size), by Box and Muller."""
        even = self.random(2 * size)
        radius = (-2 * torch.log1p(-even[:, :size])).sqrt()
        return radius * torch.cos(2 * torch.pi * even[:, size:])


_DRAWS = {"host": HostDraws, "device": DeviceDraws}


def _mixed(x: Tensor) -> Tensor:
    """Return int64 whose bits depend on all bits of x (SplitMix64's last steps)."""
    for shift, factor in ((30, -4658895280553007687), (27, -7723592293110705685)):
        x = (x ^ ((x >> shift) & ((1 << (64 - shift)) - 1))) * factor
    return x ^ ((x >> 31) & ((1 << 33) - 1))
