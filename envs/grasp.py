"""GraspEnv: a hand, a simulator, a task, a taxel layout and a run type as one environment."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import gymnasium as gym
import numpy as np

from . import (
    hands,
    layouts,
    objects,
    observations,
    plugins,
    sensors,
    simulators,
    tasks,
    touch,
    validation,
)
from .objects import ObjectConfig, Shape
from .observations import ObservationConfig, Observer
from .simulators import SimulationError, Sphere
from .skin import Skin
from .state import Array, State
from .tasks import TaskConfig
from .validation import blamed, require_known, require_one_of

Step = tuple[dict[str, Array], float, bool, bool, dict[str, Any]]
LIMIT = 1e6  # observations beyond this are a broken simulation
EJECTED = 10.0  # m/s, of the object during an action: twice what random actions ever throw it at
JITTER_JOINT = 0.02  # rad, of every joint but the slides, within its range
LIT, DARK = (1.0, 0.85, 0.0, 1.0), (0.05, 0.25, 0.9, 1.0)  # of taxels in pictures
LIT_SCALE = 2.0  # of a taxel that fires, hard to see between hand and object


@dataclass(frozen=True)
class GraspConfig(ObservationConfig, TaskConfig, ObjectConfig):
    """Options of a grasping scene, in SI units and radians; some defaults depend on the hand."""

    simulator: str = "mujoco"
    """Physics engine: mujoco or pybullet (extra: pybullet)."""
    layout: str = "2"
    """Layout of the taxels (touch sensors): 1 to 6 (paper, Fig. 2), smarthand, zhang or
    abbass (other publications), model (the hand's own), or a .toml or .csv file.
    """
    touch: Literal["on", "off", "absent"] = "on"
    """on: taxels read contact; off: all read zero, the paper's control; absent: the
    observation has no taxels."""
    touch_rule: str = "skin"
    """Rule by which a taxel fires. skin: its sphere overlaps the object, which touches
    the skin there; contact: a contact of the simulator meets its sphere (paper); force:
    the taxel reads the normal force, N. See docs/concepts/touch.md.
    """
    actions: Literal["all", "fingers", "grip"] = "all"
    """all: every joint and slide of the hand (paper); fingers: the slides stand still,
    and groups of fingers close and open; grip: one action closes and opens the whole
    hand."""
    start_closing: Annotated[float, "[0, 1)"] = 0.2
    """How far the hand is closed at the start, from open (0) to closed (1), with
    --actions fingers or grip."""
    finger_gain: Annotated[float, "(0, 100]"] = 1.0
    """Position gain and force limit of the fingers, relative to the hand model's."""
    timestep: Annotated[float, "[1e-06, 0.1]"] = 0.004
    """Physics step, s."""
    skin_thickness: Annotated[float, "[0.002, 0.004]"] | None = None
    """Thickness of the soft outer part of the hand's links, m (MuJoCo); default: rigid
    links."""
    skin_modulus: Annotated[float, "[10000, 1000000]"] = 140_000.0
    """Young's modulus of the soft part, Pa. Default: Dragon Skin 10's; Ecoflex 00-30
    has 46000."""

    def __post_init__(self) -> None:
        """Convert what JSON, TOML and NumPy have instead of these types."""
        fields = {**vars(self), "layout": str(self.layout)}  # 4 is "4"
        for name, value in validation.plain(GraspConfig, fields).items():
            object.__setattr__(self, name, value)

    @property
    def n_substeps(self) -> int:
        """Number of timesteps per action."""
        return round(self.control_dt / self.timestep)

    def validate(self) -> None:
        """Raise ValueError naming what is not there or does not go together; ranges are in types."""
        require_one_of(simulators.SIMULATORS, self.simulator, "simulator")
        plugins.require_class(touch.RULES, self.touch_rule, "touch_rule", touch.Rule)
        plugins.require_class(tasks.TASKS, self.task, "task", tasks.Task)
        ratio = self.control_dt / self.timestep
        if self.n_substeps < 1 or abs(ratio - self.n_substeps) > 1e-6 * ratio:
            found = f"found {self.control_dt} s"
            allowed = f"a whole number of timesteps of {self.timestep} s"
            raise ValueError(f"control_dt: {found}, allowed {allowed}")
        for name, what in self.idle().items():
            if (value := getattr(self, name)) != getattr(GraspConfig, name):
                raise ValueError(f"{name}: found {value}, allowed only with {what}")
        if self.simulator == "pybullet" and "ellipsoid" in self.object:
            raise ValueError(
                "object: found ellipsoid, allowed only with simulator mujoco"
            )
        objects.validate(self)
        tasks.validate(self)
        observations.validate(self)

    def idle(self) -> dict[str, str]:
        """Return the fields that do nothing in this scene, and with what they would do something."""
        is_boolean = touch.RULES.get(self.touch_rule, touch.SkinTouch).is_boolean
        force = "taxels that read a force (touch_rule force)"
        bits = "Boolean taxels (touch_rule skin or contact)"
        sight = "sight_noise", "sight_noise_kind"
        idle = tasks.idle_options(self.task)
        for is_used, what, names in (
            (not is_boolean, force, sensors.OF_FORCE),
            (is_boolean, bits, sensors.OF_BITS),
            (self.touch_rule == "skin", "touch_rule skin", sensors.OF_FIRING),
            (self.touch == "on", "touch on", observations.TAXELS),
            (self.object_seen == "noisy", "object_seen noisy", sight),
            (self.actions != "all", "actions fingers or grip", ["start_closing"]),
            (self.jitter, "jitter", ["start_offset", "start_yaw"]),
            (self.skin_thickness is not None, "skin_thickness", ["skin_modulus"]),
            (self.simulator != "pybullet", "simulator mujoco", ["skin_thickness"]),
        ):
            if not is_used:
                idle |= dict.fromkeys(names, what)
        return idle


def setup(hand: str, **choices: Any) -> GraspConfig:
    """Return the configuration of a hand's set-up, with some fields chosen otherwise.

    A `sensor` brings its numbers (`sensors.choose`). Raise ValueError when there is no
    such field.
    """
    usual, known = hands.described(hand).scene, validation.names(GraspConfig)
    with blamed(f"hand file {hands.file(hand)}: scene"):
        require_known(usual, known)
    require_known(choices, known)
    return sensors.choose(GraspConfig(), {**usual, **choices})


def checked(action: Any, space: gym.Space[Any]) -> Array:
    """Return an action, or those of many worlds, clipped; ValueError for what is none of `space`."""
    action = np.asarray(action, np.float64)
    if action.shape != space.shape:
        raise ValueError(f"action: found shape {action.shape}, allowed {space.shape}")
    if not np.isfinite(action).all():
        raise ValueError("action: found NaN or infinity, allowed finite numbers")
    return np.clip(action, -1.0, 1.0)


class GraspEnv(gym.Env[Any, Array]):
    """A hand above an object on the ground; a goal environment in Gymnasium's sense.

    Observations are a Dict of float32 Boxes: ``observation`` (`observation_names` says
    what each entry is), ``achieved_goal`` and ``desired_goal`` (see the task). Actions
    lie in [-1, 1]; what is beyond is clipped. ``info`` has the same keys always:
    ``is_success``; which ``object`` the episode has; ``diverged`` when the physics
    broke, and then an ``error``: the step is void, the observation the last good one,
    and the episode truncated; and ``warnings``, how often the simulator has warned
    since the last step.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}
    state: State
    """State after the last action, before any hold test."""

    def __init__(
        self,
        hand: str = "shadow",
        config: GraspConfig | None = None,
        render_mode: str | None = None,
    ) -> None:
        """Make the environment of a hand, by name or file, in a scene (None: the hand's set-up).

        Raise ValueError for a scene that cannot be.
        """
        self.config = config = config or setup(hand)
        validation.validate(config)
        if render_mode is not None:
            require_one_of(self.metadata["render_modes"], render_mode, "render_mode")
        self.render_mode = render_mode
        fps = max(1, round(1 / config.control_dt))
        self.metadata = {**self.metadata, "render_fps": fps}
        task = tasks.TASKS[config.task]
        self._items = items = task.items(config)
        self._item = first = items.first
        width = items.width if config.is_near else math.inf
        self.hand = hands.get(hand).start_above(width, items.height)
        if config.actions != "all":
            self.hand = self.hand.closing_from(config.start_closing, config.actions)
        self.taxels = layouts.load(config.layout).place(self.hand)
        if config.taxel_radius is not None:
            self.taxels = self.taxels.resized(config.taxel_radius)
        self._touch = touch.make(
            config.touch_rule,
            self.taxels,
            self.hand,
            config.taxel_threshold,
            config.taxel_release,
            observations.spread(config, "threshold", len(self.taxels)),
        )
        self.task: tasks.Task = task(
            config, self.hand, setup(hand).timestep, first.shape
        )
        self.max_episode_steps = config.max_episode_steps or self.task.max_episode_steps
        scene = simulators.Scene(
            hand=self.hand,
            shape=first.shape,
            mass=first.mass,
            friction=first.friction,
            timestep=config.timestep,
            finger_gain=config.finger_gain,
            rise=self.task.rise + max(0.0, items.height - self.hand.start_clearance),
            sensors=touch.sensors(self.taxels) if self._touch.by_sensors else (),
            giver=self.task.giver,
            skin=Skin(config.skin_thickness, config.skin_modulus)
            if config.skin_thickness
            else None,
            visual=render_mode is not None,
        )
        self.simulator = simulators.make(config.simulator, scene)
        self._observer = Observer(
            config,
            self.hand,
            self.task.observation_terms,
            self.taxels.names,
            self._touch,
            first.shape,
        )
        place = np.array([0.0, 0.0, items.height / 2])
        self.simulator.reset(self.hand.start_positions(), place, 0.0)
        self.state = self.simulator.state()
        self.palm_skin = self._palm_skin()
        self._warnings = self.simulator.warnings
        self._steps = 0
        self._obs: dict[str, Array] = {}
        size = len(self.hand.action_names)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (size,), np.float32)
        goals = gym.spaces.Box(-np.inf, np.inf, (self.task.goal_size,), np.float32)
        desired = goals
        if self.task.only_goal is not None:
            goal = self.task.only_goal.astype(np.float32)
            desired = gym.spaces.Box(goal, goal)
        spaces = {"observation": self._observer.space, "achieved_goal": goals}
        self.observation_space = gym.spaces.Dict({**spaces, "desired_goal": desired})

    def _palm_skin(self) -> Array:
        """Return the place (3,) on the palm's skin where objects are handed over."""
        palm = [
            surface
            for surface in self.hand.surfaces
            if surface.segment == "palm"
            and surface.digit not in self.hand.file.handed_beside
        ]
        positions, rotations = self.state.poses(tuple(surface.link for surface in palm))
        centres = np.array([surface.centre for surface in palm])[:, :, None]
        return np.asarray((positions + (rotations @ centres)[:, :, 0]).mean(axis=0))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Array], dict[str, Any]]:
        """Begin an episode, and return its first observation and info."""
        super().reset(seed=seed)
        self._item, start, observer_rng, task_rng = self.draw_start(self.np_random)
        item = self._item
        self._observer.reset(observer_rng)
        try:
            self.simulator.change_object(item.shape, item.mass, item.friction)
            self.simulator.reset(*start)
            self.state = self.simulator.state()
            observation = self._observe()
        except SimulationError as error:
            raise SimulationError(f"an episode cannot begin: {error}") from error
        achieved, desired = self.task.reset(self.state, task_rng)
        self._desired_goal, self._steps = self._goal(desired), 0
        self.task.before_step(self.simulator, self._steps)
        self._obs = self._goal_obs(observation, achieved)
        return self._obs, self._info()

    def draw_start(self, rng: Any) -> tuple[objects.Item, tasks.Start, Any, Any]:
        """Draw an episode's object and start; return the observer's and the task's generators too.

        The hand is open above the object, both a little moved with jitter. `rng` may
        draw for many episodes (`batch.Draws`); arrays then have a leading axis, where
        they differ.
        """
        # To spawn draws nothing from the generator itself.
        observer_rng, task_rng, object_rng = rng.spawn(3)
        item, config = self._items.draw(object_rng), self.config
        joints, offset, yaw = self.hand.start_positions(), np.zeros(2), 0.0
        if config.jitter:
            offset = rng.uniform(-config.start_offset, config.start_offset, size=2)
            yaw = rng.uniform(-config.start_yaw, config.start_yaw)
            n_fingers = len(joints[hands.FINGERS])
            fingers = rng.uniform(-JITTER_JOINT, JITTER_JOINT, size=n_fingers)
            still = np.zeros((*fingers.shape[:-1], len(joints) - n_fingers))
            joints = joints + np.concatenate([still, fingers], axis=-1)
            joints = np.clip(joints, *self.simulator.joint_limits.T)
        place = np.broadcast_arrays(
            offset[..., 0], offset[..., 1], item.shape.half_size[2]
        )
        usual = tasks.Start(
            joints, np.stack(place, axis=-1), yaw, self.hand.start_targets()
        )
        start = self.task.start(usual, self.palm_skin, item.shape, task_rng)
        return item, start, observer_rng, task_rng

    def step(self, action: Array) -> Step:
        """Take a step by an action (n,): return obs, reward, terminated, truncated and info."""
        if not self._obs:
            raise gym.error.ResetNeeded("step: found before the first reset")
        action = checked(action, self.action_space)
        return self.step_to(self.hand.action_map(action, self.state.targets))

    def step_to(self, targets: Array) -> Step:
        """Take a step towards joint targets (n_actuators,), rad and m, beyond any action if need be."""
        self._steps += 1
        is_last = self._steps >= self.max_episode_steps
        try:
            self.task.before_step(self.simulator, self._steps)
            self.simulator.step(targets, self.config.n_substeps)
            before, self.state = self.state, self.simulator.state()
            self._require_not_ejected(before)
            observation = self._observe()
            achieved, terminated = self.task.after_step(self.state, is_last)
            if not terminated and self.task.is_hold_due(self.state):
                is_held = self.task.hold.run(self.simulator, self.state)
                achieved = self.task.after_hold(achieved, is_held)
                terminated = True
        except SimulationError as error:
            obs = {key: value.copy() for key, value in self._obs.items()}
            info = self._info(diverged=True, error=str(error))
            return obs, 0.0, False, True, info
        self._obs = obs = self._goal_obs(observation, achieved)
        goals = obs["achieved_goal"], obs["desired_goal"]
        reward = self.task.compute_reward(*goals)
        plugins.require_array(reward, (), f"task {self.config.task}: compute_reward")
        info = self._info(is_success=bool(self.task.is_success(*goals)))
        terminated = bool(terminated)
        return obs, float(reward), terminated, is_last and not terminated, info

    def compute_reward(
        self, achieved_goal: Array, desired_goal: Array, info: Any
    ) -> Array:
        """Return the rewards (...) of goals (..., goal_size), by them alone."""
        return self.task.compute_reward(achieved_goal, desired_goal)

    @property
    def shape(self) -> Shape:
        """Shape of the object in this episode."""
        return self._item.shape

    def observation_names(self) -> list[str]:
        """Return what each entry of ``observation`` is, in order."""
        return self._observer.names

    def observation_entries(self, *terms: str) -> Array:
        """Return indices of the newest entries of these terms, or "taxels", in ``observation``."""
        return self._observer.entries(*terms)

    @property
    def side_by_side(self) -> str:
        """Kind of workers in which several of these may be played in at once (`vector.start`)."""
        return "processes" if self.simulator.holds_gil else "threads"

    def taxel_readings(self) -> Array:
        """Return what the taxels feel now, without their faults, (n_taxels,).

        Readings are bool, or N by the touch rule "force".
        """
        return self._touch.read(self.simulator.state())

    def render(self) -> Array | None:
        """Return a picture of the scene, taxels that fire lit, when made with "rgb_array"."""
        if self.render_mode == "rgb_array":
            return self.picture(simulators.Camera())
        return None

    def picture(self, camera: simulators.Camera) -> Array:
        """Return the scene as `camera` sees it, RGB (height, width, 3) uint8."""
        return self.simulator.render(camera, self._spheres())

    def _spheres(self) -> list[Sphere]:
        """Return the taxels, to be drawn."""
        if self.config.touch == "absent":
            return []
        state, radii = self.simulator.state(), self.taxels.radii
        is_on = np.zeros(len(radii), bool)
        if self.config.touch == "on":
            is_on = self._touch.read(state) > 0
        centres = touch.taxel_points(self.taxels).world(state)
        return [
            Sphere(centre, LIT_SCALE * radius, LIT)
            if is_lit
            else Sphere(centre, radius, DARK)
            for centre, radius, is_lit in zip(centres, radii, is_on, strict=True)
        ]

    def close(self) -> None:
        """Release what the simulator holds."""
        self.simulator.close()

    def _require_not_ejected(self, before: State) -> None:
        """Raise SimulationError when an action moved the object too fast.

        The physics can break and stay finite, as when fingers that overlap deeply shoot
        the object out.
        """
        moved = np.linalg.norm(self.state.object_position - before.object_position)
        speed = moved / self.config.control_dt
        if not speed < EJECTED:
            raise SimulationError(f"the object was ejected at {speed:.3g} m/s")

    def _observe(self) -> Array:
        """Return the policy's observation; raise SimulationError when the physics broke."""
        observation = self._observer.observe(self.state).astype(np.float32)
        what = f"touch_rule {self.config.touch_rule}: observation"
        plugins.require_array(observation, self._observer.space.shape, what)
        largest = np.abs(observation).max()
        if not largest < LIMIT:
            raise SimulationError(
                f"an observation is as large as {largest}: the physics broke"
            )
        return observation

    def _info(self, **values: Any) -> dict[str, Any]:
        """Return `info` with all of its keys."""
        n_warnings = 0
        if self._steps:  # the first step tells of a reset's warnings
            before, self._warnings = self._warnings, self.simulator.warnings
            n_warnings = self._warnings - before
        return {
            "is_success": False,
            "object": self._item.describe(),
            "diverged": False,
            "error": "",
            "warnings": n_warnings,
            **values,
        }

    def _goal(self, goal: Array) -> Array:
        """Return a goal that the task returned, float32; raise ValueError where it is none."""
        where, shape = f"task {self.config.task}", (self.task.goal_size,)
        return plugins.require_array(goal, shape, where).astype(np.float32)

    def _goal_obs(self, observation: Array, achieved: Array) -> dict[str, Array]:
        return {
            "observation": observation,
            "achieved_goal": self._goal(achieved),
            "desired_goal": self._desired_goal.copy(),
        }
