"""BatchEnv: what `GraspEnv` plays, in many worlds at once; a Gymnasium VectorEnv.

Physics, touch and observations are PyTorch's, on the device; tasks, hold tests and what an episode
draws are NumPy's, with a leading axis, from `GraspEnv`'s own parts where these have one. Taxels move
nothing: worlds with other layouts, other faults or no touch at all share one batch of physics.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from torch import Tensor

from . import hold, observations, tasks, touch
from .grasp import EJECTED, JITTER_JOINT, LIMIT, GraspConfig, GraspEnv
from .hands import ARM, FINGERS
from .objects import bounds
from .observations import SIGHT_NOISE, TERMS
from .simulators import batch as simulators
from .simulators.batch import BatchSimulator, BatchState
from .state import Array, Kind, Shape, places
from .tasks import OUTCOMES

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
    for name, found, allowed in (
        ("simulator", first.simulator, ("mujoco",)),
        ("touch_rule", first.touch_rule, ("skin", "force")),
        ("task", first.task, tuple(_TASKS)),
    ):
        if found not in allowed:
            raise ValueError(
                f"{name}: found {found!r} in a batch, allowed: {', '.join(allowed)}"
            )
    if tasks.TASKS[first.task] is not _OWN[first.task] or touch.RULES[
        first.touch_rule
    ] not in (touch.SkinTouch, touch.ForceRule):
        raise ValueError(
            "task and touch_rule: found another's in a batch, allowed the library's"
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
        self.group_sizes = tuple(size for _, size in groups)
        """Number of worlds in each group."""
        self.num_envs = n = sum(self.group_sizes)
        made: dict[GraspConfig, GraspEnv] = {}
        for config in configs:
            key = replace(config, hand_seed=None)
            if key not in made:
                made[key] = GraspEnv(hand, key)
        self._single = single = made[replace(configs[0], hand_seed=None)]
        members = [made[replace(config, hand_seed=None)] for config in configs]
        self.config, self.hand, self.task = single.config, single.hand, single.task
        self.max_episode_steps = single.max_episode_steps
        self.widths = tuple(len(env.observation_names()) for env in members)
        """Length of each group's own ``observation``."""
        self.simulator = simulators.make(single.simulator.scene, n, device, **simulator)
        self.device = self.simulator.device
        draws = draws or ("host" if device == "loop" else "device")
        self._senses = _Senses(
            members,
            groups,
            self.simulator,
            {"host": HostDraws, "device": DeviceDraws}[draws],
        )
        self._task = _TASKS[self.config.task](self.task, n)
        self._hold = _Hold(self.task.hold, self.config.timestep, n)
        self.metadata = {"autoreset_mode": autoreset}
        self._autoreset, self._numpy = autoreset, numpy
        self.single_action_space = single.action_space
        self.action_space = batch_space(single.action_space, n)
        spaces = [env.observation_space for env in members]
        self.group_observation_spaces = tuple(spaces)
        self.single_observation_space: Any = spaces[int(np.argmax(self.widths))]
        self.observation_space = batch_space(self.single_observation_space, n)
        self._rngs: list[Any] = [None] * n
        self._rng = np.random.default_rng()
        self._targets = np.tile(single.hand.start_targets(), (n, 1))
        self._steps, self._position = np.zeros(n, int), np.zeros((n, 3))
        self._holding, self._over = np.zeros(n, bool), np.ones(n, bool)
        self._achieved = np.zeros((n, self.task.goal_size), np.float32)
        self._desired = np.zeros((n, self.task.goal_size), np.float32)
        self._obs = torch.zeros((n, max(self.widths)), device=self.device)
        self._pending = self._obs.clone()
        self._shown = self._achieved.copy()
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
        is_host = isinstance(self._senses.draws, HostDraws)
        given = {i: seeds[i] for i in np.flatnonzero(mask).tolist()}
        for i, one in given.items():
            if one is not None or (is_host and self._rngs[i] is None):
                one = None if one is None else int(one)
                self._rngs[i], _ = gym.utils.seeding.np_random(one)
        if known := [int(one) for one in given.values() if one is not None]:
            self._rng = np.random.default_rng(known)
        self._begin(np.flatnonzero(mask))
        state, truth = self._look()
        self._observe(state, mask, mask)
        self._start_goals(mask, truth)
        return self._out(self._obs_dict()), self._info()

    def _draw(self, which: Sequence[int]) -> _Draws:
        """Draw the starts of worlds from their own generators, as `GraspEnv` does."""
        rows, nothing = [], np.zeros((len(self.hand.fingertips), 3))
        for i in which:
            item, start, observer, rng = self._single.draw_start(self._rngs[i])
            known: Any = SimpleNamespace(
                object_position=start.position, palm=nothing[0], fingertips=nothing
            )
            _, desired = self.task.reset(known, rng)
            self._senses.draws.begin(i, observer)
            if not isinstance(self._senses.draws, HostDraws):
                self._rngs[i] = None
            values = item.shape.half_size, item.mass, item.friction, *start
            rows.append((*values, desired, getattr(self.task, "sets_off", 0)))
        return _Draws(*map(np.array, zip(*rows, strict=True)))

    def _draw_at_once(self, which: Array) -> _Draws:
        """Draw the starts of worlds as `_draw` does, other numbers, from the batch's generator."""
        single, config, rng, n = self._single, self.config, self._rng, len(which)
        items, (kind,) = single._items, single._items._kinds
        edges = np.stack([rng.uniform(*size, n) for size in items._sizes], 1)
        half = edges[:, {1: [0, 0, 0], 2: [0, 0, 1], 3: [0, 1, 2]}[edges.shape[1]]] / 2
        mass = Shape(kind, (1.0, 1.0, 1.0)).volume * half.prod(1)
        mass *= rng.uniform(*items._density, n)
        friction = rng.uniform(*items._friction, n)
        joints = np.tile(self.hand.start_positions(), (n, 1))
        place, yaw = np.zeros((n, 3)), np.zeros(n)
        place[:, 2] = half[:, 2]
        if config.jitter:
            furthest = config.start_offset
            place[:, :2] = rng.uniform(-furthest, furthest, (n, 2))
            yaw = rng.uniform(-config.start_yaw, config.start_yaw, n)
            fingers = joints[:, FINGERS]
            fingers += rng.uniform(-JITTER_JOINT, JITTER_JOINT, fingers.shape)
            joints = np.clip(joints, *single.simulator.joint_limits.T)
        targets = np.tile(self.hand.start_targets(), (n, 1))
        goals = self._task.draw(place, half, single.palm_skin, rng)
        self._senses.draws.begin_at_once(which, rng)
        return _Draws(half, mass, friction, joints, goals[0], yaw, targets, *goals[1:])

    def _begin(self, which: Array) -> None:
        """Put worlds at the start of their next episodes."""
        is_own = np.array([self._rngs[i] is not None for i in which.tolist()], bool)
        own, others = which[is_own], which[~is_own]
        parts = [self._draw(own.tolist())] if len(own) else []
        parts += [self._draw_at_once(others)] if len(others) else []
        if not parts:
            return
        which = np.concatenate([own, others])
        drawn = _Draws(*map(np.concatenate, zip(*parts, strict=True)))
        place = drawn.joints, drawn.position, drawn.yaw, drawn.targets
        self.simulator.change_object(which, *drawn[:3])
        self._targets[which], self._desired[which] = drawn.targets, drawn.desired
        self.simulator.reset(which, *place)
        self._task.begin(which, drawn.position, drawn.sets_off)
        self._steps[which], self._over[which], self._holding[which] = 0, False, False
        self._task.before_step(
            self.simulator, self._steps, np.isin(np.arange(self.num_envs), which)
        )

    def _start_goals(self, mask: Array, truth: _Truth) -> None:
        self._position[mask] = truth.object_position[mask]
        self._achieved[mask] = self._task.achieved(truth, np.zeros(self.num_envs))[mask]
        self._shown[mask] = self._achieved[mask]

    def _look(self) -> tuple[BatchState, _Truth]:
        state = self.simulator.state(self._senses.wants_contacts)
        parts = (
            *(state.palm, state.fingertips, state.object_position),
            *(state.object_rotation, state.half_size, state.joint_positions[:, 2]),
        )
        n = self.num_envs
        flat = torch.cat([part.reshape(n, -1) for part in parts], 1).cpu().numpy()
        ends = np.cumsum([part[0].numel() for part in parts])[:-1]
        values = [
            value.reshape(n, *part.shape[1:]).astype(np.float64)
            for value, part in zip(np.split(flat, ends, 1), parts, strict=True)
        ]
        return state, _Truth(self.simulator.kind, *values)

    # -- a step ------------------------------------------------------------------------------

    def step(self, actions: Any) -> tuple[Obs, Any, Any, Any, dict[str, Any]]:
        """Take a step by actions (n, n_actions); see the class for worlds that are holding."""
        were_holding = self._holding.copy()
        fresh = self._over & (self._autoreset == AutoresetMode.NEXT_STEP)
        playing = ~self._holding & ~self._over
        self._advance(self._checked(actions), playing)
        self._begin(np.flatnonzero(fresh))
        state, truth = self._look()
        overflowed = self.simulator.overflowed & (playing | were_holding)
        broken = (self.simulator.diverged & (playing | were_holding)) | overflowed
        moved = np.linalg.norm(truth.object_position - self._position, axis=1)
        broken |= playing & ~(moved / self.config.control_dt < EJECTED)
        broken |= self._observe(state, (playing & ~broken) | fresh, fresh)
        self._position[playing] = truth.object_position[playing]
        self._start_goals(fresh, truth)
        is_last = self._steps >= self.max_episode_steps
        outcome, ended, due = self._task.after_step(truth, self._steps, is_last)
        stepped = playing & ~broken
        self._achieved[stepped] = self._task.achieved(truth, outcome)[stepped]
        due &= stepped & ~ended
        self._hold.begin(due, truth)
        over, held = self._hold.judge(were_holding & ~broken, truth)
        self.simulator.set_creep(self._hold.creep(were_holding & ~over & ~broken))
        self._achieved[over, -1] = np.where(held, 1.0, self._task.lost)[over]
        self._holding = due | (were_holding & ~over & ~broken)
        returned = (stepped & ~due) | over
        terminated = (ended & stepped) | over
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
            self._begin(np.flatnonzero(again))
            state, truth = self._look()
            self._observe(state, again, again)
            self._start_goals(again, truth)
            obs = self._obs_dict()
        return (
            self._out(obs),
            *map(self._out, (reward.astype(np.float32), terminated, truncated)),
            info,
        )

    def _checked(self, actions: Any) -> Array:
        values = (
            actions.detach().cpu().numpy() if isinstance(actions, Tensor) else actions
        )
        values, shape = np.asarray(values, np.float64), self.action_space.shape
        if values.shape != shape:
            raise ValueError(f"actions: found shape {values.shape}, allowed {shape}")
        if not np.isfinite(values).all():
            raise ValueError("actions: found NaN or infinity, allowed finite numbers")
        return np.clip(values, -1.0, 1.0)

    def _advance(self, actions: Array, playing: Array) -> None:
        """Run the physics of a step."""
        self._steps[playing] += 1
        self._targets[playing] = self.hand.action_map(actions, self._targets)[playing]
        self._task.before_step(self.simulator, self._steps, playing)
        n_substeps = np.where(playing, self.config.n_substeps, 0)
        targets = self._targets.copy()
        self._hold.plan(self._holding, targets, n_substeps)
        self.simulator.step(targets, n_substeps)
        self.simulator.check()

    def _observe(self, state: BatchState, which: Array, first: Array) -> Array:
        """Compute the observations of some worlds, the first of their episodes or not.

        Return bool (n,): whose are broken.
        """
        pending = self._senses.observe(state, self._targets, which, first)
        chosen = torch.as_tensor(which, device=self.device)
        self._pending = torch.where(chosen[:, None], pending, self._pending)
        largest = self._pending.abs().amax(1).cpu().numpy()
        fresh = torch.as_tensor(first, device=self.device)
        self._obs = torch.where(fresh[:, None], self._pending, self._obs)
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
        if self._numpy:
            return value.cpu().numpy() if isinstance(value, Tensor) else value
        return torch.as_tensor(value, device=self.device)

    def _info(self, **values: Any) -> dict[str, Any]:
        no = np.zeros(self.num_envs, bool)
        return {
            "is_success": no,
            "diverged": no,
            "overflowed": no,
            "holding": self._holding.copy(),
            **values,
        }

    def compute_reward(
        self, achieved_goal: Array, desired_goal: Array, info: Any
    ) -> Array:
        """Return the rewards (...) of goals (..., goal_size), by them alone."""
        return self.task.compute_reward(achieved_goal, desired_goal)

    def taxel_readings(self) -> Tensor:
        """Return what the taxels felt last, (n, most taxels), before any fault; zeros behind."""
        return self._senses.felt

    def close_extras(self, **kwargs: Any) -> None:
        """Release what the simulator holds."""
        self.simulator.close()


