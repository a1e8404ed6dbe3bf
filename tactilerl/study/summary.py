"""A study's results in sentences: what was compared, the answer, and what a reader must know first."""

from __future__ import annotations

from collections import Counter
from typing import Any

from ..machine import short
from ..statistics import FEW_RUNS, fewest_pairs
from ..style import NAMES
from .analysis import Analysis, SetupResult
from .grid import Setup
from .pairs import ALPHA, Verdict
from .records import Record

RATES = {
    "success_rate": "success rate of the training episodes",
    "test_success_rate": "success rate of the tests",
}
MEANS = {
    "area": "mean success",
    "final": "final success",
    "converged": "converged success",
}
"""Scores as sentences have them."""


def subject(result: SetupResult) -> str:
    """Return the hand, simulator and learner: `MPL hand in PyBullet, PPO`."""
    config = result.config
    if not config:
        return result.setup.name
    env, learner = (
        NAMES.get(config["run"][name], config["run"][name]) for name in ("env", "algo")
    )
    simulator = (config.get("scene") or {}).get("simulator")
    where = f" in {NAMES.get(simulator, simulator)}" if simulator else ""
    return f"{env}{where}, {learner}"


def about(result: SetupResult, score: str) -> str:
    """Return what was compared, in a sentence or two."""
    scene, setup = result.config.get("scene") or {}, result.setup
    seen = scene.get("object_seen", "exact")
    length = result.config.get("run", {}).get("total_timesteps")
    parts = [
        subject(result),
        scene.get("task"),
        "" if seen == "exact" else f"object {seen}",
        f"{length:,} steps a run" if length else "",
    ]
    sentence = f"{setup.name}: {', '.join(filter(None, parts))}."
    if setup.compare is None:
        return sentence
    treatment, control = map(setup.label, setup.groups[:2])
    return (
        f"{sentence} Compares {treatment} with {control}, in pairs of runs with the same seed, by "
        f"{MEANS[score]} ({RATES[setup.measure]})."
    )


def provenance(records: list[Record]) -> str:
    """Return how many runs are done, of which commits."""
    done = sum(record.state == "done" for record in records)
    commits = Counter(
        short(record.config["provenance"][-1]["commit"])
        for record in records
        if record.config.get("provenance")
    )
    by = " and ".join(f"{n} of commit {commit}" for commit, n in commits.most_common())
    return f"{done} of {len(records)} runs are done{f': {by}' if by else ''}."


def plural(n: int, noun: str) -> str:
    """Return `1 pair` or `2 pairs`."""
    return f"{n} {noun}{'' if n == 1 else 's'}"


def _signed(value: float) -> str:
    return f"{round(value, 2) + 0.0:+.2f}".replace("-", "−")


def answer(setup: Setup, verdict: Verdict, score: str) -> str:
    """Return the primary comparison of a setting in a sentence, with its interval."""
    pairs, p = verdict.pairs, verdict.p_holm
    treatment, control = map(setup.label, setup.groups[:2])
    fewest = fewest_pairs(ALPHA / len(setup.settings))
    if verdict.is_difference:
        verb = "raised" if pairs.difference.value > 0 else "lowered"
        found = f"{treatment} {verb} {MEANS[score]}"
    elif len(pairs) < fewest:
        found = f"too few runs to find a difference, which takes {fewest} pairs"
    else:
        found = f"no significant difference in {MEANS[score]}"
    value, low, high = map(_signed, pairs.difference)
    chance = "p < 0.001" if p < 0.001 else f"p = {p:.3f}"
    return (
        f"{setup.name}, {verdict.setting}: {found} ({treatment} − {control}: {value}, 95 % interval "
        f"{low} to {high}, {chance}, {len(pairs)} of {verdict.n_seeds} pairs)."
    )


def answers(analysis: Analysis) -> list[str]:
    """Return every comparison's answer."""
    score = analysis.study.primary.score
    return [
        answer(result.setup, verdict, score)
        for result in analysis.setups
        for verdict in result.verdicts.values()
    ]


def made_with(config: dict[str, Any]) -> set[tuple[str, str]]:
    """Return (package, version) of all that could change what a run came to.

    MPI does nothing for a single process, nor one simulator in a scene of the other.
    """
    origins = config.get("provenance", [])
    simulator = (config.get("scene") or {}).get("simulator")
    idle = {"mujoco", "pybullet"} - {simulator} if simulator else set()
    idle |= {"mpi4py"} if config.get("ranks", 1) == 1 else set()
    commits = {("commit", str(one["commit"])) for one in origins}
    versions = commits.union(*(one["versions"].items() for one in origins))
    return {(name, version) for name, version in versions if name not in idle}


def warnings(analysis: Analysis) -> list[str]:
    """Return what a reader must know before believing the numbers."""
    notes = []
    states = Counter(record.state for record in analysis.records)
    missing = [f"{n} {state}" for state, n in sorted(states.items()) if state != "done"]
    if missing:
        n_runs = len(analysis.records)
        notes.append(f"Of {n_runs} runs {', '.join(missing)}: they are in no figure.")
    groups = [group for one in analysis.setups for group in one.groups.values()]
    fewest = min(map(len, groups), default=FEW_RUNS)
    if fewest < FEW_RUNS:
        notes.append(
            f"The smallest group has {plural(fewest, 'run')}. Bands of learning curves of fewer than "
            f"{FEW_RUNS} runs are too narrow: they contain the truth less often than they say."
        )
    for one in analysis.setups:
        name = one.setup.name
        made = {frozenset(made_with(r.config)) for r in one.records if r.config}
        if not one.groups:
            notes.append(f"{name}: no finished run with a {one.setup.measure}.")
        if len(made) > 1:
            notes.append(
                f"{name}: versions or commits differ between runs, and could change results: see "
                "Versions."
            )
    diverged = sum(record.diverged > 0 for record in analysis.records)
    if diverged:
        notes.append(f"Episodes diverged in {plural(diverged, 'run')}: see Runs.")
    return notes
