"""Robot hands: what a simulator, a task and a taxel layout need to know about one."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import mujoco

Array = np.ndarray

SLIDES = ("slide_x", "slide_y", "slide_z")
"""Joints and actuators that carry the whole hand along the world's axes."""
DIGITS = ("thumb", "index", "middle", "ring", "little")
"""What digits are called, in order; a hand has those that its ``fingertips`` have."""
SEGMENTS = ("proximal", "middle", "distal")
CLOSING_STEP = 0.5  # how far an action of 1 closes fingers that go from open to closed


@dataclass(frozen=True)
class Surface:
    """The palmar side of one link: where taxels may lie.

    A phalanx is the palmar half of a cylinder, the palm a plane (``radius`` None). All
    vectors are in the link's frame; the grid's origin is ``centre + radius * palmar``.
    """

    digit: str
    """One of DIGITS; for the palm, the finger whose base it is."""
    segment: str
    """One of SEGMENTS, or "palm"."""
    link: str
    """Body the taxels ride on."""
    centre: tuple[float, float, float]
    """Point on the cylinder's axis (on the plane for the palm) under the grid's centre, m."""
    along: tuple[float, float, float]
    """Unit vector towards the fingertip: the direction of a grid's rows."""
    palmar: tuple[float, float, float]
    """Unit outward normal of the palmar side."""
    radius: float | None = None
    """Cylinder radius in m; None for a flat surface."""
    bone: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Both ends of the axis of the capsule that is the link's shape, m; None for a flat surface."""

    def place(self, row: float, column: float) -> Array:
        """Position in the link frame, shape (3,), of a taxel `row` and `column` metres off centre.

        The flat grid is projected on to the cylinder along the palmar normal, so that the
        paper's pitches hold in the plane they are given in. Raises ValueError when the
        column lies beside the cylinder.
        """
        along, palmar = np.array(self.along), np.array(self.palmar)
        across = np.cross(palmar, along)
        if self.radius is None:
            height = 0.0
        elif abs(column) <= self.radius + 1e-9:  # its very edge, in mm, is not exact in m
            height = np.sqrt(max(0.0, self.radius**2 - column**2))
        else:
            raise ValueError(
                f"a taxel {1e3 * abs(column):.1f} mm off the middle of {self.digit}.{self.segment} "
                f"lies beside the phalanx: found |column| {1e3 * abs(column):.1f} mm, "
                f"allowed up to its radius, {1e3 * self.radius:.1f} mm"
            )
        return np.array(self.centre) + row * along + column * across + height * palmar


@dataclass(frozen=True)
class Pitch:
    """Distances between a hand's taxels and their sensing radii, in m (paper, Methods)."""

    rows: dict[str, float]
    """Row distance for each segment."""
    column: float
    """Column distance."""
    radius: float
    """Radius of a taxel of layouts 1-5 and of every palm taxel."""
    large_radius: float
    """Radius of a phalanx taxel of layout 6."""


@dataclass(frozen=True)
class LinearAction:
    """Joint target = centre + action * half_range (paper, MuJoCo set-up; Melnik et al. 2021)."""

    centre: Array
    half_range: Array

    def __call__(self, action: Array, joint_targets: Array) -> Array:
        """New joint targets, shape (n_actuators,), from an action in [-1, 1] of the same shape."""
        return self.centre + action * self.half_range

    def asked(self, joint_targets: Array) -> Array:
        """What each action has asked for last: the targets themselves."""
        return joint_targets


