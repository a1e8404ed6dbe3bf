"""How many seeds does an effect need? From the spread of a pilot's runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import statistics
from .analysis import SEED, Analysis, SetupResult, pair


@dataclass(frozen=True)
class Need:
    """What one comparison needs."""

    setup: str
    cell: str
    runs: tuple[int, int]
    """Of the pilot, treatment and control."""
    sd: float
    """Of the score within the groups, pooled."""
    seeds: int | None
    """Per group, for the wanted power at `alpha`."""
    seeds_holm: int | None
    """The same when every comparison of the set-up is to stand after Holm: at alpha / comparisons."""
    power: dict[int, float]
    """Of a t test at `alpha`, by seeds per group."""
    simulated: float
    """Of the report's own test with `seeds` seeds (10 where nobody can say how many)."""


AT = (5, 10, 20)  # seeds per group


def plan(
    analysis: Analysis, effect: float, power: float, alpha: float, score: str = "converged"
) -> list[Need]:
    """What each comparison needs to find a difference of `effect` in a score (`analysis.SCORES`)."""
    rng = np.random.default_rng(SEED)
    needs = [
        _need(one, cell, effect, power, alpha, score, rng)
        for one in analysis.setups
        for cell in one.comparisons
    ]
    return [need for need in needs if need is not None]


def _need(
    one: SetupResult,
    cell: str,
    effect: float,
    power: float,
    alpha: float,
    score: str,
    rng: np.random.Generator,
) -> Need | None:
    groups = pair(one, cell)
    scores = [group.scores[score] for group in groups]
    freedom = sum(len(group) - 1 for group in groups)
    squares = sum(float(((s - s.mean()) ** 2).sum()) for s in scores)
    if not freedom:
        return None  # single runs have no spread
    sd, sizes = (squares / freedom) ** 0.5, (len(groups[0]), len(groups[1]))
    seeds = statistics.runs_needed(effect, sd, power, alpha)
    seeds_holm = statistics.runs_needed(effect, sd, power, alpha / len(one.comparisons))
    at = {n: statistics.power_of_t_test(effect, sd, n, alpha) for n in AT}
    n = seeds if seeds and seeds <= 200 else 10
    simulated = statistics.simulated_power(rng, scores[0], scores[1], effect, n, alpha)
    return Need(one.setup.name, cell, sizes, sd, seeds, seeds_holm, at, simulated)
