"""BatchEnv: what `GraspEnv` plays, in many worlds at once; a Gymnasium VectorEnv.

Its parts are `GraspEnv`'s own, whose arrays have a leading axis here: touch and senses
PyTorch's, on the device, tasks, hold tests and what an episode draws NumPy's. Taxels
move nothing: worlds with other layouts, other faults or no touch at all share one batch
of physics.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import is_dataclass, replace
from functools import cache, partial
from importlib.util import find_spec
from operator import itemgetter
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from torch import Tensor

from . import tasks, touch
from .grasp import EJECTED, LIMIT, GraspConfig, GraspEnv, checked
from .hold import Trial
from .objects import KINDS, host, like, namespace
from .observations import OF_HAND, TAXELS, Observer
from .simulators.batch import BatchSimulator
from .state import Array, State
from .validation import require_one_of

Obs = dict[str, Any]
BY_GROUP = frozenset(("layout", "touch", "hand_seed", "sensor", *TAXELS))
"""Fields in which the groups of a batch may differ."""


def shared(config: GraspConfig) -> tuple[Any, ...]:
    """Return what the scenes of a batch have in common; ValueError for one that can be in none."""
    # In the class itself: one of somebody else's may override what its base does.
    rules, kinds = (
        [name for name, kind in known.items() if vars(kind).get("is_batched")]
        for known in (touch.RULES, tasks.TASKS)
    )
    for name, allowed in (
        ("simulator", ["mujoco"]),
        ("touch_rule", rules),
        ("task", kinds),
        ("object", KINDS),
    ):
        require_one_of(allowed, getattr(config, name), f"{name} of a batch")
    return tuple(v for k, v in vars(config).items() if k not in BY_GROUP)


class BatchEnv(gym.vector.VectorEnv[Any, Any, Any]):
    """Many worlds of one scene, in groups that may differ in layout, touch and the taxels' faults.

    Worlds of a group are consecutive. Observations are a dict of float32 tensors
    (n, ...) on the device: ``observation``, each group's own at the front and zeros behind,
    ``achieved_goal`` and ``desired_goal``. Rewards are float32, ends bool, (n,):
    tensors as well. In ``info``, each bool (n,) and NumPy's: ``is_success``;
    ``diverged``, as in `GraspEnv`, or because a world had no room for its contacts; and
    ``holding``.

    A step that ends in a hold test is not over before the test is, which takes several
    calls of `step`: until then the world is ``holding``, shows its last observation,
    has reward 0 and ignores actions. The call that says ``holding`` no more ends the
    step: it returns observation, reward and end as `GraspEnv` returns them at once. So
    a learner keeps the observation and the action with which it began a step until that
    step comes back without ``holding``.

    A world that has ended begins anew with the next step; without `autoreset` it stands
    still until it is reset.
    """

    def __init__(
        self,
        hand: str,
        groups: Sequence[tuple[GraspConfig, int]],
        device: str = "cuda",
        autoreset: bool = True,
    ) -> None:
        """Make groups of worlds: the scene of each, and how many.

        `device` is PyTorch's for MuJoCo Warp, or "loop": MuJoCo in a loop, on the CPU.

        Raise ValueError for scenes that do not go together.
        """
        configs, sizes = zip(*groups, strict=True)
        if len({*map(shared, configs)}) > 1:
            allowed = ", ".join(sorted(BY_GROUP))
            raise ValueError(f"groups: found scenes that differ, allowed in: {allowed}")
        self.num_envs = n = sum(sizes)
        make, named = cache(GraspEnv), dict[bytes, str]()
        # Groups that differ in nothing share one.
        self.singles = [make(hand, _alike(config, named)) for config in configs]
        """The environment of each group, which plays a world of it alone."""
        single = self.singles[0]
        self.config, self.hand, self.task = single.config, single.hand, single.task
        self.max_episode_steps = single.max_episode_steps
        require(device)
        scene = single.simulator.scene
        if device == "loop":
            self.simulator = BatchSimulator(scene, n)
        else:
            from .simulators.warp import WarpSimulator

            self.simulator = WarpSimulator(scene, n, device)
        self.device, tensor = self.simulator.device, self.simulator.tensor
        of_world: Any = np.repeat(np.array(self.singles, object), sizes)
        self._observers = [
            (np.flatnonzero(of_world == env), _converted(env._observer, tensor))
            for env in dict.fromkeys(self.singles)
        ]
        """Worlds (k,) of one layout, kind of touch and hand, and what observes for
        them."""
        self._autoreset = autoreset
        mode = AutoresetMode.NEXT_STEP if autoreset else AutoresetMode.DISABLED
        self.metadata = {"autoreset_mode": mode}
        self.single_action_space = single.action_space
        self.action_space = batch_space(single.action_space, n)
        spaces: Any = (one.observation_space for one in self.singles)
        widest = max(spaces, key=lambda space: space["observation"].shape)
        self.single_observation_space = widest
        self.observation_space = batch_space(widest, n)
        self._rngs = np.array([np.random.default_rng() for _ in range(n)])
        self._targets = np.tile(single.hand.start_targets(), (n, 1))
        self._steps, self._position = np.zeros(n, int), np.zeros((n, 3))
        self._holding, self._over = np.zeros(n, bool), np.ones(n, bool)
        self._trial = Trial(self.task.hold, self.config.timestep)
        goals = np.zeros((2, n, self.task.goal_size), np.float32)
        self._achieved, self._desired = goals
        shape = n, *widest["observation"].shape
        self._obs = torch.zeros(shape, device=self.device)
        self.n_diverged = 0
        """Episodes that ended so, since the batch was made."""

    # -- episodes ----------------------------------------------------------------------------

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Obs, dict[str, Any]]:
        """Begin an episode in all worlds, or those of ``options["reset_mask"]``, bool (n,).

        A seed is a number, to which each world adds its index, or one for each of the n
        worlds. It then plays the episode that `GraspEnv` plays after
        ``reset(seed=...)``. Without one, its generator goes on.
        """
        n = self.num_envs
        mask = np.asarray((options or {}).get("reset_mask", np.ones(n, bool)), bool)
        seeds: Any = [None] * n if seed is None else seed
        if isinstance(seed, int | np.integer):
            seeds = range(seed, seed + n)
        for i in np.flatnonzero(mask):
            if seeds[i] is not None:
                self._rngs[i] = np.random.default_rng(int(seeds[i]))
        self._begin(mask)
        self._observe(*self._look(), mask, mask)
        return self._results(mask & False, mask & False)

    def _begin(self, mask: Array) -> None:
        """Put worlds at the start of their next episodes."""
        worlds, n = np.flatnonzero(mask), self.num_envs
        if not len(worlds):
            return
        drawn = self.singles[0].draw_start(Draws(self._rngs, mask))
        item, start, self._observer_draws, self._task_draws = drawn
        half_size = np.stack(item.shape.half_size, axis=-1)
        what = half_size, item.mass, item.friction
        self.simulator.change_object(worlds, *(part[worlds] for part in what))
        joints, position, yaw, targets = start
        joints, targets = (
            np.broadcast_to(part, (n, part.shape[-1])) for part in (joints, targets)
        )
        where = joints, position, np.broadcast_to(yaw, n), targets
        self.simulator.reset(worlds, *(part[worlds] for part in where))
        self._targets[mask] = targets[mask]
        self._steps[mask], self._over[mask], self._holding[mask] = 0, False, False

    def _give(self, steps: Array) -> None:
        """Let the task's giver do what is due before actions of these numbers; below 0, nothing."""
        if self.task.giver is None:
            return
        goal, *does = _in_some(steps >= 0, self.task.giving, steps)
        sets_off, lets_go = (np.flatnonzero((steps >= 0) & part) for part in does)
        self.simulator.carry(sets_off, goal[sets_off])
        self.simulator.let_go(lets_go)

    def _look(self) -> tuple[State, State]:
        """Return the state on the device, and what tasks and hold tests look at, NumPy's."""
        targets: Any = self.simulator.tensor(self._targets)
        state = replace(self.simulator.state(), targets=targets)
        return state, state.map(host)

    # -- a step ------------------------------------------------------------------------------

    def step(self, actions: Any) -> tuple[Obs, Any, Any, Any, dict[str, Any]]:
        """Take a step by actions (n, n_actions); see the class for worlds that are holding."""
        actions = checked(host(actions), self.action_space)
        were_holding = self._holding.copy()
        playing = ~were_holding & ~self._over
        fresh = self._over & self._autoreset
        self._advance(actions, playing)
        self._begin(fresh)
        state, truth = self._look()
        broken = self.simulator.diverged & (playing | were_holding)
        moved = np.linalg.norm(truth.object_position - self._position, axis=1)
        broken |= playing & ~(moved / self.config.control_dt < EJECTED)
        broken |= self._observe(state, truth, (playing & ~broken) | fresh, fresh)
        stepped, is_last = playing & ~broken, self._steps >= self.max_episode_steps
        after_step = self.task.after_step
        achieved, ended = _in_some(playing, after_step, truth, is_last)
        self._achieved[stepped] = achieved[stepped]
        due = stepped & np.logical_not(ended) & self.task.is_hold_due(truth)
        over, held = _in_some(were_holding, self._trial.judge, truth)
        over &= were_holding & ~broken
        self._achieved[over] = self.task.after_hold(self._achieved, held)[over]
        _in_some(due, self._trial.begin, truth)
        self._holding = due | (were_holding & ~over & ~broken)
        returned, terminated = (stepped & ~due) | over, (stepped & ended) | over
        truncated = (returned & is_last & ~terminated) | broken
        self._over = (self._over & ~fresh) | terminated | truncated
        self.n_diverged += int(broken.sum())
        goals = self._achieved, self._desired
        reward = np.where(returned, self.task.compute_reward(*goals), 0.0)
        success = returned & self.task.is_success(*goals)
        results = reward.astype(np.float32), terminated, truncated
        obs, info = self._results(success, broken)
        return obs, *map(self._copy, results), info

    def _advance(self, actions: Array, playing: Array) -> None:
        """Run the physics of a step, and of a hold test until its next look."""
        self._steps += playing
        self._targets[playing] = self.hand.action_map(actions, self._targets)[playing]
        self._give(np.where(playing, self._steps, -1))
        holding, trial, targets = self._holding, self._trial, self._targets.copy()
        self.simulator.set_creep(np.where(holding, trial.creep, 1.0))
        n_rising = _in_some(holding, trial.rise)
        targets[:, 2] = np.where(holding, trial.slide, targets[:, 2])
        n_substeps = np.where(holding, n_rising, playing * self.config.n_substeps)
        self.simulator.step(targets, n_substeps.astype(int))

    def _observe(self, state: State, truth: State, which: Array, first: Array) -> Array:
        """Compute the observations of some worlds, the first of their episodes or not.

        Return bool (n,): whose are broken.
        """
        obs = self._obs.clone()
        if first.any():
            reset, draws_of_task = self.task.reset, self._task_draws
            achieved, desired = _in_some(first, reset, truth, draws_of_task)
            self._achieved[first] = achieved[first]
            self._desired[first] = np.broadcast_to(desired, achieved.shape)[first]
            self._give(np.where(first, 0, -1))
        for worlds, observer in self._observers:
            if not which[worlds].any():  # it may never have begun an episode
                continue
            seen, begins = state.map(itemgetter(worlds)), first[worlds]
            if begins.any():
                rngs = self._observer_draws.rngs[worlds]
                draws = Draws(rngs, begins, self.simulator.tensor)
                _in_some(begins, observer.reset, draws)
            told = _in_some(which[worlds], observer.observe, seen)
            obs[worlds, : told.shape[1]] = told.float()
        self._position = truth.object_position.copy()
        is_sound = host(obs.abs().amax(1)) < LIMIT
        self._obs = _where(which & is_sound, obs, self._obs)
        return which & ~is_sound

    # -- what comes out ----------------------------------------------------------------------

    def _results(self, success: Array, diverged: Array) -> tuple[Obs, dict[str, Any]]:
        """Return observations and info."""
        obs = {
            "observation": self._obs,
            "achieved_goal": self._copy(self._achieved),
            "desired_goal": self._copy(self._desired),
        }
        holding = self._holding.copy()
        return obs, {"is_success": success, "diverged": diverged, "holding": holding}

    def _copy(self, values: Array) -> Any:
        return torch.tensor(values, device=self.device)