@dataclass(frozen=True)
class ClosingAction:
    """Increments "in relation to the current position and within the limits" (paper, PyBullet
    set-up): the slides move, where they are actions, and groups of joints go along their closing
    trajectories.

    The position is the one last asked for, not the one reached: a finger that the object stops is
    asked for more with each increment and presses the harder, up to its force limit. From the
    position reached, any small step back would let go.
    """

    slide_step: Array
    """(3,) how far an action of 1 moves each slide's target, m; (0,) where no slide is an action."""
    slide_limits: Array
    """(3, 2) lowest and highest target of each slide, m; (0, 2) likewise."""
    closing_step: float
    """How far an action of 1 closes a group; 1 is from open to closed."""
    groups: tuple[Array, ...]
    """For each action after the slides', the actuators that it moves."""
    open: Array
    """(n_actuators,) targets at the open end."""
    closed: Array
    """(n_actuators,) targets at the closed end."""

    def __call__(self, action: Array, joint_targets: Array) -> Array:
        """New joint targets (n_actuators,) from an action (slides, then groups) in [-1, 1]."""
        targets, n_slides = joint_targets.copy(), len(self.slide_step)
        moved = targets[:n_slides] + self.slide_step * action[:n_slides]
        targets[:n_slides] = np.clip(moved, self.slide_limits[:, 0], self.slide_limits[:, 1])
        _, members, group = self._indices
        closing = np.clip(self._closing(targets) + self.closing_step * action[n_slides:], 0.0, 1.0)
        targets[members] = self.open[members] + closing[group] * (self.closed - self.open)[members]
        return targets

    def asked(self, joint_targets: Array) -> Array:
        """What each action has asked for last: the slides' targets, m, and how far each group is to be
        closed."""
        return np.concatenate([joint_targets[: len(self.slide_step)], self._closing(joint_targets)])

    def _closing(self, targets: Array) -> Array:
        first, way = self._indices[0], self.closed - self.open
        return np.asarray((targets[first] - self.open[first]) / way[first])

    @cached_property
    def _indices(self) -> tuple[Array, Array, Array]:
        """The first actuator of each group that moves; all in groups; and the group of each."""
        sizes, way = [len(group) for group in self.groups], self.closed - self.open
        first = np.array([group[way[group] != 0][0] for group in self.groups])
        return first, np.concatenate(self.groups), np.repeat(np.arange(len(sizes)), sizes)


@dataclass(frozen=True)
class ScriptedGrasp:
    """An open-loop grasp found by search."""

    object_size: float
    """Edge of the cube it was found for, m."""
    targets: dict[str, float]
    """Joint targets by actuator name, rad or m."""