class _Draws(NamedTuple):
    """Hold what episodes draw at their start, (k, ...)."""

    half_size: Array
    mass: Array
    friction: Array
    joints: Array
    position: Array
    yaw: Array
    targets: Array
    desired: Array
    sets_off: Array


class _Truth(NamedTuple):
    """Hold what tasks and hold tests look at, NumPy's, (n, ...)."""

    kind: Kind
    palm: Array
    fingertips: Array
    object_position: Array
    object_rotation: Array
    half_size: Array
    slide: Array
    """Place of the slide that rises, (n,)."""

    @property
    def in_hand(self) -> Array:
        """The object's places relative to the palm, (n, 3)."""
        return self.object_position - self.palm

    def corners(self, which: Array) -> Array:
        """Return those of some worlds' objects as `hold` has them, (k, 8, 3)."""
        scaled = hold.CORNERS * self.half_size[which, None]
        turned = np.einsum("nci,nji->ncj", scaled, self.object_rotation[which])
        return self.in_hand[which, None] + turned

    @property
    def clearance(self) -> Array:
        """Height of the objects' lowest points over the ground, (n,)."""
        x, _, z = self.half_size.T
        upright = np.abs(self.object_rotation[:, 2, 2])
        reach = {
            "sphere": lambda: x,
            "cylinder": lambda: (
                z * upright + x * np.sqrt(np.maximum(0.0, 1.0 - upright**2))
            ),
            "box": lambda: np.einsum(
                "ni,ni->n", np.abs(self.object_rotation[:, 2]), self.half_size
            ),
        }[self.kind]()
        return self.object_position[:, 2] - reach


