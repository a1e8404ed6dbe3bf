"""Do the taxels feel? Scripted, perturbed grasps, and what each layout reports during the hold."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np

from ..envs import scripted
from ..envs.grasp import GraspConfig, GraspEnv
from ..envs.hands import ScriptedGrasp
from ..envs.simulators import SIMULATORS, SimulationError

SEED = 20_000  # apart from any seed of a training run or of the search for the grasps


@dataclass(frozen=True)
class LayoutFigures:
    """What one layout felt in the grasps that held."""

    layout: str
    taxels: int
    grasps: int
    held: int
    mean_bits: float
    """Taxels on, mean over the hold steps."""
    share_any: float
    """Share of hold steps with at least one taxel on."""
    never_fired: tuple[str, ...]
    is_blind: bool
    agreement: float | None = None
    """With the other simulator, if compared: see `agreement`."""


def examine(
    env_name: str,
    config: GraspConfig,
    grasps: int,
    seconds: float,
    compare: bool = False,
    grasp: ScriptedGrasp | None = None,
) -> LayoutFigures:
    """What one layout feels in `grasps` scripted grasps held for `seconds`; with `compare`, also
    whether the other simulator agrees. `grasp`: instead of the hand's own."""
    holds = record(env_name, config, grasps, seconds, grasp)
    result = figures(holds)
    if not compare:
        return result
    other = replace(config, simulator=next(s for s in SIMULATORS if s != config.simulator))
    return replace(result, agreement=agreement(holds, record(env_name, other, grasps, seconds, grasp)))


@dataclass(frozen=True)
class Holds:
    """Readings of one layout in perturbed scripted grasps."""

    layout: str
    taxels: tuple[str, ...]
    readings: tuple[np.ndarray | None, ...]
    """Of each grasp: bool (hold steps, taxels), or None where the object was not held."""


def record(
    env_name: str,
    config: GraspConfig,
    grasps: int,
    seconds: float,
    grasp: ScriptedGrasp | None = None,
) -> Holds:
    """Run `grasps` scripted grasps held for `seconds`; always the same ones."""
    with closing(GraspEnv(env_name, config)) as env:
        starts = scripted.perturbed_starts(env, SEED, grasps)
        chosen = grasp or scripted.grasp_for(env)
        readings = tuple(_felt(env, chosen, start, seconds) for start in starts)
        return Holds(config.layout, env.taxels.names, readings)


def agreement(a: Holds, b: Holds) -> float | None:
    """How alike two simulators feel the same grasps: of what fires in one or the other, the share
    that fires in both. None where none of the grasps held, or nothing fired, in both.

    A taxel fires for a share of a hold's steps; the sums of the smaller and of the larger of the
    two shares, over taxels and grasps, are divided (weighted Jaccard index).
    """
    pairs = zip(a.readings, b.readings, strict=True)
    shares = [(x.mean(axis=0), y.mean(axis=0)) for x, y in pairs if x is not None and y is not None]
    either = sum(float(np.maximum(x, y).sum()) for x, y in shares)
    both = sum(float(np.minimum(x, y).sum()) for x, y in shares)
    return both / either if either else None


def _felt(
    env: GraspEnv, grasp: ScriptedGrasp, start: scripted.Start, seconds: float
) -> np.ndarray | None:
    """Readings at each control step of one hold; None when the object was not held."""
    felt = []
    try:
        for is_up in scripted.hold_steps(env, grasp, start, seconds):
            if not is_up:
                return None
            felt.append(env.taxel_readings())
    except SimulationError:
        return None
    return np.array(felt, bool)


def figures(holds: Holds) -> LayoutFigures:
    """What the layout felt in the grasps that held; blind when it felt nothing of any."""
    held = [bits for bits in holds.readings if bits is not None]
    bits = np.concatenate([np.zeros((0, len(holds.taxels)), bool), *held])
    mean_bits, share_any = (
        float(of_step.mean()) if held else 0.0 for of_step in (bits.sum(axis=1), bits.any(axis=1))
    )
    # The densest layout must feel more than the others.
    needed_share, needed_bits = (0.9, 3.0) if holds.layout == "1" else (0.5, 0.0)
    return LayoutFigures(
        holds.layout, len(holds.taxels), len(holds.readings), len(held), mean_bits, share_any,
        never_fired=tuple(np.array(holds.taxels)[~bits.any(axis=0)].tolist()),
        is_blind=share_any < needed_share or mean_bits < needed_bits,
    )  # fmt: skip
