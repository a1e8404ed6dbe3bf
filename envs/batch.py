"""BatchEnv: what `GraspEnv` plays, in many worlds at once; a Gymnasium VectorEnv.

Its parts are `GraspEnv`'s own, whose arrays have a leading axis here: touch and senses PyTorch's, on
the device, tasks, hold tests and what an episode draws NumPy's. Taxels move nothing: worlds with
other layouts, other faults or no touch at all share one batch of physics.
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
from .grasp import EJECTED, LIMIT, GraspConfig, GraspEnv, checked
from .hold import Trial
from .objects import host
from .observations import Observer
from .simulators import batch as simulators
from .state import Array, State

T = TypeVar("T")
Obs = dict[str, Any]
BY_GROUP = frozenset(
    (
        "layout",
        "touch",
        "hand_seed",
        "sensor",
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
        # In the class itself: one of somebody else's may override what its base does.
        allowed = [key for key, kind in known.items() if vars(kind).get("is_batched")]
        if getattr(first, name) not in allowed:
            found = f"found {getattr(first, name)!r} in a batch"
            raise ValueError(f"{name}: {found}, allowed: {', '.join(allowed)}")
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
        (usual with "loop"), or "device" (else), a generator of PyTorch's for all worlds. `simulator`
        are options of the simulator.

        Raise ValueError for scenes that do not go together.
        """
        configs = [config for config, _ in groups]
        require_batched(configs)
        self.group_sizes = sizes = tuple(size for _, size in groups)
        """Number of worlds in each group."""
        self.num_envs = n = sum(sizes)
        # Observers draw what differs between hands, but for thresholds, which are the rule's.
        kinds = [
            config if config.taxel_threshold_spread else replace(config, hand_seed=None)
            for config in configs
        ]
        made = {kind: GraspEnv(hand, kind) for kind in dict.fromkeys(kinds)}
        envs = [made[kind] for kind in kinds]
        self._single = single = envs[0]
        self.config, self.hand, self.task = single.config, single.hand, single.task
        self.max_episode_steps = single.max_episode_steps
        self.widths = tuple(len(env.observation_names()) for env in envs)
        """Length of each group's own ``observation``."""
        self.simulator = simulators.make(single.simulator.scene, n, device, **simulator)
        self.device, tensor = self.simulator.device, self.simulator.tensor
        self._is_host = (draws or ("host" if device == "loop" else "device")) == "host"
        self._noise = DeviceDraws(torch.Generator(self.device), n, self.simulator.dtype)
        self._observer = _together([single._observer], [n], tensor)
        self._members = []
        for env in made.values():
            own = [number for number, other in enumerate(envs) if other is env]
            worlds = np.flatnonzero(
                np.isin(np.repeat(np.arange(len(groups)), sizes), own)
            )
            observers = [env.observer(configs[number]) for number in own]
            observer = _together(observers, [sizes[number] for number in own], tensor)
            rule = (
                _together([env._touch], [n], tensor)
                if env.config.touch == "on"
                else None
            )
            n_taxels = len(env.taxels) if env.config.touch != "absent" else 0
            self._members.append(_Member(worlds, n_taxels, rule, observer))
        self._wants_contacts = self.task.by_contacts or any(
            member.rule and member.rule.by_contacts for member in self._members
        )
        self.metadata = {"autoreset_mode": autoreset}
        self._autoreset, self._numpy = autoreset, numpy
        self.single_action_space = single.action_space
        self.action_space = batch_space(single.action_space, n)
        self.group_observation_spaces = tuple(env.observation_space for env in envs)
        widest: Any = self.group_observation_spaces[int(np.argmax(self.widths))]
        self.single_observation_space, self.observation_space = (
            widest,
            batch_space(widest, n),
        )
        self._rng, self._rngs = np.random.default_rng(), np.full(n, None)
        self._targets = np.tile(single.hand.start_targets(), (n, 1))
        self._steps, self._position = np.zeros(n, int), np.zeros((n, 3))
        self._holding, self._over = np.zeros(n, bool), np.ones(n, bool)
        self._trial = Trial(self.task.hold, self.config.timestep)
        goals = np.zeros((3, n, self.task.goal_size), np.float32)
        self._achieved, self._desired, self._shown = goals
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
            self._noise.rng.manual_seed(int(self._rng.integers(2**63)))
        is_own = bool(given) or self._is_host
        for i in worlds if is_own else ():
            if i in given or self._rngs[i] is None:
                self._rngs[i], _ = gym.utils.seeding.np_random(given.get(i))
        self._begin(mask, is_own)
        self._observe(*self._look(), mask, mask)
        return self._results(), self._info()

    def _begin(self, mask: Array, is_own: bool) -> None:
        """Put worlds at the start of their next episodes, from their own generators or the batch's."""
        worlds = np.flatnonzero(mask)
        if not (k := len(worlds)):
            return
        rng = HostDraws(self._rngs[worlds] if is_own else self._rng, np.ones(k, bool))
        item, start, self._observer_rng, self._task_rng = self._single.draw_start(rng)
        half_size = np.stack(item.shape.half_size, axis=-1)
        self.simulator.change_object(worlds, half_size, item.mass, item.friction)
        joints, position, yaw, targets = start
        joints, targets = (
            np.broadcast_to(part, (k, part.shape[-1])) for part in (joints, targets)
        )
        self.simulator.reset(worlds, joints, position, np.broadcast_to(yaw, k), targets)
        self._targets[worlds] = targets
        self._steps[mask], self._over[mask], self._holding[mask] = 0, False, False

    def _give(self, steps: Array) -> None:
        """Let the task's giver do what is due before actions of these numbers; below 0, nothing."""
        if self.task.giver is None:
            return
        goal, *does = _in_some(
            steps >= 0, [self.task], partial(self.task.giving, steps)
        )
        sets_off, lets_go = (np.flatnonzero((steps >= 0) & part) for part in does)
        self.simulator.carry(sets_off, goal[sets_off])
        self.simulator.let_go(lets_go)

    def _look(self) -> tuple[State, State]:
        """Return the state on the device, and what tasks and hold tests look at, NumPy's."""
        state = self.simulator.state(self._wants_contacts)
        targets: Any = self.simulator.tensor(self._targets)
        state = replace(state, targets=targets)
        positions, rotations = state.link_positions[:, :0], state.link_rotations[:, :0]
        truth = replace(
            state, links=(), link_positions=positions, link_rotations=rotations
        )
        return state, truth.map(host)

    # -- a step ------------------------------------------------------------------------------

    def step(self, actions: Any) -> tuple[Obs, Any, Any, Any, dict[str, Any]]:
        """Take a step by actions (n, n_actions); see the class for worlds that are holding."""
        actions, were_holding = (
            checked(host(actions), self.action_space),
            self._holding.copy(),
        )
        playing = ~were_holding & ~self._over
        fresh = self._over & (self._autoreset == AutoresetMode.NEXT_STEP)
        self._advance(actions, playing)
        self._begin(fresh, self._is_host)
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
        due = stepped & np.logical_not(ended) & self.task.is_hold_due(truth)
        judge = partial(self._trial.judge, truth)
        over, held = _in_some(were_holding, [self._trial], judge)
        over = over & were_holding & ~broken
        if over.any():
            self._achieved[over] = self.task.after_hold(self._achieved, held)[over]
        if due.any():
            _in_some(due, [self._trial], partial(self._trial.begin, truth))
        self._holding = due | (were_holding & ~over & ~broken)
        returned, terminated = (stepped & ~due) | over, (stepped & ended) | over
        truncated = (returned & is_last & ~terminated) | broken
        self._show(returned)
        self._over = (self._over & ~fresh) | terminated | truncated
        self.n_overflowed += int(overflowed.sum())
        self.n_diverged += int((broken & ~overflowed).sum())
        goals = self._shown, self._desired
        reward = np.where(returned, self.task.compute_reward(*goals), 0.0).astype(
            np.float32
        )
        success = returned & self.task.is_success(*goals)
        info = self._info(is_success=success, diverged=broken, overflowed=overflowed)
        if self._autoreset == AutoresetMode.SAME_STEP and self._over.any():
            again = self._over.copy()
            info |= {"final_obs": self._results(), "_final_obs": again}
            self._begin(again, self._is_host)
            self._observe(*self._look(), again, again)
        return self._results(), *map(self._out, (reward, terminated, truncated)), info

    def _advance(self, actions: Array, playing: Array) -> None:
        """Run the physics of a step, and of a hold test until its next look."""
        self._steps[playing] += 1
        self._targets[playing] = self.hand.action_map(actions, self._targets)[playing]
        self._give(np.where(playing, self._steps, -1))
        n_substeps, targets = (
            np.where(playing, self.config.n_substeps, 0),
            self._targets.copy(),
        )
        holding, trial = self._holding, self._trial
        self.simulator.set_creep(np.where(holding, trial.creep, 1.0))
        n_substeps = np.where(
            holding, _in_some(holding, [trial], trial.rise), n_substeps
        )
        targets[:, 2] = np.where(holding, trial.slide, targets[:, 2])
        self.simulator.step(targets, n_substeps.astype(int))
        self.simulator.check()

    def _observe(self, state: State, truth: State, which: Array, first: Array) -> Array:
        """Compute the observations of some worlds, the first of their episodes or not.

        Return bool (n,): whose are broken.
        """
        shared, taxel_rng = self._observer, None
        senses = [*shared.senses, shared.past]
        if first.any():
            rng: Any = self._noise
            if self._is_host:
                rng = self._observer_rng.over(first, self.simulator.tensor)
            sight, joints, taxel_rng = rng.spawn(3)
            _in_some(first, senses, partial(shared.reset_senses, sight, joints))
            reset = partial(self.task.reset, truth, self._task_rng.over(first))
            for mine, goal in zip(
                (self._achieved, self._desired),
                _in_some(first, [self.task], reset),
                strict=True,
            ):
                mine[first] = np.broadcast_to(goal, mine.shape)[first]
            self._position[first] = truth.object_position[first]
            self._give(np.where(first, 0, -1))
        entries = _in_some(which, senses, partial(shared.sense, state))
        pending, begin = torch.zeros_like(self._obs), entries.shape[1]
        pending[:, :begin] = entries
        for member in self._members:
            told = member.feel(state, which, first, taxel_rng, self._felt)
            pending[member.worlds, begin : begin + told.shape[1]] = told.float()
        self._pending = _where(which, pending, self._pending)
        self._show(first)
        return which & ~(host(self._pending.abs().amax(1)) < LIMIT)

    def _show(self, which: Array) -> None:
        self._obs = _where(which, self._pending, self._obs)
        self._shown[which] = self._achieved[which]

    # -- what comes out ----------------------------------------------------------------------

    def _results(self) -> Obs:
        goals = {
            "achieved_goal": self._shown.copy(),
            "desired_goal": self._desired.copy(),
        }
        obs: dict[str, Any] = {"observation": self._obs, **goals}
        return {key: self._out(value) for key, value in obs.items()}

    def _out(self, value: Any) -> Any:
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
    """Hold the worlds (k,) of one layout and kind of touch."""

    worlds: Array
    n_taxels: int
    rule: Any
    """Touch rule; None where nothing is felt."""
    observer: Observer

    def feel(
        self, state: State, which: Array, first: Array, rng: Any, felt: Tensor
    ) -> Tensor:
        """Return what policies are told of the taxels; put what these felt into `felt` (n, most)."""
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
        worlds = torch.as_tensor(self.worlds, device=felt.device)
        if self.rule:
            readings = self.rule.read(state.map(itemgetter(worlds)))
            felt[worlds, : self.n_taxels] = readings.to(felt.dtype)
        told: Any = self.observer.feel(felt[worlds, : self.n_taxels])  # type: ignore[arg-type]
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


