"""Play without a policy: open-loop grasps (approach, close, lift, hold), and hands that stand still.

The check of taxels, the pictures and the benchmarks use them when no policy should be
involved.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from .grasp import JITTER_JOINT, GraspEnv
from .hands import ARM, FINGERS, ScriptedGrasp
from .objects import OFFSET, YAW
from .state import Array

# s between targets: the first that is a whole number of timesteps
PERIODS = (0.04, 0.05)
APPROACH, CLOSE, LIFT = 0.4, 0.8, 1.0  # s
LIFT_HEIGHT = 0.15  # m
FALLEN = 0.1  # m below where it was at the beginning of the hold
N_STILL = 4  # episodes in which a hand stands still


class Offsets(NamedTuple):
    """Offsets of a scripted grasp's start from where it was found."""

    place: Array | float = 0.0
    """Offset of the object along x and y, (2,) m."""
    yaw: float = 0.0
    """Turn of the object, rad."""
    joints: Array | float = 0.0
    """Offsets of the joints (n_joints,), rad; the slides' are zero."""


def perturbed_start(env: GraspEnv, seed: int, number: int) -> Offsets:
    """Draw offsets as the environment's jitter would make them, but for the joints' ranges.

    Start `number` of a `seed` is always the same.
    """
    rng = np.random.default_rng([seed, number])
    joints = np.zeros(len(env.hand.joints))
    fingers = joints[FINGERS]
    fingers += rng.uniform(-JITTER_JOINT, JITTER_JOINT, len(fingers))
    place = rng.uniform(-OFFSET, OFFSET, 2)
    return Offsets(place, float(rng.uniform(-YAW, YAW)), joints)


def hold_steps(
    env: GraspEnv,
    grasp: ScriptedGrasp,
    start: Offsets,
    seconds: float,
    dt: float | None = None,
) -> Iterator[bool]:
    """Perform `grasp` on the environment's simulator, and yield whether the object is still up.

    It yields once every `dt` s of the hold. The environment's own episode is not
    involved.
    """
    simulator = env.simulator
    dt = dt or period(env.config.timestep)
    n_substeps = round(dt / env.config.timestep)
    position = np.array([0.0, 0.0, env.shape.half_size[2]])
    position[:2] += start.place
    simulator.reset(env.hand.start_positions() + start.joints, position, start.yaw)
    env.taxel_readings()  # where nothing touches, so that no taxel fires any more
    for targets in chain(*legs(env, grasp, dt)):
        simulator.step(targets, n_substeps)
    floor = simulator.state().object_position[2] - FALLEN
    for _ in range(round(seconds / dt)):
        simulator.step(targets, n_substeps)
        height = simulator.state().object_position[2]
        yield bool(height > max(floor, env.shape.half_size[2] + 0.02))


def period(timestep: float) -> float:
    """Return the time between the targets of a grasp in a scene with this timestep, s."""
    whole = [dt for dt in PERIODS if abs(dt / timestep - round(dt / timestep)) < 1e-6]
    return (whole or PERIODS)[0]


def legs(
    env: GraspEnv, grasp: ScriptedGrasp, dt: float, closing: float = 1.0
) -> tuple[list[Array], list[Array], list[Array]]:
    """Return joint targets (n_actuators,) every `dt` s of approach, closing and lift.

    `closing` is how far the fingers go from their start to where the grasp has them: 1
    is all the way.
    """
    start = env.hand.start_targets()
    starts = zip(env.hand.actuators, start, strict=True)
    closed = np.array([grasp.targets.get(name, value) for name, value in starts])
    closed[FINGERS] += (closing - 1.0) * (closed - start)[FINGERS]
    above = np.concatenate([closed[ARM], start[FINGERS]])
    lifted = closed + LIFT_HEIGHT * np.eye(len(closed))[2]

    def ramp(begin: Array, end: Array, seconds: float) -> list[Array]:
        n = round(seconds / dt)
        return [begin + (end - begin) * k / n for k in range(1, n + 1)]

    approach, close = ramp(start, above, APPROACH), ramp(above, closed, CLOSE)
    return approach, close, ramp(closed, lifted, LIFT)


def grasp_for(env: GraspEnv) -> ScriptedGrasp:
    """Return the hand's scripted grasp nearest to the width of the environment's object.

    Raise ValueError where its file has none.
    """
    if not env.hand.grasps:
        raise ValueError(
            f"hand {env.hand.name}: has no [[grasp]]; tactilerl env --env FILE --check finds one"
        )
    return min(
        env.hand.grasps, key=lambda grasp: abs(grasp.object_size - env.shape.width)
    )


def stand_still(env: Any, number: int, is_wanted: Callable[[], bool]) -> bool:
    """Play an episode of a grasp in which no joint is told to move; return whether it succeeds."""
    grasp, is_over, info = env.unwrapped, False, {}
    grasp.reset(seed=number)
    while not is_over:
        *_, terminated, truncated, info = grasp.step_to(grasp.state.targets)
        is_over = terminated or truncated
    return bool(info.get("is_success", False))


def notes_of_standing_still(play: Callable[..., Iterator[bool]]) -> list[str]:
    """Return a sentence where standing still already reaches the goal, from a few starts."""
    reached = sum(play(stand_still, range(N_STILL)))
    if not reached:
        return []
    return [
        f"a hand that stands still reaches the goal in {reached} of {N_STILL} episodes: success says "
        "little about what is learned (see --goal-height, --goal-tolerance)"
    ]