# -- tasks -----------------------------------------------------------------------------------


class _Reach:
    """`tasks.ReachGoal` with a leading axis; the others differ in some of it."""

    lost = 0.0
    """Outcome of a hold test that failed."""

    def __init__(self, task: Any, n: int) -> None:
        self.task, self._was_off, self._sets_off = (
            task,
            np.zeros(n, bool),
            np.zeros(n, int),
        )
        self._wait = np.zeros((n, 3))

    def draw(
        self, place: Array, half_size: Array, palm: Array, rng: np.random.Generator
    ) -> tuple[Array, Array, Array]:
        """Return places, goals and when a giver sets off, (k, ...), from usual places."""
        task, n = self.task, len(place)
        if task.only_goal is not None:
            return place, np.tile(task.only_goal, (n, 1)), np.zeros(n, int)
        goals = rng.uniform(-task.config.goal_range, task.config.goal_range, (n, 3))
        goals[:, 2] += task.first.half_size[2] + task.config.goal_height
        return place, goals, np.zeros(n, int)

    def begin(self, which: Array, position: Array, sets_off: Array) -> None:
        self._was_off[which], self._wait[which], self._sets_off[which] = (
            False,
            position,
            sets_off,
        )

    def before_step(
        self, simulator: BatchSimulator, steps: Array, playing: Array
    ) -> None:
        pass

    def after_step(
        self, truth: _Truth, steps: Array, is_last: Array
    ) -> tuple[Array, Array, Array]:
        """Return outcomes, which episodes end by the task's own rules, and which hold tests are due."""
        return (
            np.zeros(len(steps)),
            np.zeros(len(steps), bool),
            np.zeros(len(steps), bool),
        )

    def achieved(self, truth: _Truth, outcome: Array) -> Array:
        return truth.object_position