@dataclass(frozen=True)
class Hand:
    """One hand, palm down above the origin of the world.

    The first three joints and actuators are the slides of the whole hand along the world's
    x, y and z axes, in m, zero where the hand starts over an object no wider than ``start_clearance``.
    """

    name: str
    build: Callable[[bool, float], mujoco.MjSpec]
    """(with visual meshes?, gain of the finger actuators relative to the model's) -> model
    of the hand alone: no ground, no object, no taxels."""
    joints: tuple[str, ...]
    """Joints in the order of the observation."""
    actuators: tuple[str, ...]
    """Actuators in the order of joint targets; each drives the joint of ``actuated``."""
    actuated: tuple[str, ...]
    palm: str
    """Body whose ``palm_point`` is "the hand" in rewards."""
    palm_point: tuple[float, float, float]
    fingertips: tuple[tuple[str, tuple[float, float, float]], ...]
    """Body and point (m, body frame) of the tip of each digit it has, in the order of DIGITS."""
    surfaces: tuple[Surface, ...]
    pitch: Pitch
    action_map: LinearAction | ClosingAction
    action_names: tuple[str, ...]
    couplings: tuple[tuple[str, str, float], ...] = ()
    """(joint, actuated joint, ratio): the first moves with the second, by a tendon where there
    are tendons."""
    first_joints: tuple[str, ...] = ()
    """The joint that stands for each digit in the observation term "finger_joints"."""
    start: dict[str, float] = field(default_factory=dict)
    """Joint positions at reset that are not zero, rad or m."""
    observation: tuple[str, ...] = ()
    """Names of the observation's terms, in order (`GraspEnv.observation_names`)."""
    start_clearance: float = 0.05
    """Edge of the largest cube that lies free of the hand at the start, m. Over what is higher the
    hand hangs higher; over what is wider it starts further up its slide (`start_above`)."""
    added_inertia: float = 1e-4
    """Rotational inertia that every link gets in Bullet, kg m²: the solver needs it, and the value
    is the one that comes nearest to small timesteps (docs/appendix/physics_settings.md)."""
    grasps: tuple[ScriptedGrasp, ...] = ()
    opened: dict[str, float] = field(default_factory=dict)
    """Targets by actuator of the open hand, from where fingers that close in groups set off, rad."""
    closed: dict[str, float] = field(default_factory=dict)
    """Targets of the same actuators where the hand is closed, rad."""
    groups: tuple[tuple[str, ...], ...] = ()
    """The actuators that close together, each in one group."""
    group_names: tuple[str, ...] = ()
    handed_beside: tuple[str, ...] = ()
    """Fingers at whose bases no object is handed over: it comes to the middle of the others'."""

    def closing_from(self, start: float, actions: str) -> Hand:
        """The hand with its slides standing still and fingers that close and open again, from where
        they are `start` of the way from open to closed: all by one action ("grip") or group by group
        ("fingers")."""
        opened, closed = (
            np.array([ends.get(name, self.start.get(joint, 0.0)) for name, joint in self._driven])
            for ends in (self.opened, self.closed)
        )
        opened += start * (closed - opened)
        members = [np.array([self.actuators.index(name) for name in group]) for group in self.groups]
        pose = dict(zip(self.actuated, opened.tolist(), strict=True))
        pose |= {joint: ratio * pose[driver] for joint, driver, ratio in self.couplings}
        is_grip = actions == "grip"
        return replace(
            self,
            action_map=ClosingAction(
                slide_step=np.zeros(0),
                slide_limits=np.zeros((0, 2)),
                closing_step=CLOSING_STEP,
                groups=(np.concatenate(members),) if is_grip else tuple(members),
                open=opened,
                closed=closed,
            ),
            action_names=("closing of the hand",) if is_grip else self.group_names,
            start={joint: angle for joint, angle in pose.items() if angle},
        )

    @property
    def _driven(self) -> list[tuple[str, str]]:
        return list(zip(self.actuators, self.actuated, strict=True))

    def start_above(self, width: float, height: float) -> Hand:
        """The hand as it starts over an object of these measures, m.

        What is wider than `start_clearance` does not lie free between the fingers. Nothing of the
        hand is below the ground at the start, so raised by the object's height it is free of the
        object. The part of that above `start_clearance` is in how high the hand hangs, whatever the
        width.
        """
        if width <= self.start_clearance:
            return self
        return replace(self, start={**self.start, SLIDES[2]: min(height, self.start_clearance)})

    def start_positions(self) -> Array:
        """Joint positions at reset in the order of ``joints``, shape (n_joints,)."""
        return np.array([self.start.get(joint, 0.0) for joint in self.joints])

    def start_targets(self) -> Array:
        """Joint targets that hold the start pose, shape (n_actuators,)."""
        return np.array([self.start.get(joint, 0.0) for joint in self.actuated])


@dataclass(frozen=True)
class Registration:
    """A hand that can be asked for by name; its module of that name has a function ``hand``."""

    id: str
    """Of its environment in Gymnasium's registry; by name it is `make(name)`."""
    scene: dict[str, Any] = field(default_factory=dict)
    """What its scene says differently from the defaults of `GraspConfig`."""
    closing: tuple[float, float] = (0.5, 0.9)
    """How far the fingers of perturbed scripted grasps close, from and to, 1 being all the way: 30
    to 70 % of `tactilerl probe`'s grasps then hold in either simulator."""


HANDS = {
    "shadow": Registration("tactilerl/Shadow-v0"),
    "mpl": Registration(
        "tactilerl/MPL-v0",
        {
            "simulator": "pybullet",
            "object_density": 800.0,
            "timestep": 1 / 240,
            "control_dt": 0.1,
            "hold_seconds": 5000 / 240,
        },
        closing=(0.8, 1.1),
    ),
    "allegro": Registration("tactilerl/Allegro-v0"),
}


def get(name: str) -> Hand:
    """The hand called `name`; its model is read from disk only when it is built."""
    if name not in HANDS:
        raise ValueError(f"unknown hand {name!r}; allowed: {', '.join(HANDS)}")
    hand: Hand = importlib.import_module(f".{name}", __name__).hand()
    return hand