def require(device: str) -> None:
    """Raise ValueError where there is no such device, ImportError without MuJoCo Warp."""
    if device != "loop" and find_spec("mujoco_warp") is None:  # which needs warp itself
        raise ImportError(
            "found no MuJoCo Warp, which a GPU needs: pip install 'tactilerl[gpu]'"
        )
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(
            f"device: found no GPU that PyTorch {torch.__version__} can use here; it takes an NVIDIA "
            "GPU, its driver, and PyTorch for CUDA (https://pytorch.org/get-started)"
        )


def _alike(config: GraspConfig, named: dict[bytes, str]) -> GraspConfig:
    """Write a scene as all others are written that mean the same.

    That is without the seed of its hand where hands do not differ. Of files of taxels
    with the same content, as each run has one, it has the name of the first, kept in
    `named`.
    """
    if not any(getattr(config, name) for name in OF_HAND):
        config = replace(config, hand_seed=None)
    if os.path.isfile(config.layout):
        content = Path(config.layout).read_bytes()
        config = replace(config, layout=named.setdefault(content, config.layout))
    return config


def _converted(part: Any, tensor: Callable[[Any], Tensor]) -> Any:
    """Return a part of `GraspEnv` whose arrays are tensors."""
    if isinstance(part, np.ndarray):
        return tensor(part)
    if isinstance(part, list):
        return [_converted(each, tensor) for each in part]
    if not hasattr(part, "__dict__") or is_dataclass(part):
        return part
    whole = copy(part)
    for name, value in vars(part).items():
        setattr(whole, name, _converted(value, tensor))
    return whole