class _Lift(_Reach):
    lost = OUTCOMES["dropped"]

    def after_step(
        self, truth: _Truth, steps: Array, is_last: Array
    ) -> tuple[Array, Array, Array]:
        clearance = truth.clearance
        was_off, self._was_off = self._was_off, clearance > tasks.OFF_GROUND
        due = clearance > self.task.config.lift_clearance
        late = is_last & ~due
        outcome = np.where(
            was_off & ~self._was_off, OUTCOMES["fell_back"], OUTCOMES["undecided"]
        )
        return np.where(late, OUTCOMES["timed_out"], outcome), late, due

    def achieved(self, truth: _Truth, outcome: Array) -> Array:
        points = np.concatenate([truth.palm[:, None], truth.fingertips], 1)
        far = np.linalg.norm(points - truth.object_position[:, None], axis=-1)
        return np.concatenate([far, outcome[:, None]], 1)


class _Handover(_Reach):
    lost = OUTCOMES["missed"]

    def draw(
        self, place: Array, half_size: Array, palm: Array, rng: np.random.Generator
    ) -> tuple[Array, Array, Array]:
        task, n = self.task, len(place)
        reach = rng.uniform(*bounds("", task.config.handover_reach), n)
        x, y, _ = place.T
        under = np.stack([x, y - reach, -half_size[:, 2] - task.below], 1)
        goals = np.tile(task.only_goal, (n, 1))
        low, high = task.waits
        waits = rng.integers(low, high, n, endpoint=True)
        return palm + under, goals, waits

    def before_step(
        self, simulator: BatchSimulator, steps: Array, playing: Array
    ) -> None:
        task, up = self.task, np.array([0.0, 0.0, self.task.below + self.task.beyond])
        waits = np.flatnonzero(playing & (steps == 0))
        sets_off = np.flatnonzero(playing & (steps == self._sets_off))
        leaves = np.flatnonzero(playing & (steps == self._sets_off + task.stays))
        if len(waits):
            simulator.carry(waits, self._wait[waits])
        if len(sets_off):
            simulator.carry(sets_off, self._wait[sets_off] + up)
        if len(leaves):
            simulator.let_go(leaves)

    def after_step(
        self, truth: _Truth, steps: Array, is_last: Array
    ) -> tuple[Array, Array, Array]:
        since = steps - self._sets_off - self.task.stays
        missed = (since >= 0) & (
            np.linalg.norm(truth.in_hand, axis=1) > self.task.fallen
        )
        return (
            np.where(missed, OUTCOMES["missed"], 0.0),
            missed,
            since >= self.task.settles,
        )

    def achieved(self, truth: _Truth, outcome: Array) -> Array:
        return outcome[:, None]


_TASKS: dict[str, type[_Reach]] = {
    "reach-goal": _Reach,
    "lift-and-hold": _Lift,
    "handover": _Handover,
}
_OWN = {
    "reach-goal": tasks.ReachGoal,
    "lift-and-hold": tasks.LiftAndHold,
    "handover": tasks.Handover,
}


