"""Grasps to ask: each is a pure function of the settings, a seed and its number.

What is kept of a grasp is the moment before the lift, as poses rather than readings, so that any
layout can be read from it afterwards, and whether the object was held.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np

from ..envs import objects, scripted
from ..envs.grasp import GraspConfig, GraspEnv
from ..envs.hands import Hand
from ..envs.hold import Verdict
from ..envs.simulators import SimulationError
from ..envs.state import KINDS, Array, Kind
from ..envs.vector import IsWanted

Measured = dict[str, Array]
"""What is kept of a grasp, by name; stacked, of many."""
STREAM = 5  # keeps these random numbers apart from those of training and evaluation
HOLD_SECONDS = 2.0
AT_REST = 2e-3  # m that the object would move until the end, at the speed of the last control step


@dataclass(frozen=True)
class Perturbation:
    """How scripted grasps differ from each other; drawn evenly for every grasp."""

    kinds: tuple[Kind, ...]
    sizes: tuple[float, ...]
    """Edge of the cube, diameter (and height) of the sphere and the cylinder, m."""
    frictions: tuple[float, ...]
    offset: float
    """Largest distance of the object from its place along x and y, m."""
    yaw: float
    """Largest turn of the object, rad."""
    closing: tuple[float, float]
    """How far the fingers close: 1 is all the way of the scripted grasp."""
    joint_jitter: float
    """Largest offset of a finger joint at the start, rad, within its range."""

    def variants(self) -> list[dict[str, Any]]:
        """The scene's choices for each object."""
        every = itertools.product(self.kinds, self.sizes, self.frictions)
        return [{"object": k, "object_size": (s,), "friction": f} for k, s, f in every]


class Scenes(gym.Wrapper[Any, Any, Any, Any]):
    """Environments that differ in the object, each made when it is first asked for."""

    def __init__(self, hand: str, config: GraspConfig, variants: list[dict[str, Any]]) -> None:
        self._hand, self._config, self._variants = hand, config, variants
        self._made: dict[int, GraspEnv] = {}
        super().__init__(self.scene(0))

    def scene(self, variant: int) -> GraspEnv:
        """The environment with this object."""
        if variant not in self._made:
            # Where objects start far off, the hand hangs high enough to be free of all of them.
            choices = {**self._variants[variant], "start_offset": objects.FURTHEST}
            self._made[variant] = GraspEnv(self._hand, replace(self._config, **choices))
        return self._made[variant]

    def close(self) -> None:
        for env in self._made.values():
            env.close()


@dataclass(frozen=True)
class ScriptedGrasps:
    """Plays the scripted grasp of a number in `Scenes` of the same variants."""

    perturbation: Perturbation
    seed: int
    verdict: Verdict = "settled"

    def __call__(self, env: gym.Env[Any, Any], number: int, is_wanted: IsWanted) -> Measured:
        """The grasp's record; what it is when the grasp is not wanted any more does not matter."""
        assert isinstance(env, Scenes)
        drawn, rng = self.perturbation, np.random.default_rng([self.seed, STREAM, number])
        scene = env.scene(int(rng.integers(len(drawn.variants()))))
        start = self._start(scene, rng)
        closing = float(rng.uniform(*drawn.closing))
        try:
            return self._play(scene, start, closing, is_wanted)
        except SimulationError:
            return broken(scene)

    def _start(self, env: GraspEnv, rng: np.random.Generator) -> scripted.Offsets:
        drawn, at_rest = self.perturbation, env.hand.start_positions()
        offset = rng.uniform(-drawn.offset, drawn.offset, 2)
        yaw = float(rng.uniform(-drawn.yaw, drawn.yaw))
        joints = at_rest.copy()
        joints[3:] += rng.uniform(-drawn.joint_jitter, drawn.joint_jitter, len(joints) - 3)
        joints = np.clip(joints, *env.simulator.joint_limits.T)
        return scripted.Offsets(offset, yaw, joints - at_rest)

    def _play(
        self, env: GraspEnv, start: scripted.Offsets, closing: float, is_wanted: IsWanted
    ) -> Measured:
        """Approach, close, take the record, lift, hold."""
        dt = scripted.period(env.config.timestep)
        n_substeps = round(dt / env.config.timestep)
        approach, close, lift = scripted.legs(env, scripted.grasp_for(env), dt, closing)
        scripted.place(env, start)
        for targets in (*approach, *close):
            if not is_wanted():
                break
            env.simulator.step(targets, n_substeps)
        record = moment(env)
        for targets in lift:
            env.simulator.step(targets, n_substeps)
        return {**record, "held": np.array(self._holds(env, lift[-1], dt, is_wanted))}

    def _holds(self, env: GraspEnv, targets: Array, dt: float, is_wanted: IsWanted) -> bool:
        """Is the object still up after HOLD_SECONDS? What has fallen stays down; what is at rest
        where nothing creeps stays up."""
        up = env.shape.half_size[2] + scripted.LIFT_HEIGHT / 2
        is_final = self.verdict == "settled" and not env.simulator.creeps
        position, n_looks = _in_hand(env), round(HOLD_SECONDS / dt)
        for left in reversed(range(n_looks)):
            if env.simulator.state().object_position[2] <= up or not is_wanted():
                return False
            env.simulator.step(targets, round(dt / env.config.timestep))
            before, position = position, _in_hand(env)
            if is_final and np.linalg.norm(position - before) * left < AT_REST:
                break
        return bool(env.simulator.state().object_position[2] > up)


def _in_hand(env: GraspEnv) -> Array:
    """The object's position relative to the palm (3,), m."""
    state = env.simulator.state()
    return state.object_position - state.palm


def links_of(hand: Hand) -> tuple[str, ...]:
    """The bodies whose poses are kept: all that may carry taxels, and the palm."""
    return tuple(dict.fromkeys([*(surface.link for surface in hand.surfaces), hand.palm]))


def moment(env: GraspEnv) -> Measured:
    """The state of hand and object now, SI units, world frame, quaternions wxyz."""
    state, record = env.simulator.state(), broken(env)
    for name in ("joint_positions", "joint_velocities", "object_position", "object_orientation"):
        record[name] = getattr(state, name)
    record["link_positions"], record["link_rotations"] = state.poses(links_of(env.hand))
    return {**record, "broken": np.array(False)}


def shapes_of(hand: Hand) -> dict[str, tuple[int, ...]]:
    """Of what a record holds of a hand and an object, by name."""
    n_joints, n_links = len(hand.joints), len(links_of(hand))
    return {
        "joint_positions": (n_joints,),
        "joint_velocities": (n_joints,),
        "link_positions": (n_links, 3),
        "link_rotations": (n_links, 3, 3),
        "object_position": (3,),
        "object_orientation": (4,),
        "object_kind": (),
        "object_half_size": (3,),
    }


def broken(env: GraspEnv) -> Measured:
    """The record of a grasp in which the physics broke: it is counted, and asked nothing."""
    return {
        "held": np.array(False),
        "broken": np.array(True),
        **{name: np.zeros(shape) for name, shape in shapes_of(env.hand).items()},
        "object_kind": np.array(KINDS.index(env.shape.kind)),
        "object_half_size": np.array(env.shape.half_size, dtype=float),
    }


def stack(records: list[Measured]) -> Measured:
    """Records as one, with a leading axis."""
    return {name: np.stack([record[name] for record in records]) for name in records[0]}