def _in_some(which: Array, act: Any, *arguments: Any) -> Any:
    """Return what a method does; it is remembered in some worlds only, those of `which` (n,).

    What the method's object remembers, or an observer's parts, are attributes that are
    numbers, arrays or draws.
    """
    owner = act.__self__
    things = owner.parts if isinstance(owner, Observer) else [owner]
    before = [(thing, dict(vars(thing))) for thing in things]
    for _, values in before:
        for value in values.values():
            if isinstance(value, Draws):
                value.which, value.n_ahead = which, AHEAD
    result = act(*arguments)
    for thing, values in before:
        for name, value in vars(thing).items():
            setattr(thing, name, _where(which, value, values.get(name, value)))
    return result


_REMEMBERED: Any = (bool, int, float, np.generic, np.ndarray, Tensor)


def _where(which: Array, new: Any, old: Any) -> Any:
    """Return the new value of some worlds, and the old of the others."""
    if isinstance(new, Draws) and new is not old:
        old.rngs[which], old.left[which] = new.rngs[which], 0
        return old
    if new is old or not isinstance(new, _REMEMBERED):
        return new
    mask = which.reshape(-1, *[1] * (max(np.ndim(new), np.ndim(old)) - 1))
    kind = old if isinstance(old, Tensor) else new
    return namespace(kind).where(like(mask, kind) != 0, new, old)


