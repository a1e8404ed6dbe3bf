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


Felt = np.ndarray | None
"""In one grasp: bool (hold steps, taxels), or None where the object was not held."""


def examine(
    hand: str, config: GraspConfig, grasp: ScriptedGrasp | None, n: int, seconds: float, compare: bool
) -> LayoutFigures:
    """What one layout feels in `n` scripted grasps held for `seconds`, always the same ones; with
    `compare`, also whether the other simulator agrees. `grasp`: instead of the hand's own. Blind is a
    layout that felt nothing of any."""
    felt = []
    simulators = [config.simulator]
    simulators += [next(name for name in SIMULATORS if name != config.simulator)] if compare else []
    for simulator in simulators:
        with closing(GraspEnv(hand, replace(config, simulator=simulator))) as env:
            chosen, names = grasp or scripted.grasp_for(env), np.array(env.taxels.names)
            starts = scripted.perturbed_starts(env, SEED, n)
            felt.append([_felt(env, chosen, start, seconds) for start in starts])
    held = [bits for bits in felt[0] if bits is not None]
    bits = np.concatenate(held) if held else np.zeros((1, len(names)), bool)
    mean_bits, share_any = float(bits.sum(axis=1).mean()), float(bits.any(axis=1).mean())
    # The densest layout must feel more than the others.
    needed_share, needed_bits = (0.9, 3.0) if config.layout == "1" else (0.5, 0.0)
    return LayoutFigures(
        layout=config.layout,
        taxels=len(names),
        grasps=n,
        held=len(held),
        mean_bits=mean_bits,
        share_any=share_any,
        never_fired=tuple(names[~bits.any(axis=0)].tolist()),
        is_blind=share_any < needed_share or mean_bits < needed_bits,
        agreement=agreement(*felt) if compare else None,
    )


def agreement(a: list[Felt], b: list[Felt]) -> float | None:
    """How alike two simulators feel the same grasps: of what fires in one or the other, the share
    that fires in both. None where none of the grasps held, or nothing fired, in both.

    A taxel fires for a share of a hold's steps; the sums of the smaller and of the larger of the
    two shares, over taxels and grasps, are divided (weighted Jaccard index).
    """
    pairs = zip(a, b, strict=True)
    shares = [(x.mean(axis=0), y.mean(axis=0)) for x, y in pairs if x is not None and y is not None]
    either = sum(float(np.maximum(x, y).sum()) for x, y in shares)
    both = sum(float(np.minimum(x, y).sum()) for x, y in shares)
    return both / either if either else None


def _felt(env: GraspEnv, grasp: ScriptedGrasp, start: scripted.Offsets, seconds: float) -> Felt:
    """At each control step of one hold."""
    felt = []
    try:
        for is_up in scripted.hold_steps(env, grasp, start, seconds):
            if not is_up:
                return None
            felt.append(env.taxel_readings())
    except SimulationError:
        return None
    return np.array(felt, bool)
