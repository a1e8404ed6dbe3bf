"""Find the taxels that can fire while an object is held in scripted, perturbed grasps."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from dataclasses import dataclass

import numpy as np

from ..envs import scripted
from ..envs.grasp import GraspConfig, GraspEnv
from ..envs.hands import ScriptedGrasp
from ..envs.simulators import SimulationError
from ..envs.state import Array

SEED = 20_000  # apart from any seed of a training run or of the search for the grasps
MIN_SHARE = 0.5  # of the time of holds in which some taxel must fire
GRASPS, SECONDS = 20, 3.0
"""Number of grasps that are played, each slightly different, and seconds for which each
is held."""


@dataclass(frozen=True)
class TaxelCheck:
    """Taxels of a scene that fired, and how often, in the grasps that held."""

    grasps: int
    """Number of grasps that were played."""
    held: int
    """Number of grasps in which the object was held."""
    mean_fired: float
    """Number of taxels that fire, mean over the steps of the holds."""
    share_any: float
    """Share of these steps in which at least one taxel fires."""
    fired: tuple[str, ...]
    """Names of the taxels that fired at any time."""
    never_fired: tuple[str, ...]
    """Names of the others."""

    @property
    def is_useful(self) -> bool:
        """True if all grasps hold, and taxels fire in at least half of the time."""
        return self.held == self.grasps and self.share_any >= MIN_SHARE

    def silent(self) -> list[str]:
        """Name each segment with taxels that never fired, and how many of them where some did."""
        fired, never = (
            Counter(map(_segment, self.fired)),
            Counter(map(_segment, self.never_fired)),
        )
        return [
            segment + (f" ({n} of {n + fired[segment]})" if fired[segment] else "")
            for segment, n in never.items()
        ]


def _segment(name: str) -> str:
    """Return the digit's segment that a taxel is on."""
    return name.partition("[")[0]


def check(
    hand: str, config: GraspConfig, n: int = GRASPS, seconds: float = SECONDS
) -> TaxelCheck:
    """Play `n` scripted grasps, always the same ones, held for `seconds`, and return what taxels felt.

    Raise ValueError where the hand has no grasp, or its object is handed over.
    """
    with closing(GraspEnv(hand, config)) as env:
        if env.task.giver is not None:
            raise ValueError(
                f"task: found {config.task}, allowed tasks whose object lies on the ground; "
                "`tactilerl gate` says what touch can win in a handover"
            )
        grasp, names = scripted.grasp_for(env), np.array(env.taxels.names)
        holds = [_readings(env, grasp, number, seconds) for number in range(n)]
    n_held = sum(len(readings) > 0 for readings in holds)
    readings = np.concatenate(holds)
    n_steps, has_fired = max(1, len(readings)), readings.any(axis=0)
    return TaxelCheck(
        grasps=n,
        held=n_held,
        mean_fired=float(readings.sum() / n_steps),
        share_any=float(readings.any(axis=1).sum() / n_steps),
        fired=tuple(names[has_fired].tolist()),
        never_fired=tuple(names[~has_fired].tolist()),
    )


def _readings(
    env: GraspEnv, grasp: ScriptedGrasp, number: int, seconds: float
) -> Array:
    """Return readings (hold steps, taxels), bool, of one hold; no step if the object was not held."""
    start = scripted.perturbed_start(env, SEED, number)
    nothing = np.zeros((0, len(env.taxels)), bool)
    readings = []
    try:
        for is_up in scripted.hold_steps(env, grasp, start, seconds):
            if not is_up:
                return nothing
            readings.append(env.taxel_readings() > 0)
    except SimulationError:
        return nothing
    return np.array(readings)