AHEAD = 32
"""Control steps whose noise is drawn at once: the call of a generator costs more than
the numbers."""


class Draws:
    """NumPy's generators (n,), one for each of many episodes: what they draw has a leading axis.

    Each draws the numbers of `GraspEnv`; those off `which`, bool (n,), draw none: what
    they have means nothing. What is asked for again and again, without bounds, may be
    drawn `n_ahead` times at once.
    """

    n_ahead = 1
    """`AHEAD` as soon as a part remembers them."""

    def __init__(
        self, rngs: Array, which: Array, convert: Callable[[Any], Any] = np.asarray
    ) -> None:
        """Take the generators, and what makes of arrays what is wanted."""
        self.rngs, self.which, self._convert = rngs, which, convert
        self.left, self._rows = np.zeros(len(rngs), int), np.zeros(0)
        """How many of the rows (n, n_rows, ...), drawn ahead, are still to be handed
        out."""
        self._asked: Any = None

    def spawn(self, n: int) -> list[Draws]:
        """Return draws that are independent of these and of each other."""
        children = np.full((n, len(self.rngs)), None)
        for i in np.flatnonzero(self.which):
            children[:, i] = self.rngs[i].spawn(n)
        return [Draws(child, self.which, self._convert) for child in children]

    def __getattr__(self, name: str) -> Any:
        """Return a method of generators; `size`, without the leading axis, is a keyword."""
        return partial(self._draw, name)

    def _draw(self, name: str, *bounds: Any, size: Any = (), **options: Any) -> Any:
        asked = name, *np.empty(size).shape
        is_again = asked == self._asked and not (bounds or options)
        n_rows = self.n_ahead if is_again else 1
        shape = len(self.left), n_rows, *asked[1:]
        if shape != self._rows.shape:
            assert not self.left.any(), "numbers drawn ahead need their own generator"
            self._rows = np.zeros(shape)
        self._asked = asked
        for i in np.flatnonzero(self.which & (self.left == 0)):
            draw = getattr(self.rngs[i], name)
            self._rows[i] = draw(*bounds, size=shape[1:], **options)
            self.left[i] = n_rows
        self.left -= self.which
        return self._convert(self._rows[np.arange(len(self.left)), -1 - self.left])
