"""Do the taxels feel? Scripted, perturbed grasps, and what each layout reports during the hold."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass

import numpy as np

from ..envs import scripted
from ..envs.grasp import GraspConfig, GraspEnv
from ..envs.hands import ScriptedGrasp
from ..envs.simulators import SimulationError

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


Felt = np.ndarray | None
"""In one grasp: bool (hold steps, taxels), or None where the object was not held."""


def examine(hand: str, config: GraspConfig, n: int, seconds: float) -> LayoutFigures:
    """What one layout feels in `n` scripted grasps held for `seconds`, always the same ones.
    Blind is a layout that felt nothing of any."""
    with closing(GraspEnv(hand, config)) as env:
        chosen, names = scripted.grasp_for(env), np.array(env.taxels.names)
        starts = scripted.perturbed_starts(env, SEED, n)
        felt = [_felt(env, chosen, start, seconds) for start in starts]
    held = [bits for bits in felt if bits is not None]
    bits = np.concatenate(held) if held else np.zeros((1, len(names)), bool)
    mean_bits, share_any = (
        float(bits.sum(axis=1).mean()),
        float(bits.any(axis=1).mean()),
    )
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
    )


def _felt(
    env: GraspEnv, grasp: ScriptedGrasp, start: scripted.Offsets, seconds: float
) -> Felt:
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