class _Hold:
    """`HoldTest.run` for worlds that are each at their own look."""

    def __init__(self, test: hold.HoldTest, timestep: float, n: int) -> None:
        self.test = test
        self._n_substeps = max(1, round(test.look_every / timestep))
        self._n_whole = max(1, round(test.seconds / timestep))
        self._rise = hold.RAISE_SPEED * timestep * self._n_substeps
        self._n_shaken = round(test.shake_seconds / test.look_every)
        self._slide, self._top = np.zeros(n), np.zeros(n)
        self._look, self._left = np.zeros(n, int), np.zeros(n, int)
        self._corners = np.zeros((n, 8, 3))

    def begin(self, which: Array, truth: _Truth) -> None:
        """Begin the tests of some worlds."""
        self._slide[which] = truth.slide[which]
        self._top[which] = (truth.slide + self.test.height - truth.palm[:, 2])[which]
        self._look[which], self._left[which] = 0, self._n_whole
        self._corners[which] = truth.corners(which)

    def plan(self, which: Array, targets: Array, n_substeps: Array) -> None:
        """Write the next look's target of the slide, and its number of timesteps."""
        rises = which & (self._slide != self._top)
        stays = which & ~rises
        self._slide[rises] += np.clip(self._top - self._slide, -self._rise, self._rise)[
            rises
        ]
        n_substeps[rises] = self._n_substeps
        n_substeps[stays] = np.minimum(self._n_substeps, self._left[stays])
        self._left[stays] -= n_substeps[stays]
        self._look[which] += 1
        targets[which, 2] = self._slide[which]

    def judge(self, which: Array, truth: _Truth) -> tuple[Array, Array]:
        """Return whose tests are over after a look, and who held, bool (n,)."""
        test, is_at_top = self.test, self._slide == self._top
        fell = which & ~(np.linalg.norm(truth.in_hand, axis=1) <= test.out_of_reach)
        held = which & ~fell & is_at_top & (self._left == 0)
        if test.verdict == "settled" and which.any():
            corners, speed = truth.corners(which), np.zeros(len(which))
            moved = np.linalg.norm(corners - self._corners[which], axis=2).max(1)
            speed[which] = moved / test.look_every
            self._corners[which] = corners
            compressed = self._compressed
            whole = (test.seconds + test.height / hold.RAISE_SPEED) / test.creep
            left = np.maximum(0.0, whole - compressed)
            rests = speed * (left + test.look_every) < test.settle_distance
            rests &= truth.clearance > hold.CLEARANCE
            settles = (compressed > 0) & (rests | (is_at_top & (left == 0)))
            held |= which & ~fell & settles
        return fell | held, held

    @property
    def _compressed(self) -> Array:
        return (self._look - self._n_shaken) * self.test.look_every

    def creep(self, which: Array) -> Array:
        """Return by which factor each world creeps, while these are tested."""
        is_fast = which & (self.test.verdict == "settled") & (self._compressed >= 0)
        return np.where(is_fast, self.test.creep, 1.0)


# -- draws -----------------------------------------------------------------------------------

STREAMS = "sight", "joints", "held", "taxels"


class HostDraws:
    """The numbers that `GraspEnv` draws, from a generator for each world and each sense."""

    def __init__(self, n: int, tensor: Callable[[Any], Tensor]) -> None:
        """Wait for the worlds' first episodes."""
        self._rngs: list[Any] = [None] * n
        self._tensor = tensor

    def begin(self, i: int, rng: np.random.Generator) -> None:
        """Begin an episode in world i."""
        sight, joints, taxels = rng.spawn(3)
        (held,) = joints.spawn(1)
        self._rngs[i] = dict(zip(STREAMS, (sight, joints, held, taxels), strict=True))

    def __call__(
        self, stream: str, which: Array, widths: Array, is_normal: bool = True
    ) -> Tensor:
        """Return draws (n, widest) of a stream for some worlds, `widths` (n,) numbers for each."""
        result = np.zeros((len(which), int(widths.max(initial=0))))
        for i in np.flatnonzero(which).tolist():
            rng, width = self._rngs[i][stream], int(widths[i])
            result[i, :width] = (
                rng.standard_normal(width) if is_normal else rng.random(width)
            )
        return self._tensor(result)


class DeviceDraws:
    """Numbers from a counter and the episode's key, hashed where they are needed (SplitMix64)."""

    def __init__(self, n: int, tensor: Callable[[Any], Tensor]) -> None:
        """Wait for the worlds' first episodes."""
        self._keys, self._counts = np.zeros(n, np.int64), dict.fromkeys(STREAMS, 0)
        self._tensor = tensor
        self._count = np.zeros(n, np.int64)

    def begin(self, i: int, rng: np.random.Generator) -> None:
        """Begin an episode in world i."""
        seeds: Any = rng.bit_generator.seed_seq
        self._keys[i] = seeds.generate_state(1, np.uint64).view(np.int64)[0]
        self._count[i] = 0

    def begin_at_once(self, which: Array, rng: np.random.Generator) -> None:
        """Begin episodes in some worlds, with keys from one generator."""
        self._keys[which] = rng.integers(2**63, size=len(which))
        self._count[which] = 0

    def __call__(
        self, stream: str, which: Array, widths: Array, is_normal: bool = True
    ) -> Tensor:
        """Return draws (n, widest) of a stream."""
        like = self._tensor(0.0)
        self._count[which] += 1
        starts = self._keys + (self._count << 24) + (STREAMS.index(stream) << 20)
        width = int(widths.max(initial=0))
        n_bits = 2 * width if is_normal else width
        key = torch.as_tensor(starts, device=like.device)[:, None]
        bits = _mixed(
            key + torch.arange(n_bits, device=like.device) * -7046029254386353131
        )
        uniform = ((bits >> 11) & 0x1FFFFFFFFFFFFF).double() * 2.0**-53
        if not is_normal:
            return uniform.to(like.dtype)
        radius = (-2 * torch.log1p(-uniform[:, :width])).sqrt()
        return (radius * torch.cos(2 * torch.pi * uniform[:, width:])).to(like.dtype)


def _mixed(x: Tensor) -> Tensor:
    """Return int64 whose bits depend on all bits of x (SplitMix64's last steps)."""
    for shift, factor in ((30, -4658895280553007687), (27, -7723592293110705685)):
        x = (x ^ ((x >> shift) & ((1 << (64 - shift)) - 1))) * factor
    return x ^ ((x >> 31) & ((1 << 33) - 1))


