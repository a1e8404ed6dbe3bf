"""The two tasks of the paper, and handover: where the object is at first and who moves it, which goal,
what is achieved, what is rewarded, what is success.

A task owns all of that, its thresholds and its hold test; the environment tells it what is true after
each action. Rewards are pure functions of the achieved and the desired goal, so that hindsight
relabelling can recompute them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Protocol

import numpy as np

from .hands import Array, Hand
from .hold import LOOK_STEPS, HoldTest, Verdict
from .objects import Shape, bounds, require_ends
from .simulators import Giver, Simulator
from .snapshot import Snapshot
from .typed import allow_only_with


@dataclass(frozen=True)
class TaskConfig:
    """Which task, and its thresholds."""

    task: str = "lift-and-hold"
    """lift-and-hold (the paper's task for PPO), reach-goal (its task for DDPG+HER), or handover (close
    the hand while somebody holds the object against it)."""
    reward: Literal["staged", "sparse", "dense", "outcome"] | None = None
    """lift-and-hold: staged; reach-goal: sparse (0 or -1) or dense (-10 x distance); handover:
    outcome. Default: the task's first."""
    lift_clearance: Annotated[float, "(0, 1]"] = 0.03
    """lift-and-hold: height of the object's lowest point at which it counts as lifted, m."""
    hold_seconds: Annotated[float, "(0, 1000]"] = 20.0
    """lift-and-hold and handover: length of the hold test, s (paper: 5,000 timesteps)."""
    hold_verdict: Verdict = "full"
    """lift-and-hold and handover: full, or settled, a test of about 1 s that is sometimes wrong. See
    docs/concepts/tasks.md."""
    handover_reach: Annotated[float, "[0, 0.1]"] | str = 0.0
    """handover: how far from the finger bases towards the fingertips the object is held, m; 0: against
    the palm. It may be a range, such as 0.01..0.05."""
    goal_height: Annotated[float, "(0, 1]"] = 0.08
    """reach-goal: height of the goal above where the object rests, m; where objects differ, above where
    the largest of the first kind rests, so that the goal does not tell the object's size."""
    goal_range: float = 0.0
    """reach-goal: largest random offset of the goal along x, y and z, m."""
    goal_tolerance: Annotated[float, "(0, 1]"] = 0.03
    """reach-goal: largest distance from the goal that counts as success, m."""


def validate(config: TaskConfig) -> None:
    """ValueError naming the first invalid field."""
    if not 0 <= config.goal_range <= config.goal_height:
        allowed = f"from 0 to goal_height, {config.goal_height:g} m"
        raise ValueError(f"goal_range: found {config.goal_range} m, allowed {allowed}")
    for task, name in (("reach-goal", "goal_range"), ("handover", "handover_reach")):
        if config.task != task:
            allow_only_with(f"task {task}", config, name)
    require_ends(config, "handover_reach")
    rewards = TASKS[config.task].rewards
    if config.reward is not None and config.reward not in rewards:
        allowed = ", ".join(rewards)
        raise ValueError(f"reward: found {config.reward!r}, allowed for {config.task}: {allowed}")


class Start(NamedTuple):
    """How hand and object begin an episode."""

    joints: Array
    """Positions (n_joints,) in the order of the hand's ``joints``, rad and m."""
    targets: Array
    """(n_actuators,) that the hand is held to at first."""
    position: Array
    """Of the object (3,), m."""
    yaw: float
    """Of the object, rad."""


class Judgement(NamedTuple):
    """What a task says after an action."""

    achieved_goal: Array
    """(goal_size,) float64"""
    is_over: bool = False
    """Does the episode end here by the task's own rules?"""
    hold: HoldTest | None = None
    """What has still to be passed for that, from the scene as it is; the episode is over then."""
    dropped_goal: Array = np.zeros(0)
    """What was achieved where it is not passed."""


