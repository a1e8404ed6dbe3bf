"""Grasps to ask: each is a pure function of the settings, a seed and its number.

What is kept of a grasp is the moment before the lift, as poses rather than readings, so that any
layout can be read from it afterwards, and whether the object was held.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np

from ..envs import objects, scripted
from ..envs.grasp import GraspEnv
from ..envs.hands import Hand
from ..envs.simulators import SimulationError
from ..envs.state import KINDS, Array
from ..envs.vector import IsWanted
from .options import GraspFlags

Measured = dict[str, Array]
"""What is kept of a grasp, by name; stacked, of many."""
STREAM = 5  # keeps these random numbers apart from those of training and evaluation
HOLD_SECONDS = 2.0
AT_REST = 2e-3  # m that the object would move until the end, at the speed of the last control step


class Scenes(gym.Wrapper[Any, Any, Any, Any]):
    """The environments of some grasps, which differ in the object; each is made when it is first asked
    for."""

    def __init__(self, grasps: GraspFlags) -> None:
        self.grasps, self.configs = grasps, grasps.scenes()
        self._made: dict[int, GraspEnv] = {}
        super().__init__(self.scene(0))

    def scene(self, variant: int) -> GraspEnv:
        """The environment with this object."""
        if variant not in self._made:
            # Where objects start far off, the hand hangs high enough to be free of all of them.
            config = replace(self.configs[variant], start_offset=objects.FURTHEST)
            self._made[variant] = GraspEnv(self.grasps.env, config)
        return self._made[variant]

    def close(self) -> None:
        for env in self._made.values():
            env.close()


def play(
    env: gym.Env[Any, Any], number: int, is_wanted: IsWanted = lambda: True
) -> Measured:
    """Play the scripted grasp of a number in `Scenes`: its record; what it is when the grasp is not
    wanted any more does not matter."""
    assert isinstance(env, Scenes)
    grasps, rng = env.grasps, np.random.default_rng([env.grasps.seed, STREAM, number])
    scene = env.scene(int(rng.integers(len(env.configs))))
    start = drawn_start(grasps, scene, rng)
    closing = float(rng.uniform(*grasps.closes))
    try:
        return _play(scene, start, closing, grasps.hold_verdict == "settled", is_wanted)
    except SimulationError:
        return broken(scene)


def drawn_start(
    grasps: GraspFlags, env: GraspEnv, rng: np.random.Generator
) -> scripted.Offsets:
    """Where a grasp starts, joints within their ranges."""
    at_rest = env.hand.start_positions()
    offset = rng.uniform(-grasps.start_offset, grasps.start_offset, 2)
    yaw = float(rng.uniform(-grasps.start_yaw, grasps.start_yaw))
    joints = at_rest.copy()
    joints[3:] += rng.uniform(
        -grasps.joint_jitter, grasps.joint_jitter, len(joints) - 3
    )
    joints = np.clip(joints, *env.simulator.joint_limits.T)
    return scripted.Offsets(offset, yaw, joints - at_rest)


def _play(
    env: GraspEnv,
    start: scripted.Offsets,
    closing: float,
    may_settle: bool,
    is_wanted: IsWanted,
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
    return {
        **record,
        "held": np.array(_holds(env, lift[-1], dt, may_settle, is_wanted)),
    }


def _holds(
    env: GraspEnv, targets: Array, dt: float, may_settle: bool, is_wanted: IsWanted
) -> bool:
    """Is the object still up after HOLD_SECONDS? What has fallen stays down; what is at rest where
    nothing creeps stays up, if it `may_settle`."""
    up = env.shape.half_size[2] + scripted.LIFT_HEIGHT / 2
    is_final = may_settle and not env.simulator.creeps
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
    return tuple(
        dict.fromkeys([*(surface.link for surface in hand.surfaces), hand.palm])
    )


def moment(env: GraspEnv) -> Measured:
    """The state of hand and object now, SI units, world frame, quaternions wxyz."""
    state, record = env.simulator.state(), broken(env)
    for name in (
        "joint_positions",
        "joint_velocities",
        "object_position",
        "object_orientation",
    ):
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