# -- touch -----------------------------------------------------------------------------------


class _Touch:
    """A touch rule of `touch` for the worlds (k of them) with one layout."""

    def __init__(self, env: GraspEnv, which: Array, simulator: BatchSimulator) -> None:
        rule: Any = env._touch
        self._rule, self._taxels, self.which = (
            rule,
            env.taxels,
            torch.as_tensor(which, device=simulator.device),
        )

        def index(values: Any) -> Tensor:
            return torch.as_tensor(np.array(values), device=simulator.device)

        tensor = simulator.tensor
        self.n, self._kind = len(env.taxels), simulator.kind
        self._links = index(places(simulator.links, rule._points.links))
        self._blocks, self._reaches = (
            tensor(rule._points._blocks),
            tensor(rule._squared_reaches),
        )
        bounds = [*rule._first.tolist(), len(rule._squared_reaches) - self.n]
        length = max(np.diff(bounds))
        along = [
            [min(a + k, b - 1) for k in range(length)] for a, b in pairwise(bounds)
        ]
        self._along, self._bone = index(along) + self.n, index(rule._bone)
        self.reads_forces = isinstance(rule, touch.ForceRule)
        self._has_thresholds = isinstance(rule, touch.ThresholdTouch)
        if self.reads_forces:
            self._link = index(env.taxels.link_index)
            self._normals, self._radii = (
                tensor(env.taxels.normals),
                tensor(env.taxels.radii),
            )
        if self._has_thresholds:
            self._thresholds, self._releases = (
                tensor(rule._thresholds),
                tensor(rule._releases),
            )
            self._fires = torch.zeros(
                (len(which), self.n), dtype=torch.bool, device=simulator.device
            )

    def read(self, state: BatchState, which: Tensor, first: Tensor) -> Tensor:
        """Return readings (k, n_taxels); only those of `which` (n,) are remembered."""
        positions = state.link_positions[self.which[:, None], self._links]
        rotations = state.link_rotations[self.which[:, None], self._links]
        place, turn = (
            state.object_position[self.which],
            state.object_rotation[self.which],
        )
        local = self._blocks @ (_stacked(positions - place[:, None], rotations) @ turn)
        in_reach = (
            _squared_distance(self._kind, state.half_size[self.which], local)
            <= self._reaches
        )
        is_on = in_reach[:, : self.n] & in_reach[:, self._along].any(2)[:, self._bone]
        self._correct(is_on, positions, rotations, state)
        if not self.reads_forces:
            return is_on
        forces = self._forces(_stacked(positions, rotations), rotations, state)
        if not self._has_thresholds:
            return torch.where(is_on, forces, 0.0)
        fires = self._fires & ~first[self.which, None]
        fires = is_on & (forces >= torch.where(fires, self._releases, self._thresholds))
        self._fires = torch.where(which[self.which, None], fires, self._fires)
        return fires

    def _correct(
        self, is_on: Tensor, positions: Tensor, rotations: Tensor, state: BatchState
    ) -> None:
        """Let MuJoCo look at links that are neither capsules nor flat, where they may feel."""
        if not self._rule._shaped._taxels_of_geom:
            return
        felt = is_on.any(1).nonzero()[:, 0]
        of_object = state.object_position, state.object_rotation, state.half_size
        parts = positions, rotations, *(part[self.which] for part in of_object)
        on, *values = (part[felt].cpu().numpy() for part in (is_on, *parts))
        for row, *pose, place, turn, half in zip(
            on, *(value.astype(np.float64) for value in values), strict=True
        ):
            known: Any = SimpleNamespace(
                poses=lambda links, pose=pose: pose,
                object_position=place,
                object_rotation=turn,
                shape=Shape(self._kind, tuple(half.tolist())),
            )
            self._rule._shaped.correct(row, known)
        is_on[felt] = torch.as_tensor(on, device=is_on.device)

    def _forces(self, poses: Tensor, rotations: Tensor, state: BatchState) -> Tensor:
        """Return what `ForceRule.feel` says that the taxels carry, (k, n_taxels), N."""
        assert state.contacts is not None
        points, forces, normals = (part[self.which] for part in state.contacts)
        ways = torch.einsum("knij,nj->kni", rotations[:, self._link], self._normals)
        along = (ways @ normals.transpose(1, 2)).clamp_min(0.0) * (forces > 0)[:, None]
        pressing = along * forces[:, None]
        totals = pressing.sum(2)
        middles = pressing @ points / totals.clamp_min(touch.EPSILON)[..., None]
        offsets = self._blocks[: self.n] @ poses - middles
        distances = offsets.norm(dim=2)
        ways = offsets / distances.clamp_min(touch.EPSILON)[..., None]
        beyond = torch.einsum(
            "kni,knci->knc", ways, middles[:, :, None] - points[:, None]
        )
        rims = touch.PATCH + (beyond * (along > 0)).clamp_min(0.0).amax(2)
        return totals * rims / (rims + (distances - self._radii).clamp_min(0.0))