class Task(Protocol):
    """Goals, rewards and verdicts of one environment's episodes. Unless it says otherwise, the object
    lies on the ground, and nobody but the hand moves it."""

    rewards: ClassVar[tuple[str, ...]]
    """The kinds of reward it has; the first is the default."""
    max_episode_steps: ClassVar[int]
    """Length of an episode unless the configuration says otherwise."""
    rise: ClassVar[float] = 0.0
    """How much higher than usual the hand hangs, m."""
    giver: ClassVar[Giver | None] = None
    """Who carries the object before the hand has it."""
    goal_size: int
    """Length of achieved and desired goals."""
    only_goal: Array | None = None
    """The goal (goal_size,) of every episode, where no other is ever asked for or could be."""
    config: TaskConfig
    first: Shape
    hold: HoldTest

    def __init__(self, config: TaskConfig, hand: Hand, own_timestep: float, first: Shape) -> None:
        """As configured, for a hand whose own timestep is that, s, and a scene whose first object has
        this shape."""
        self.config, self.first = config, first
        self.hold = HoldTest(config.hold_seconds, LOOK_STEPS * own_timestep, config.hold_verdict)

    def start(self, usual: Start, palm: Array, shape: Shape, rng: np.random.Generator) -> Start:
        """How an episode begins: usually with the hand open above an object on the ground, both a
        little moved. `palm` (3,) is a place on the palm's skin, at the bases of the fingers."""
        return usual

    def act(self, simulator: Simulator, step: int) -> None:
        """What others do in the scene before the hand's action number `step`, or at the start (0)."""

    def begin(self, start: Snapshot, rng: np.random.Generator) -> tuple[Array, Array]:
        """(achieved, desired goal) of a new episode, each (goal_size,)."""

    def judge(self, now: Snapshot, is_last: bool) -> Judgement:
        """What was achieved with an action, the episode's last one or not."""

    def reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Rewards (...) from goals (..., goal_size)."""

    def is_success(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """bool (...); usually, is the outcome at the end of the achieved goal "held"?"""
        return np.asarray(achieved_goal)[..., -1] == OUTCOMES["held"]


class ReachGoal(Task):
    """Bring the object to a place above the ground and keep it there (paper, MuJoCo set-up)."""

    rewards = ("sparse", "dense")
    max_episode_steps = 20
    goal_size = 3

    def begin(self, start: Snapshot, rng: np.random.Generator) -> tuple[Array, Array]:
        goal = np.array([0.0, 0.0, self.first.half_size[2] + self.config.goal_height])
        if spread := self.config.goal_range:
            goal += rng.uniform(-spread, spread, 3)
        return start.object.position, goal

    def judge(self, now: Snapshot, is_last: bool) -> Judgement:
        return Judgement(now.object.position)

    def reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """sparse: 0 within the tolerance, else -1; dense: -10 x distance in m. Both readings
        of the paper exist in the code it builds on (Plappert et al. 2018)."""
        if self.config.reward == "dense":
            return -10.0 * _distance(achieved_goal, desired_goal)
        return self.is_success(achieved_goal, desired_goal) - 1.0

    def is_success(self, achieved_goal: Array, desired_goal: Array) -> Array:
        return _distance(achieved_goal, desired_goal) <= self.config.goal_tolerance


Outcome = Literal["undecided", "fell_back", "lifted", "dropped", "held", "timed_out", "missed"]
# How the outcome of a step of lift-and-hold or handover stands at the end of its achieved goal.
OUTCOMES: dict[Outcome, float] = {
    "timed_out": -1.0,
    "missed": -0.5,
    "undecided": 0.0,
    "fell_back": 0.25,  # had left the ground, and lies on it again
    "lifted": 0.4,  # the hold test decides between the next two
    "dropped": 0.5,  # was lifted, and did not survive the hold test
    "held": 1.0,
}
OFF_GROUND = 0.005  # m under the object's lowest point: an attempt has begun


class LiftAndHold(Task):
    """Grasp, lift, and survive a long unrecorded hold at 1 m (paper, PyBullet set-up).

    The achieved goal holds the distances the reward is made of (palm, then fingertips, to the
    object's centre, m) and the outcome; the desired goal is the outcome "held". There is one goal
    only, so relabelling an episode leaves its rewards as they are.
    """

    rewards = ("staged",)
    max_episode_steps = 100
    finger_weight: ClassVar[float] = 0.2
    """alpha of the paper's reward."""

    def __init__(self, config: TaskConfig, hand: Hand, own_timestep: float, first: Shape) -> None:
        super().__init__(config, hand, own_timestep, first)
        self.only_goal: Array = np.append(np.zeros(1 + len(hand.fingertips)), OUTCOMES["held"])
        self.goal_size = len(self.only_goal)

    def begin(self, start: Snapshot, rng: np.random.Generator) -> tuple[Array, Array]:
        self._is_off_ground = False
        return self._achieved(start, "undecided"), self.only_goal

    def judge(self, now: Snapshot, is_last: bool) -> Judgement:
        if now.clearance > self.config.lift_clearance:
            held, dropped = self._achieved(now, "held"), self._achieved(now, "dropped")
            return Judgement(held, True, self.hold, dropped)
        was_off, self._is_off_ground = self._is_off_ground, now.clearance > OFF_GROUND
        if is_last:  # the paper's time-out is a verdict too, with its -100
            return Judgement(self._achieved(now, "timed_out"), True)
        has_fallen = was_off and not self._is_off_ground
        return Judgement(self._achieved(now, "fell_back" if has_fallen else "undecided"))

    def _achieved(self, now: Snapshot, outcome: Outcome) -> Array:
        points = np.vstack([now.hand, now.fingertips])
        return np.append(_distance(points, now.object.position), OUTCOMES[outcome])

    def reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """Closeness of palm and fingertips until a lift; 5 more for a failed attempt, whether
        the object fell back before it was lifted or was dropped in the hold test; 1000 for a
        lift that held; -100 at time-out. Squares are of metres, as the paper has them."""
        closeness = np.exp(-(np.asarray(achieved_goal)[..., :-1] ** 2))
        near = closeness[..., 0] + self.finger_weight * closeness[..., 1:].sum(axis=-1)
        failed = near + 5.0
        return _by_outcome(
            achieved_goal, near, fell_back=failed, dropped=failed, timed_out=-100.0, held=1000.0
        )


class Handover(Task):
    """Close the hand while somebody holds an object against it, and keep it.

    The arm stands still. At a time that is not known, somebody brings the object up from below,
    presses it softly against the palm or the fingers, and lets go ten actions after setting off. It
    is missed when it falls; if it is still in the hand a little later, the hold test decides.
    """

    rewards = ("outcome",)
    max_episode_steps = 60
    rise = 0.2
    giver: ClassVar[Giver] = Giver()
    goal_size = 1
    only_goal: Array = np.array([OUTCOMES["held"]])
    below: ClassVar[float] = 0.12
    """How far under the palm the object waits, m."""
    beyond: ClassVar[float] = 0.004
    """How far beyond contact the giver wants to move it, m."""
    waits: ClassVar[tuple[int, int]] = (5, 35)
    """Before which action, from and to, the giver sets off."""
    stays: ClassVar[int] = 10
    """Actions from setting off to letting go."""
    settles: ClassVar[int] = 8
    """Actions from letting go to the hold test."""
    fallen: ClassVar[float] = 0.2
    """m from the palm: it was missed."""

    @classmethod
    def require_time(cls, max_episode_steps: int | None, control_dt: float) -> None:
        """ValueError where an episode ends before the hold test, or the giver lets go on the way."""
        least = cls.waits[1] + cls.stays + cls.settles
        if max_episode_steps is not None and max_episode_steps < least:
            raise ValueError(f"max_episode_steps: found {max_episode_steps}, allowed {least} or more "
                             "in a handover")  # fmt: skip
        fastest = 2 * (cls.below + cls.beyond) / cls.giver.speed / cls.stays
        if control_dt < fastest:
            raise ValueError(f"control_dt: found {control_dt} s, allowed {fastest:.3f} s or more in a "
                             "handover: the object would not arrive")  # fmt: skip

    def start(self, usual: Start, palm: Array, shape: Shape, rng: np.random.Generator) -> Start:
        x, y, _ = usual.position  # fingers point along -y
        nearest, furthest = bounds("handover_reach", self.config.handover_reach)
        reach = rng.uniform(nearest, furthest) if nearest < furthest else nearest
        under = [x, y - reach, -shape.half_size[2] - self.below]
        return usual._replace(position=palm + np.array(under))

    def begin(self, start: Snapshot, rng: np.random.Generator) -> tuple[Array, Array]:
        self._sets_off = int(rng.integers(*self.waits, endpoint=True))
        self._wait = start.object.position
        return _outcome("undecided"), self.only_goal

    def act(self, simulator: Simulator, step: int) -> None:
        self._step = step
        if step == 0:
            simulator.carry(self._wait)
        elif step == self._sets_off:
            simulator.carry(self._wait + np.array([0.0, 0.0, self.below + self.beyond]))
        elif step == self._sets_off + self.stays:
            simulator.let_go()

    def judge(self, now: Snapshot, is_last: bool) -> Judgement:
        since = self._step - self._sets_off - self.stays
        if since >= 0 and _distance(now.hand, now.object.position) > self.fallen:
            return Judgement(_outcome("missed"), True)
        if since >= self.settles:
            return Judgement(_outcome("held"), True, self.hold, _outcome("missed"))
        return Judgement(_outcome("undecided"))

    def reward(self, achieved_goal: Array, desired_goal: Array) -> Array:
        """1000 for an object that is held in the end, -100 for one that is missed."""
        return _by_outcome(achieved_goal, 0.0, missed=-100.0, held=1000.0)


def _outcome(name: Outcome) -> Array:
    """A goal of handover."""
    return np.array([OUTCOMES[name]])


def _by_outcome(goals: Array, reward: Any, **rewards: Any) -> Array:
    """The rewards (...) of goals (..., n) that end in an outcome: those named, or `reward`."""
    outcome = np.asarray(goals)[..., -1]
    for name, value in OUTCOMES.items():
        if name in rewards:
            reward = np.where(outcome == value, rewards[name], reward)
    return reward


def _distance(a: Any, b: Any) -> Array:
    return np.linalg.norm(np.asarray(a) - np.asarray(b), axis=-1)


TASKS: dict[str, type[LiftAndHold] | type[ReachGoal] | type[Handover]] = {
    "lift-and-hold": LiftAndHold,
    "reach-goal": ReachGoal,
    "handover": Handover,
}
