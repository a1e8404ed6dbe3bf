"""GraspEnv: a hand, a simulator, a task, a taxel layout and a run type as one environment."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args, get_type_hints

import gymnasium as gym
import numpy as np

from . import hands, layouts, objects, simulators, tasks, touch
from .hold import HoldTest, Verdict

Array = np.ndarray
LIMIT = 1e6  # observations beyond this are a broken simulation
EJECTED = 10.0  # m/s, of the object during an action: twice what random actions ever throw it at


@dataclass(frozen=True)
class GraspConfig:
    """Every choice a grasping scene leaves open. SI units and radians.

    The defaults are the Shadow Hand's; `setup` gives those of another hand.
    """

    simulator: Literal["mujoco", "pybullet"] = "mujoco"
    """The physics engine (mpl: pybullet, an extra)."""
    task: Literal["lift-and-hold", "reach-goal"] = "lift-and-hold"
    """lift-and-hold: the paper's PPO task; reach-goal: its DDPG+HER task."""
    reward: Literal["staged", "sparse", "dense"] | None = None
    """staged (lift-and-hold), sparse 0/-1 or dense -10 x distance (reach-goal); default: the
    task's first."""
    layout: str = "2"
    """Taxels: 1-6 (paper, Fig. 2), a named design, or the path of a .toml file."""
    run_type: Literal["main", "control", "absent"] = "main"
    """main: taxels read; control: all zero, same size (paper); absent: no taxel entries."""
    touch: Literal["skin", "contact"] = "skin"
    """Touch rule. skin: the taxel's sphere overlaps the object, and its skin touches it; contact:
    the simulator's own contact points (paper). Why skin: docs/environments.md."""
    object: objects.Kind = "box"
    """box, sphere or cylinder."""
    object_size: tuple[float, ...] = (0.05,)
    """Edge of the cube or three edges of a box, diameter of a sphere, diameter and height of a
    standing cylinder, m."""
    object_density: float = 567.0
    """kg/m^3 (manipulate_block.xml of the Shadow Hand's model; mpl: 800, a cube of 0.1 kg)."""
    friction: float = 1.0
    """Sliding friction of the object (the models' own value)."""
    finger_gain: float = 1.0
    """Position gain and force limit of the fingers, relative to the hand model's."""
    timestep: float = 0.004
    """Physics step, s (mpl: 1/240)."""
    control_dt: float = 0.2
    """Time between actions, s; a whole number of timesteps (mpl: 0.1)."""
    max_episode_steps: int | None = None
    """Actions per episode; default: the task's (lift-and-hold 100, as in the paper)."""
    jitter: bool = True
    """Move the start a little in every episode, seeded (the paper does not)."""
    lift_clearance: float = 0.03
    """lift-and-hold: the object counts as lifted when its lowest point is this high, m."""
    hold_seconds: float = 20.0
    """lift-and-hold: length of the hold test, s (5,000 timesteps, paper; mpl: 20.83)."""
    hold_verdict: Verdict = "full"
    """lift-and-hold: full, or settled (the same test with creep sped up and time compressed, ended once
    the object rests in the hand)."""
    goal_height: float = 0.08
    """reach-goal: the goal is this far above the object's start, m."""
    goal_tolerance: float = 0.03
    """reach-goal: success within this distance, m."""

    def __post_init__(self) -> None:
        size = (self.object_size,) if np.ndim(self.object_size) == 0 else self.object_size
        object.__setattr__(self, "object_size", tuple(size))  # a number, or JSON's list
        object.__setattr__(self, "layout", str(self.layout))  # 4 is "4"

    @property
    def shape(self) -> objects.Shape:
        """The object's."""
        return objects.make(self.object, self.object_size)

    @property
    def n_substeps(self) -> int:
        """Timesteps per action."""
        return round(self.control_dt / self.timestep)

    def validate(self) -> None:
        """Raise ValueError naming the first field that cannot be."""
        for name, kind in get_type_hints(type(self)).items():
            options = (c for part in (kind, *get_args(kind)) for c in get_args(part))
            choices = [choice for choice in options if isinstance(choice, str)]
            value = getattr(self, name)
            if choices and value not in (*choices, getattr(type(self), name)):
                raise ValueError(f"{name}: found {value!r}, allowed: {', '.join(choices)}")
        for name in (
            *("object_size", "object_density", "friction", "finger_gain", "timestep", "control_dt"),
            *("lift_clearance", "hold_seconds", "goal_height", "goal_tolerance"),
        ):
            for value in np.ravel(getattr(self, name)):
                if not (np.isfinite(value) and value > 0):
                    raise ValueError(f"{name}: found {value}, allowed a finite number above 0")
        for size, most, where in (
            (self.shape.width, WIDEST, "across"),
            (self.shape.height, TALLEST, "in height"),
        ):
            if size > most:
                raise ValueError(f"object_size: found {size:g} m, allowed up to {most} m {where}")
        if self.max_episode_steps is not None and self.max_episode_steps < 1:
            raise ValueError(f"max_episode_steps: found {self.max_episode_steps}, allowed 1 or more")
        ratio = self.control_dt / self.timestep
        if self.n_substeps < 1 or abs(ratio - self.n_substeps) > 1e-6 * ratio:
            raise ValueError(
                f"control_dt: found {self.control_dt} s, allowed a whole number of timesteps "
                f"of {self.timestep} s"
            )
        allowed = REWARDS[self.task]
        if self.reward is not None and self.reward not in allowed:
            raise ValueError(
                f"reward: found {self.reward!r}, allowed for {self.task}: {', '.join(allowed)}"
            )


