"""Do the taxels feel? Scripted, perturbed grasps, and what each layout reports during the hold."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from .envs import layouts, scripted
from .envs.grasp import GraspConfig, GraspEnv
from .envs.simulators import SimulationError

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

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)


def examine(env_name: str, config: GraspConfig, grasps: int, seconds: float) -> LayoutFigures:
    """Run `grasps` scripted grasps held for `seconds` and count what the layout feels."""
    env = GraspEnv(env_name, config)
    try:
        readings, held = [], 0
        for index in range(grasps):
            rng = np.random.default_rng([SEED, index])
            start = scripted.perturbed_start(rng, len(env.hand.joints))
            felt = _felt(env, start, seconds)
            if felt is not None:
                held += 1
                readings += felt
        bits = np.array(readings).reshape(-1, len(env.taxels))
        return _figures(config.layout, env.taxels, grasps, held, bits)
    finally:
        env.close()


def _felt(env: GraspEnv, start: scripted.Start, seconds: float) -> list[np.ndarray] | None:
    """Readings at each control step of one hold; None when the object was not held."""
    felt = []
    try:
        for is_up in scripted.hold_steps(env, scripted.grasp_for(env), start, seconds):
            if not is_up:
                return None
            felt.append(env.taxel_readings())
    except SimulationError:
        return None
    return felt


def _figures(
    name: str, taxels: layouts.Taxels, grasps: int, held: int, bits: np.ndarray
) -> LayoutFigures:
    if not len(bits):
        return LayoutFigures(name, len(taxels), grasps, held, 0.0, 0.0, taxels.names, True)
    share_any = float(bits.any(axis=1).mean())
    dense = name == "1"  # the densest layout must feel more than the others
    needed_share, needed_bits = (0.9, 3.0) if dense else (0.5, 0.0)
    mean_bits = float(bits.sum(axis=1).mean())
    return LayoutFigures(
        layout=name,
        taxels=len(taxels),
        grasps=grasps,
        held=held,
        mean_bits=mean_bits,
        share_any=share_any,
        never_fired=tuple(np.array(taxels.names)[~bits.any(axis=0)].tolist()),
        is_blind=share_any < needed_share or mean_bits < needed_bits,
    )