_REMEMBERED: Any = (bool, int, float, np.generic, np.ndarray, Tensor)


def _where(which: Array, new: Any, old: Any) -> Any:
    """Return the new value of some worlds, and the old of the others."""
    if isinstance(new, HostDraws):
        new.rng = np.where(which, new.rng, old.rng)
    if new is old or not isinstance(new, _REMEMBERED):
        return new
    mask: Any = which.reshape(-1, *[1] * (max(np.ndim(new), np.ndim(old)) - 1))
    for value in (new, old):
        if isinstance(value, Tensor):
            return torch.where(torch.as_tensor(mask, device=value.device), new, old)
    return np.where(mask, new, old)


# -- draws -----------------------------------------------------------------------------------


class HostDraws:
    """NumPy's generators for many episodes: what they draw has a leading axis, zeros off `which` (n,).

    Each episode has its own (n,), and draws the numbers of `GraspEnv`, or one draws for all at once.
    """

    def __init__(
        self, rng: Any, which: Array, convert: Callable[[Any], Any] = np.asarray
    ) -> None:
        """Take the generators or generator, and what makes of arrays what is wanted."""
        self.rng, self.which, self._convert = rng, which, convert
        self._is_one = isinstance(rng, np.random.Generator)

    def at(self, worlds: Array) -> HostDraws:
        """Return what draws for these of the episodes."""
        return HostDraws(self.rng[worlds], self.which[worlds], self._convert)

    def over(
        self, which: Array, convert: Callable[[Any], Any] = np.asarray
    ) -> HostDraws:
        """Return what draws for the same episodes as those of `which` (m,) among more."""
        rng = self.rng
        if not self._is_one:
            rng = np.full(len(which), None)
            rng[which] = self.rng
        return HostDraws(rng, which, convert)

    def spawn(self, n: int) -> list[HostDraws]:
        """Return draws that are independent of these and of each other."""
        if self._is_one:
            return [self] * n
        children = np.full((n, len(self.rng)), None)
        for i in np.flatnonzero(self.which):
            children[:, i] = self.rng[i].spawn(n)
        return [HostDraws(child, self.which, self._convert) for child in children]

    def __getattr__(self, name: str) -> Any:
        """Return a method of generators; `size`, without the leading axis, is a keyword."""
        return partial(self._draw, name)

    def _draw(self, name: str, *bounds: Any, size: Any = (), **options: Any) -> Any:
        shape = np.empty(size).shape
        whole = np.zeros((len(self.which), *shape))
        if self._is_one:
            size = (int(self.which.sum()), *shape)
            whole[self.which] = getattr(self.rng, name)(*bounds, size=size, **options)
        else:
            for i in np.flatnonzero(self.which):
                whole[i] = getattr(self.rng[i], name)(*bounds, size=size, **options)
        return self._convert(whole)


class DeviceDraws(NamedTuple):
    """PyTorch's generator for what stages draw in many worlds, with a leading axis."""

    rng: torch.Generator
    n: int
    dtype: torch.dtype

    def at(self, worlds: Array) -> DeviceDraws:
        """Return what draws for these of the worlds."""
        return self._replace(n=len(worlds))

    def spawn(self, n: int) -> list[DeviceDraws]:
        """Return the same, several times."""
        return [self] * n

    def random(self, size: int) -> Tensor:
        """Return even numbers from 0 to 1, (n, size)."""
        shape = (self.n, size)
        return torch.rand(
            shape, generator=self.rng, device=self.rng.device, dtype=self.dtype
        )

    def standard_normal(self, size: int) -> Tensor:
        """Return numbers of the standard normal distribution, (n, size)."""
        shape = (self.n, size)
        return torch.randn(
            shape, generator=self.rng, device=self.rng.device, dtype=self.dtype
        )
