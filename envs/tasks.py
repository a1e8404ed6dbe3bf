"""Define the two tasks of the paper, and handover: start, giver, goal, reward, success.

A task owns all of that, its thresholds and its hold test. The environment calls `start`
and `reset` when an episode begins, then `before_step` and `after_step` around each
action. Rewards are pure functions of the achieved and the desired goal, so that
hindsight relabelling can recompute them. One task plays one episode, or as many side by
side: arrays then have a leading axis (...).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np

from .hands import Hand
from .hold import LOOK_STEPS, OUT_OF_REACH, HoldTest, Verdict
from .objects import Items, ObjectConfig, Shape, bounds, require_ends
from .observations import Term
from .simulators import Giver, Simulator
from .state import Array, State
from .validation import require_one_of

# m beyond where fingertips get: lost, and missed
BEYOND_REACH, BEYOND_FALLEN = 0.08, 0.03


@dataclass(frozen=True)
class TaskConfig:
    """Task of a scene, and its thresholds."""

    task: str = "lift-and-hold"
    """lift-and-hold (the paper's task for PPO), reach-goal (its task for DDPG+HER), or
    handover (close the hand while somebody holds the object against it)."""
    reward: str | None = None
    """lift-and-hold: staged; reach-goal: sparse (0 or -1) or dense (-10 x distance);
    handover: outcome. Default: the task's first."""
    lift_clearance: Annotated[float, "(0, 1]"] = 0.03
    """lift-and-hold: height of the object's lowest point at which it counts as lifted,
    m."""
    hold_seconds: Annotated[float, "(0, 1000]"] = 20.0
    """lift-and-hold and handover: length of the hold test, s (paper: 5,000
    timesteps)."""
    hold_verdict: Verdict = "full"
    """lift-and-hold and handover: full, or settled, a test of about 1 s that is
    sometimes wrong. See docs/concepts/tasks.md."""
    handover_reach: Annotated[float, "[0, 0.3]"] | str = 0.0
    """handover: how far from the finger bases towards the fingertips the object is
    held, m; 0: against the palm. It may be a range, such as 0.01..0.05."""
    giver_force: Annotated[float, "(0, 5]"] = 0.32
    """handover: force with which the giver presses the object against the hand, N."""
    goal_height: Annotated[float, "(0, 1]"] = 0.08
    """reach-goal: height of the goal above where the object rests, m; where objects
    differ, above where the largest of the first kind rests, so that the goal does not
    tell the object's size."""
    goal_range: float = 0.0
    """reach-goal: largest random offset of the goal along x, y and z, m."""
    goal_tolerance: Annotated[float, "(0, 1]"] = 0.03
    """reach-goal: largest distance from the goal that counts as success, m."""
    control_dt: Annotated[float, "(0, 10]"] = 0.2
    """Time between actions, s; a whole number of timesteps."""
    max_episode_steps: Annotated[int, "[1, inf)"] | None = None
    """Actions per episode; default: the task's (lift-and-hold 100, as in the paper)."""


def validate(config: TaskConfig) -> None:
    """Raise ValueError naming the first invalid field."""
    require_ends(config, "handover_reach")
    task = TASKS[config.task]
    if config.reward is not None:
        require_one_of(task.rewards, config.reward, "reward")
    task.validate(config)


def idle_options(task: str) -> dict[str, str]:
    """Return the fields that do nothing in a task, and in which task they would."""
    options = {kind: getattr(TASKS[kind], "options", ()) for kind in TASKS}
    return {
        name: f"task {kind}"
        for kind, names in options.items()
        for name in names
        if name not in options.get(task, ())
    }


class Start(NamedTuple):
    """Start of an episode for hand and object, as `Simulator.reset` takes it."""

    joints: Array
    """Positions (n_joints,) in the order of the hand's ``joints``, rad and m."""
    position: Array
    """Place of the object (3,), m."""
    yaw: float
    """Turn of the object about the vertical, rad."""
    targets: Array
    """Joint targets (n_actuators,) to which the hand is held at first, rad and m."""


class Task(ABC):
    """Goals, rewards and verdicts of one environment's episodes.

    Unless it says otherwise, the object lies on the ground, and nobody but the hand
    moves it.
    """

    rewards: ClassVar[tuple[str, ...]]
    """The kinds of reward it has; the first is the default."""
    options: ClassVar[tuple[str, ...]] = ()
    """Fields of the configuration that do nothing in tasks that do not name them
    too."""
    max_episode_steps: ClassVar[int]
    """Length of an episode unless the configuration says otherwise."""
    rise: ClassVar[float] = 0.0
    """Height above the usual at which the hand hangs, m."""
    giver: Giver | None = None
    """Spring that carries the object before the hand has it; None where nobody does."""
    goal_size: int
    """Length of achieved and desired goals."""
    lost: Outcome = "missed"
    """Outcome where the hold test fails."""
    only_goal: Array | None = None
    """Desired goal (goal_size,) of every episode; None where they differ."""
    observation_terms: Mapping[str, Term] = MappingProxyType({})
    """Terms of the observation besides the hand's, by name."""
    is_batched: ClassVar[bool] = False
    """True if this very class plays many episodes side by side too
    (`batch.BatchEnv`)."""

    @classmethod
    def items(cls, config: ObjectConfig) -> Items:
        """Return the objects of its episodes: usually, what the scene says."""
        return Items(config)

    @classmethod
    def validate(cls, config: TaskConfig) -> None:
        """Raise ValueError naming a field that does not go together with others in this task."""

    def __init__(
        self, config: TaskConfig, hand: Hand, hand_timestep: float, first: Shape
    ) -> None:
        """Make the task for a hand and a scene.

        `hand_timestep` is that of the hand's usual set-up, s; `first` is the shape of
        the scene's first object.
        """
        self.config, self.first = config, first
        self.hold = HoldTest(
            config.hold_seconds,
            LOOK_STEPS * hand_timestep,
            config.hold_verdict,
            out_of_reach=max(OUT_OF_REACH, hand.reach + BEYOND_REACH),
        )

    def start(self, usual: Start, palm: Array, shape: Shape, rng: Any) -> Start:
        """Return the start of an episode.

        Usually the hand is open above an object on the ground, both a little moved.
        `palm` (3,) is a place on the palm's skin, at the bases of the fingers.
        """
        return usual

    @abstractmethod
    def reset(self, state: State, rng: Any) -> tuple[Array, Array]:
        """Return (achieved, desired goal) of a new episode, each (goal_size,)."""

    def before_step(self, simulator: Simulator, step: int) -> None:
        """Do what others do before the hand's action number `step`, or at the start (0)."""
        goal, sets_off, lets_go = self.giving(step)
        if sets_off:
            simulator.carry(goal)
        if lets_go:
            simulator.let_go()

    def giving(self, step: Any) -> tuple[Array, Any, Any]:
        """Return to where (..., 3) the giver carries the object, and where it sets off or lets go now.

        `step` (...) is the number of the hand's next action, 0 at the start, below 0
        where none is due.
        """
        return np.zeros(3), False, False

    @abstractmethod
    def after_step(self, state: State, is_last: Any) -> tuple[Array, Any]:
        """Return the goal achieved (..., goal_size) with an action, and True if the episode ends here.

        `is_last` says that it is the episode's last action; the end is by the task's
        own rules.
        """

    def is_hold_due(self, state: State) -> Any:
        """Tell whether the hold test decides the episode now, after a step that did not end it."""
        return False

    def after_hold(self, achieved_goal: Array, is_held: Any) -> Array:
        """Return the goal achieved by a hold test, from that of the step before it."""
        outcome = np.where(is_held, OUTCOMES["held"], OUTCOMES[self.lost])
        return np.concatenate([achieved_goal[..., :-1], outcome[..., None]], axis=-1)

    @abstractmethod
    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Return rewards (...) of goals (..., goal_size)."""

    def is_success(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Tell where goals (...) are reached: usually, where the achieved one ends in "held"."""
        return np.asarray(achieved_goal)[..., -1] == OUTCOMES["held"]


class ReachGoal(Task):
    """Bring the object to a place above the ground and keep it there (paper, MuJoCo set-up)."""

    is_batched = True
    rewards = ("sparse", "dense")
    options = ("goal_range", "goal_height", "goal_tolerance")
    max_episode_steps = 20
    goal_size = 3

    @classmethod
    def validate(cls, config: TaskConfig) -> None:
        """Raise ValueError where goals may lie in the ground."""
        if not 0 <= config.goal_range <= config.goal_height:
            raise ValueError(
                f"goal_range: found {config.goal_range} m, allowed from 0 to goal_height, "
                f"{config.goal_height:g} m"
            )

    def reset(self, state: State, rng: Any) -> tuple[Array, Array]:
        """Draw the goal above where the first object rests."""
        goal = np.array([0.0, 0.0, self.first.half_size[2] + self.config.goal_height])
        furthest = self.config.goal_range
        return state.object_position, goal + rng.uniform(-furthest, furthest, size=3)

    def after_step(self, state: State, is_last: Any) -> tuple[Array, Any]:
        """Return the object's place; the episode goes on until its last action."""
        return state.object_position, False

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Return 0 within the tolerance, else -1 (sparse), or -10 x distance in m (dense).

        Both readings of the paper exist in the code it builds on (Plappert et al.
        2018).
        """
        if self.config.reward == "dense":
            return -10.0 * _distance(achieved_goal, desired_goal)
        return self.is_success(achieved_goal, desired_goal) - 1.0

    def is_success(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Tell where the object is within the tolerance of the goal."""
        return _distance(achieved_goal, desired_goal) <= self.config.goal_tolerance


Outcome = Literal["undecided", "fell_back", "dropped", "held", "timed_out", "missed"]
# The number at the end of an achieved goal of lift-and-hold and handover, by the
# outcome of the step.
OUTCOMES: dict[Outcome, float] = {
    "timed_out": -1.0,
    "missed": -0.5,
    "undecided": 0.0,
    "fell_back": 0.25,  # had left the ground, and lies on it again
    "dropped": 0.5,  # was lifted, and did not survive the hold test
    "held": 1.0,
}
OFF_GROUND = 0.005  # m under the object's lowest point: an attempt has begun


class LiftAndHold(Task):
    """Grasp, lift, and survive a long unrecorded hold at 1 m (paper, PyBullet set-up).

    The achieved goal holds the distances the reward is made of (palm, then fingertips,
    to the object's centre, m) and the outcome; the desired goal is the outcome "held".
    There is one goal only, so relabelling an episode leaves its rewards as they are.
    """

    is_batched = True
    rewards, lost = ("staged",), "dropped"
    options = ("lift_clearance",)
    max_episode_steps = 100
    finger_weight: ClassVar[float] = 0.2
    """alpha of the paper's reward."""

    def __init__(
        self, config: TaskConfig, hand: Hand, hand_timestep: float, first: Shape
    ) -> None:
        """Make the task as `Task` does; the goal's size depends on the hand's digits."""
        super().__init__(config, hand, hand_timestep, first)
        self.goal_size = 1 + len(hand.fingertips) + 1
        self.only_goal: Array = np.append(
            np.zeros(self.goal_size - 1), OUTCOMES["held"]
        )

    def reset(self, state: State, rng: Any) -> tuple[Array, Array]:
        """Return the goals of an episode in which nothing has been lifted yet."""
        self._is_off_ground = False
        return self._achieved(state, OUTCOMES["undecided"]), self.only_goal

    def after_step(self, state: State, is_last: Any) -> tuple[Array, Any]:
        """Return the distances and the outcome; too late a lift ends the episode with a verdict."""
        was_off_ground, self._is_off_ground = (
            self._is_off_ground,
            state.clearance > OFF_GROUND,
        )
        is_late = is_last & ~self.is_hold_due(state)
        has_fallen = was_off_ground & ~self._is_off_ground
        outcome = np.where(has_fallen, OUTCOMES["fell_back"], OUTCOMES["undecided"])
        return self._achieved(
            state, np.where(is_late, OUTCOMES["timed_out"], outcome)
        ), is_late

    def is_hold_due(self, state: State) -> Any:
        """Tell whether the object is lifted."""
        return state.clearance > self.config.lift_clearance

    def _achieved(self, state: State, outcome: Any) -> Array:
        points = np.concatenate([state.palm[..., None, :], state.fingertips], axis=-2)
        away = _distance(points, state.object_position[..., None, :])
        return np.concatenate(
            [away, np.broadcast_to(outcome, away.shape[:-1])[..., None]], axis=-1
        )

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Return the closeness of palm and fingertips until a lift, as the paper does.

        5 more for a failed attempt, whether the object fell back before it was lifted
        or was dropped in the hold test; 1000 for a lift that held; -100 at time-out.
        Squares are of metres, as the paper has them.
        """
        closeness = np.exp(-(np.asarray(achieved_goal)[..., :-1] ** 2))
        near = closeness[..., 0] + self.finger_weight * closeness[..., 1:].sum(axis=-1)
        failed = near + 5.0
        return _by_outcome(
            achieved_goal,
            near,
            fell_back=failed,
            dropped=failed,
            timed_out=-100.0,
            held=1000.0,
        )


class Handover(Task):
    """Close the hand while somebody holds an object against it, and keep it.

    The arm stands still. At a time that is not known, somebody brings the object up
    from below, presses it softly against the palm or the fingers, and lets go ten
    actions after setting off. It is missed when it falls; if it is still in the hand a
    little later, the hold test decides.
    """

    is_batched = True
    rewards = ("outcome",)
    options = ("handover_reach", "giver_force")
    max_episode_steps = 60
    rise = 0.2
    giver: Giver = Giver()
    goal_size = 1
    only_goal = np.array([OUTCOMES["held"]])
    below: ClassVar[float] = 0.12
    """Distance below the palm at which the object waits, m."""
    waits: ClassVar[tuple[int, int]] = (5, 35)
    """Before which action, from and to, the giver sets off."""
    stays: ClassVar[int] = 10
    """Actions from setting off to letting go."""
    settles: ClassVar[int] = 8
    """Actions from letting go to the hold test."""
    fallen: float = 0.2
    """m from the palm, or more where fingertips get further: it was missed."""
    sets_off: Any
    """Before which action (...) the giver does so in this episode."""

    @classmethod
    def validate(cls, config: TaskConfig) -> None:
        """Raise ValueError where an episode is too short, or its giver would let go on the way.

        An episode is too short where it ends before the hold test.
        """
        least = cls.waits[1] + cls.stays + cls.settles
        steps, dt = config.max_episode_steps, config.control_dt
        if steps is not None and steps < least:
            raise ValueError(
                f"max_episode_steps: found {steps}, allowed {least} or more in a handover"
            )
        beyond = config.giver_force / cls.giver.stiffness
        fastest = 2 * (cls.below + beyond) / cls.giver.speed / cls.stays
        if dt < fastest:
            raise ValueError(
                f"control_dt: found {dt} s, allowed {fastest:.3f} s or more in a handover"
            )

    def __init__(
        self, config: TaskConfig, hand: Hand, hand_timestep: float, first: Shape
    ) -> None:
        """Make the task as `Task` does, with a giver that may press as hard as the scene says."""
        super().__init__(config, hand, hand_timestep, first)
        self.beyond = config.giver_force / self.giver.stiffness
        """Distance beyond contact to which the giver wants to move the object, m."""
        force = max(self.giver.force, config.giver_force)
        self.giver = replace(self.giver, force=force)
        self.fallen = max(self.fallen, hand.reach + BEYOND_FALLEN)

    def start(self, usual: Start, palm: Array, shape: Shape, rng: Any) -> Start:
        """Return a start with the object below the place where it will touch the hand."""
        x, y, _ = np.moveaxis(usual.position, -1, 0)  # fingers point along -y
        nearest, furthest = bounds("handover_reach", self.config.handover_reach)
        reach = rng.uniform(nearest, furthest) if nearest < furthest else nearest
        under = np.broadcast_arrays(x, y - reach, -shape.half_size[2] - self.below)
        return usual._replace(position=palm + np.stack(under, axis=-1))

    def reset(self, state: State, rng: Any) -> tuple[Array, Array]:
        """Draw when the giver sets off."""
        self.sets_off = rng.integers(*self.waits, endpoint=True)
        self._wait = state.object_position
        return np.zeros((*state.palm.shape[:-1], 1)), self.only_goal

    def giving(self, step: Any) -> tuple[Array, Any, Any]:
        """Let the giver wait, set off or let go."""
        self._step = step
        up = np.array([0.0, 0.0, self.below + self.beyond])
        goal = self._wait + np.multiply.outer(step != 0, up)
        sets_off = (step == 0) | (step == self.sets_off)
        return goal, sets_off, self._since_letting_go == 0

    def after_step(self, state: State, is_last: Any) -> tuple[Array, Any]:
        """Return the outcome: missed where the object fell after the giver let go."""
        is_far = _distance(state.palm, state.object_position) > self.fallen
        is_missed = (self._since_letting_go >= 0) & is_far
        return np.where(is_missed, OUTCOMES["missed"], OUTCOMES["undecided"])[
            ..., None
        ], is_missed

    def is_hold_due(self, state: State) -> Any:
        """Tell whether the giver let go long enough ago."""
        return self._since_letting_go >= self.settles

    @property
    def _since_letting_go(self) -> Any:
        """Number of actions since the giver let go."""
        return self._step - self.sets_off - self.stays

    def compute_reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Return 1000 for an object that is held in the end, -100 for one that is missed."""
        return _by_outcome(achieved_goal, 0.0, missed=-100.0, held=1000.0)


def _by_outcome(goals: Array, otherwise: Any, **rewards: Any) -> Array:
    """Return the rewards (...) of goals (..., n) by the outcomes they end in, or `otherwise`."""
    outcomes, result = np.asarray(goals)[..., -1], otherwise
    for name, reward in rewards.items():
        result = np.where(outcomes == OUTCOMES[name], reward, result)  # type: ignore[index]
    return result


def _distance(a: Any, b: Any) -> Array:
    return np.linalg.norm(np.asarray(a) - np.asarray(b), axis=-1)


TASKS: dict[str, type[Any]] = {
    "lift-and-hold": LiftAndHold,
    "reach-goal": ReachGoal,
    "handover": Handover,
}