def _stacked(positions: Tensor, rotations: Tensor) -> Tensor:
    """Return poses (k, links, 3), (k, links, 3, 3) as `touch.LinkPoints` has them, (k, 4 links, 3)."""
    poses = torch.cat([rotations.transpose(2, 3), positions[:, :, None]], 2)
    return poses.reshape(len(poses), -1, 3)


def _squared_distance(kind: Kind, half_size: Tensor, points: Tensor) -> Tensor:
    """Return what `Shape.squared_distance` does, (n, m) for points (n, m, 3)."""
    if kind == "sphere":
        return (points.norm(dim=2) - half_size[:, :1]).clamp_min(0.0).square()
    half = half_size
    if kind == "cylinder":
        points = torch.stack(
            [torch.hypot(points[..., 0], points[..., 1]), points[..., 2]], -1
        )
        half = half_size[:, 1:]
    return (points.abs() - half[:, None]).clamp_min(0.0).square().sum(2)


# -- observations ----------------------------------------------------------------------------


class _Senses:
    """`observations.Observer` for all worlds; taxels are padded with zeros to the most of a layout."""

    def __init__(
        self,
        members: Sequence[GraspEnv],
        groups: Sequence[tuple[GraspConfig, int]],
        simulator: BatchSimulator,
        draws: Callable[..., Any],
    ) -> None:
        config, env, n = groups[0][0], members[0], simulator.n
        self._config, self._hand, self._simulator = config, env.hand, simulator
        self._terms, self._first_shape = env._observer._terms, env.task.first
        self.draws = draws(n, simulator.tensor)
        sizes = [size for _, size in groups]

        def spread(values: Any) -> Array:
            return np.repeat(np.array(values), sizes, axis=0)

        configs = [config for config, _ in groups]
        self.n_taxels = spread(
            [
                0 if config.touch == "absent" else len(member.taxels)
                for member, config in zip(members, configs, strict=True)
            ]
        )
        self._width = int(self.n_taxels.max())
        owner = spread([[e is m for m in members].index(True) for e in members])
        is_on = spread([config.touch == "on" for config in configs])
        self._touches = [
            _Touch(
                members[number], np.flatnonzero(is_on & (owner == number)), simulator
            )
            for number in sorted(set(owner[is_on].tolist()))
        ]
        self._layouts = [
            (
                torch.as_tensor(
                    np.flatnonzero(self.n_taxels == m), device=simulator.device
                ),
                int(m),
            )
            for m in sorted(set(self.n_taxels.tolist()))
        ]
        self.wants_contacts = any(rule.reads_forces for rule in self._touches)
        tensor = simulator.tensor
        joints = env._observer._joints
        self._white: Tensor | None = tensor(joints.white) if joints else None
        self._held = tensor(joints.held if joints else 0.0)
        self._error = self._noise = torch.zeros(
            (n, len(env.hand.joints)), dtype=simulator.dtype, device=simulator.device
        )
        self._seen_error = torch.zeros(
            (n, 6), dtype=simulator.dtype, device=simulator.device
        )
        self._sight_scale = tensor(np.repeat(config.sight_noise or SIGHT_NOISE, 3))
        self._start: list[Tensor] = []
        self._faults(groups, spread)
        self.felt = self._zeros(self._width)
        self._entries = self._taxels = self._late = torch.zeros(0)

    def _zeros(self, *shape: int) -> Tensor:
        return self._simulator.tensor(np.zeros((self._simulator.n, *shape)))

    def _faults(self, groups: Any, spread: Any) -> None:
        """Prepare the stages of all worlds' readings."""
        tensor, configs = self._simulator.tensor, [config for config, _ in groups]
        on = [config.taxel_false_on for config in configs]
        off = [config.taxel_false_off for config in configs]
        self._false = [tensor(spread(chances))[:, None] for chances in (on, off)]
        self._flips = spread(
            [bool(c.taxel_false_on or c.taxel_false_off) for c in configs]
        )
        self._delays = spread([c.taxel_delay for c in configs])
        dead, stuck = (np.zeros((len(configs), self._width), bool) for _ in range(2))
        ends = np.cumsum([0, *(size for _, size in groups)])
        for row, config in enumerate(configs):
            m = int(self.n_taxels[ends[row]])
            broken = observations.Broken(
                m, config.taxel_dead, config.taxel_stuck, config.hand_seed or 0
            )
            dead[row, broken.dead], stuck[row, broken.stuck] = True, True
        self._dead, self._stuck = (
            torch.as_tensor(spread(part), device=self._simulator.device)
            for part in (dead, stuck)
        )

    def observe(
        self, state: BatchState, targets: Array, which: Array, first: Array
    ) -> Tensor:
        """Return observations (n, widest) float32; only `which` worlds remember that they were made."""
        device = self._simulator.device
        now, begins = (torch.as_tensor(mask, device=device) for mask in (which, first))
        sensed: Any = SimpleNamespace(
            **state._asdict(), shape=SimpleNamespace(kind=self._simulator.kind)
        )
        self._see(sensed, which, first, now, begins)
        if self._white is not None:
            self._feel_joints(sensed, which, first, now, begins)
        entries = torch.cat(
            [self._term(term, sensed, targets) for term in self._terms], 1
        )
        taxels = self._readings(state, which, now, begins)
        history = self._config.history
        self._entries = _remember(self._entries, entries, history, now, begins)
        self._taxels = _remember(self._taxels, taxels, history, now, begins)
        n, obs = self._simulator.n, [self._entries.reshape(self._simulator.n, -1)]
        padded = torch.zeros(
            (n, history * self._width), dtype=entries.dtype, device=device
        )
        for worlds, m in self._layouts:
            padded[worlds, : history * m] = self._taxels[worlds][:, :, :m].reshape(
                len(worlds), -1
            )
        return torch.cat([*obs, padded], 1).float()

    def _term(self, term: str, sensed: Any, targets: Array) -> Tensor:
        if term == "targets":
            return self._simulator.tensor(self._hand.action_map.commands(targets))
        value = TERMS[term].read(self._hand, sensed)
        if isinstance(value, np.ndarray):  # the same in all worlds
            return self._simulator.tensor(value).expand(self._simulator.n, -1)
        return value

    def _feel_joints(
        self, sensed: Any, which: Array, first: Array, now: Tensor, begins: Tensor
    ) -> None:
        """Add `observations.JointErrors`."""
        widths = np.full(self._simulator.n, self._error.shape[1])
        if first.any():
            held = self._held * self.draws("held", first, widths)
            self._error = torch.where(begins[:, None], held, self._error)
        noise = self._white * self.draws("joints", which, widths)
        before = torch.where(begins[:, None], noise, self._noise)
        self._noise = torch.where(now[:, None], noise, self._noise)
        error = self._error + noise
        sensed.joint_positions = sensed.joint_positions + error
        sensed.joint_velocities = (
            sensed.joint_velocities + (noise - before) / self._config.control_dt
        )
        sensed.palm = sensed.palm + error[:, ARM]

    def _see(
        self, sensed: Any, which: Array, first: Array, now: Tensor, begins: Tensor
    ) -> None:
        """See as `observations.Sight` does."""
        mode = self._config.object_seen
        if mode == "exact":
            return
        place, turn = sensed.object_position, sensed.object_orientation
        if mode == "hidden":
            place, turn = torch.zeros_like(place), torch.zeros_like(turn)
        elif mode == "start":
            before = self._start or [place, turn]
            self._start = [
                torch.where(begins[:, None], new, old)
                for new, old in zip((place, turn), before, strict=True)
            ]
            place, turn = self._start
        else:
            widths = np.full(self._simulator.n, 6)
            if first.any():
                drawn = self._sight_scale * self.draws("sight", first, widths)
                self._seen_error = torch.where(begins[:, None], drawn, self._seen_error)
            error = self._seen_error
            if self._config.sight_noise_kind == "white":
                error = self._sight_scale * self.draws("sight", which, widths)
            place, turn = place + error[:, :3], _turned(error[:, 3:], turn)
        sensed.object_position, sensed.object_orientation = place, turn

    def _readings(
        self, state: BatchState, which: Array, now: Tensor, begins: Tensor
    ) -> Tensor:
        """Return what comes out of the taxels of all worlds, (n, most taxels)."""
        felt = torch.zeros_like(self.felt)
        for rule in self._touches:
            felt[rule.which, : rule.n] = rule.read(state, now, begins).to(felt.dtype)
        self.felt = felt
        if self._flips.any():
            draws = self.draws(
                "taxels", which & self._flips, self.n_taxels, is_normal=False
            )
            on, off = self._false
            flipped = torch.where(
                felt > 0,
                torch.where(draws < off, 0.0, felt),
                (draws < on).to(felt.dtype),
            )
            felt = torch.where(
                torch.as_tensor(self._flips, device=felt.device)[:, None], flipped, felt
            )
        felt = torch.where(self._dead, 0.0, torch.where(self._stuck, 1.0, felt)).to(
            felt.dtype
        )
        if self._delays.any():
            self._late = _remember(
                self._late, felt, int(self._delays.max()) + 1, now, begins
            )
            rows = torch.arange(len(felt), device=felt.device)
            felt = self._late[rows, torch.as_tensor(self._delays, device=felt.device)]
        return felt


def _remember(
    past: Tensor, value: Tensor, n: int, now: Tensor, first: Tensor
) -> Tensor:
    """Return the last n values (worlds, n, m), the newest first, as `observations.Past` has them."""
    same = value[:, None].expand(-1, n, -1)
    if not len(past):
        return same.clone()
    later = torch.cat([value[:, None], past[:, :-1]], 1)
    later = torch.where(first[:, None, None], same, later)
    return torch.where(now[:, None, None], later, past)


def _turned(vector: Tensor, quaternion: Tensor) -> Tensor:
    """Return orientations (n, 4) wxyz turned by rotation vectors (n, 3)."""
    angle = vector.norm(dim=1, keepdim=True)
    axis = vector * (torch.sinc(angle / (2 * torch.pi)) / 2)
    w, (v, u) = torch.cos(angle / 2), (quaternion[:, :1], quaternion[:, 1:])
    real = w * v - (axis * u).sum(1, keepdim=True)
    return torch.cat([real, w * u + v * axis + torch.linalg.cross(axis, u)], 1)
