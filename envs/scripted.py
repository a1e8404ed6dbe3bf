"""Open-loop grasps: approach, close, lift, hold. What the doctor, the pictures and the
benchmarks look at when no policy should be involved."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .grasp import GraspEnv
from .hands import Array, ScriptedGrasp

CONTROL_DT = 0.04  # s between targets
APPROACH, CLOSE, LIFT = 10, 20, 25  # numbers of targets
LIFT_HEIGHT = 0.15  # m
FALLEN = 0.1  # m below where it was at the beginning of the hold
OFFSET, YAW, JOINT = 0.005, 0.15, 0.02  # perturbation: m, rad, rad


@dataclass(frozen=True)
class Start:
    """A perturbed start of a scripted grasp."""

    object_offset: Array
    """(2,) m"""
    yaw: float
    joint_offsets: Array
    """(n_joints,) rad; the slides' are zero."""


def perturbed_start(rng: np.random.Generator, n_joints: int) -> Start:
    """A start as the environment's jitter would make it."""
    joints = np.concatenate([np.zeros(3), rng.uniform(-JOINT, JOINT, n_joints - 3)])
    return Start(rng.uniform(-OFFSET, OFFSET, 2), float(rng.uniform(-YAW, YAW)), joints)


def hold_steps(env: GraspEnv, grasp: ScriptedGrasp, start: Start, seconds: float) -> Iterator[bool]:
    """Perform `grasp` on the environment's simulator and yield once per control step of the
    hold: is the object still up? The environment's own episode is not involved."""
    hand, simulator = env.hand, env.simulator
    n_substeps = round(CONTROL_DT / env.config.timestep)
    position = np.array([*start.object_offset, env.shape.half_size[2]])
    simulator.reset(hand.start_positions() + start.joint_offsets, position, start.yaw)
    for targets in _ramps(hand.start_targets(), grasp, hand.actuators):
        simulator.step(targets, n_substeps)
    floor = simulator.object_state().position[2] - FALLEN
    for _ in range(round(seconds / CONTROL_DT)):
        simulator.step(targets, n_substeps)
        height = simulator.object_state().position[2]
        yield bool(height > max(floor, env.shape.half_size[2] + 0.02))


def _ramps(start: Array, grasp: ScriptedGrasp, actuators: tuple[str, ...]) -> Iterator[Array]:
    closed = np.array(
        [grasp.targets.get(name, value) for name, value in zip(actuators, start, strict=True)]
    )
    above = np.concatenate([closed[:3], start[3:]])
    lifted = closed + LIFT_HEIGHT * np.eye(len(closed))[2]
    legs = ((start, above, APPROACH), (above, closed, CLOSE), (closed, lifted, LIFT))
    for begin, end, n in legs:
        for k in range(1, n + 1):
            yield begin + (end - begin) * k / n


def grasp_for(env: GraspEnv) -> ScriptedGrasp:
    """The hand's scripted grasp nearest to the size of the environment's object."""
    return min(env.hand.grasps, key=lambda g: abs(g.object_size - max(env.config.object_size)))