# What the paper's set-up of a hand says differently from `GraspConfig`'s own defaults.
SETUPS: dict[str, dict[str, Any]] = {
    "shadow": {},
    "mpl": {
        "simulator": "pybullet",
        "object_density": 800.0,
        "timestep": 1 / 240,
        "control_dt": 0.1,
        "hold_seconds": 5000 / 240,
    },
}


def setup(hand: str, **choices: Any) -> GraspConfig:
    """The configuration of a hand's set-up, with some fields chosen otherwise."""
    return GraspConfig(**{**SETUPS[hand], **choices})


REWARDS = {"lift-and-hold": ("staged",), "reach-goal": ("sparse", "dense")}
WIDEST = 0.08  # m, of an object across; benchmarks/hard_cases.py goes up to it
TALLEST = 0.15  # m, of an object: held at its top, its centre is well above what counts as dropped
OFF_GROUND = 0.005  # m under the object's lowest point: lift-and-hold's attempt has begun
JITTER_POSITION = 0.005  # m, of the object along x and y
JITTER_YAW = 0.15  # rad, of the object
JITTER_JOINT = 0.02  # rad, of every finger joint, within its range


class GraspEnv(gym.Env[Any, Array]):
    """A hand above an object on the ground; a goal environment in Gymnasium's sense.

    Observations are a Dict of float32 Boxes: ``observation`` (`observation_names` says what
    each entry is), ``achieved_goal`` and ``desired_goal`` (see the task). Actions lie in
    [-1, 1]; what is beyond is clipped. ``info`` holds ``is_success``, and ``diverged`` when
    the physics broke: the step is then void, the observation the last good one, and the
    episode truncated. ``warnings`` is there when the simulator has warned since the last step,
    and says how often.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}

    def __init__(
        self,
        hand: str = "shadow",
        config: GraspConfig | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.config = config = config or setup(hand)
        config.validate()
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode: found {render_mode!r}, allowed None or 'rgb_array'")
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": max(1, round(1 / config.control_dt))}
        self.shape = config.shape
        width, height = self.shape.width, self.shape.height
        self.hand = hands.load(hand).over(width, height)
        self.taxels = layouts.load(config.layout).place(self.hand)
        self._touch = touch.SkinTouch(self.taxels, self.hand.surfaces)
        self.task = _task(config)
        self.max_episode_steps = config.max_episode_steps or self.task.max_episode_steps
        self._contact = config.touch == "contact"
        self.simulator = simulators.load(
            config.simulator,
            simulators.Scene(
                hand=self.hand,
                shape=self.shape,
                mass=config.object_density * self.shape.volume,
                friction=config.friction,
                timestep=config.timestep,
                finger_gain=config.finger_gain,
                rise=max(0.0, height - self.hand.reach),
                contact_taxels=self.taxels if self._contact else None,
                visual=render_mode is not None,
            ),
        )
        self._warnings = self.simulator.warnings
        self._hold = HoldTest.of_setup(
            setup(hand).timestep, config.hold_seconds, self.shape, config.hold_verdict
        )
        self._desired_goal = self.task.desired_goal().astype(np.float32)
        self._object_id = np.array([float(objects.KINDS.index(self.shape.kind))])
        first = [self.hand.joints.index(joint) for joint in self.hand.first_joints]
        self._first_joints = np.array(first, dtype=int)
        self._start_positions = self.hand.start_positions()
        self._targets = self.hand.start_targets()
        self._steps, self._is_off_ground = 0, False
        self._object_position = np.zeros(3)
        self._obs: dict[str, Array] = {}
        self.action_space = gym.spaces.Box(-1.0, 1.0, (len(self.hand.action_names),), np.float32)
        self.observation_space = self._spaces()

    def _spaces(self) -> gym.spaces.Dict:
        """Taxels lie between 0 and 1; a task with a single goal has it as its only one."""
        n_obs, goal = len(self.observation_names()), self._desired_goal
        unbounded = np.full_like(goal, np.inf)
        low, high = np.full(n_obs, -np.inf, np.float32), np.full(n_obs, np.inf, np.float32)
        low[n_obs - self.n_boolean :], high[n_obs - self.n_boolean :] = 0.0, 1.0
        lowest, highest = (goal, goal) if self.task.has_single_goal else (-unbounded, unbounded)
        return gym.spaces.Dict(
            {
                "observation": gym.spaces.Box(low, high, dtype=np.float32),
                "achieved_goal": gym.spaces.Box(-unbounded, unbounded, dtype=np.float32),
                "desired_goal": gym.spaces.Box(lowest, highest, dtype=np.float32),
            }
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        super().reset(seed=seed)
        positions = self._start_positions.copy()
        position, yaw = np.array([0.0, 0.0, self.shape.half_size[2]]), 0.0
        if self.config.jitter:
            rng = self.np_random
            position[:2] += rng.uniform(-JITTER_POSITION, JITTER_POSITION, 2)
            yaw = rng.uniform(-JITTER_YAW, JITTER_YAW)
            positions[3:] += rng.uniform(-JITTER_JOINT, JITTER_JOINT, len(positions) - 3)
            positions = np.clip(positions, *self.simulator.joint_limits.T)
        self._targets = self.hand.start_targets()
        self._steps, self._is_off_ground = 0, False
        try:
            self.simulator.reset(positions, position, yaw)
            _, thing = seen = self._look()
            observation = self._observation(*seen)
        except simulators.SimulationError as error:
            raise simulators.SimulationError(f"an episode cannot begin: {error}") from error
        self._object_position = thing.position
        self._obs = self._goal_obs(observation, self._situation(*seen, "undecided"))
        return self._obs, {"is_success": False}

    def step(self, action: Array) -> tuple[dict[str, Array], float, bool, bool, dict[str, Any]]:
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self.action_space.shape:
            raise ValueError(f"action: found shape {action.shape}, allowed {self.action_space.shape}")
        if not np.isfinite(action).all():
            raise ValueError(f"action: found {action[~np.isfinite(action)][0]}, allowed finite numbers")
        self._targets = self.hand.action_map(np.clip(action, -1.0, 1.0), self._targets)
        self._steps += 1
        try:
            self.simulator.step(self._targets, self.config.n_substeps)
            _, thing = seen = self._look()
            self._follow(thing.position)
            observation = self._observation(*seen)
            situation = self._situation(*seen, self._outcome_before_hold(thing))
            if situation.outcome == "lifted":
                held = self._hold.run(self.simulator, self._targets, self.config.timestep)
                situation = replace(situation, outcome="held" if held else "dropped")
        except simulators.SimulationError as error:
            info = self._info(is_success=False, diverged=True, error=str(error))
            last = {key: value.copy() for key, value in self._obs.items()}
            return last, 0.0, False, True, info
        self._obs = obs = self._goal_obs(observation, situation)
        goals = obs["achieved_goal"], obs["desired_goal"]
        terminated = situation.outcome in tasks.FINAL
        truncated = not terminated and self._steps >= self.max_episode_steps
        info = self._info(is_success=bool(self.task.is_success(*goals)))
        return obs, float(self.task.reward(*goals)), terminated, truncated, info

    def compute_reward(self, achieved_goal: Array, desired_goal: Array, info: Any) -> Array:
        """Rewards (...) of goals (..., goal_size); pure, `info` is not looked at."""
        return self.task.reward(np.asarray(achieved_goal), np.asarray(desired_goal))

    def observation_names(self) -> list[str]:
        """What each entry of ``observation`` is, in order."""
        names = {
            "object_id": ["object kind: " + ", ".join(objects.KINDS)],
            "hand_position": [f"hand {axis}" for axis in "xyz"],
            "finger_joints": [f"position of {joint}" for joint in self.hand.first_joints],
            "joint_positions": [f"position of {joint}" for joint in self.hand.joints],
            "joint_velocities": [f"velocity of {joint}" for joint in self.hand.joints],
            "object_position": [f"object {axis}" for axis in "xyz"],
            "object_orientation": [f"object quaternion {axis}" for axis in "wxyz"],
        }
        entries = [name for term in self.hand.observation for name in names[term]]
        entries += [f"taxel {name}" for name in self.taxels.names][: self.n_boolean]
        return entries

    @property
    def side_by_side(self) -> str:
        """How several of these may be played in at once (`vector.start`)."""
        return "processes" if self.simulator.holds_gil else "threads"

    @property
    def n_boolean(self) -> int:
        """How many entries at the end of ``observation`` are 0 or 1: the taxels."""
        return 0 if self.config.run_type == "absent" else len(self.taxels)

    def taxel_readings(self) -> Array:
        """bool (n_taxels,): what the taxels feel now by the configured touch rule."""
        return self._feel(self.simulator.object_state())

    def render(self) -> Array | None:
        """A picture of the scene, taxels that fire lit, when made with "rgb_array"."""
        return None if self.render_mode is None else self.picture(simulators.Camera())

    def picture(self, camera: simulators.Camera) -> Array:
        """The scene as `camera` sees it, RGB (height, width, 3) uint8."""
        lit = self.taxel_readings() if self.config.run_type == "main" else None
        taxels = None if self.config.run_type == "absent" else self.taxels
        return self.simulator.render(camera, taxels, lit)

    def close(self) -> None:
        self.simulator.close()

    def _look(self) -> tuple[Array, objects.ObjectState]:
        """Where hand and object are now, asked of the simulator once for all that follows."""
        return self.simulator.link_positions(), self.simulator.object_state()

    def _follow(self, position: Array) -> None:
        """Where is the object after this action? SimulationError when it got there too fast: the
        physics can break and stay finite, as fingers that overlap deeply shoot the object out."""
        moved, self._object_position = position - self._object_position, position
        speed = math.sqrt(moved @ moved) / self.config.control_dt
        if not speed < EJECTED:
            raise simulators.SimulationError(
                f"the object moved at {speed:.3g} m/s: it was ejected or the physics broke"
            )

    def _feel(self, thing: objects.ObjectState) -> Array:
        if self._contact:
            return self.simulator.contact_taxels()
        poses = self.simulator.link_poses(self._touch.links)
        return self._touch.read(*poses, self.shape, thing)

    def _observation(self, points: Array, thing: objects.ObjectState) -> Array:
        positions, velocities = self.simulator.joint_state()
        terms = {
            "object_id": self._object_id,
            "hand_position": points[0],
            "finger_joints": positions.take(self._first_joints),
            "joint_positions": positions,
            "joint_velocities": velocities,
            "object_position": thing.position,
            "object_orientation": thing.orientation,
        }
        parts = [terms[term] for term in self.hand.observation]
        if self.config.run_type == "main":
            parts.append(self._feel(thing))
        elif self.config.run_type == "control":
            parts.append(np.zeros(len(self.taxels)))
        observation = np.concatenate(parts, dtype=np.float32, casting="same_kind")
        largest = np.abs(observation).max()
        if not largest < LIMIT:
            raise simulators.SimulationError(
                f"an observation is as large as {largest}: the physics broke"
            )
        return observation

    def _info(self, **info: Any) -> dict[str, Any]:
        """With the warnings that no step has told of yet: also those of a reset."""
        told, self._warnings = self._warnings, self.simulator.warnings
        return info if self._warnings == told else {**info, "warnings": self._warnings - told}

    def _situation(
        self, points: Array, thing: objects.ObjectState, outcome: tasks.Outcome
    ) -> tasks.Situation:
        return tasks.Situation(points[0], points[1:], thing.position, outcome)

    def _goal_obs(self, observation: Array, situation: tasks.Situation) -> dict[str, Array]:
        return {
            "observation": observation,
            "achieved_goal": self.task.achieved_goal(situation).astype(np.float32),
            "desired_goal": self._desired_goal.copy(),
        }

    def _outcome_before_hold(self, thing: objects.ObjectState) -> tasks.Outcome:
        if not self.task.tests_hold:
            return "undecided"
        clearance = thing.position[2] - self.shape.half_height(thing.rotation)
        if clearance > self.config.lift_clearance:
            return "lifted"
        was_off, self._is_off_ground = self._is_off_ground, clearance > OFF_GROUND
        if self._steps >= self.max_episode_steps:
            return "timed_out"
        return "fell_back" if was_off and not self._is_off_ground else "undecided"


def _task(config: GraspConfig) -> tasks.Task:
    if config.task == "lift-and-hold":
        return tasks.LiftAndHold()
    goal = (0.0, 0.0, config.shape.half_size[2] + config.goal_height)
    reward = config.reward or "sparse"
    assert reward != "staged"
    return tasks.ReachGoal(goal, config.goal_tolerance, reward)
