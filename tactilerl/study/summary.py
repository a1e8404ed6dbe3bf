"""What came out, in words: what was compared, the answer, and what a reader must know first."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

from .. import statistics
from ..machine import short
from ..statistics import FEW_RUNS, Estimate
from ..style import NAMES
from .analysis import Analysis, SetupResult
from .grid import Setup
from .records import Record
from .verdicts import LEAST_ROOM, Headroom, Verdict

STILL_RISING = 0.1  # final over converged rate, which then misses what the runs can do
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
ENDINGS = {
    "": "the study goes on",
    "difference": "stopped for a difference",
    "no difference": "stopped, for a difference that matters is ruled out",
    "last look": "all runs are done",
}


def subject(one: SetupResult) -> str:
    """Hand, simulator and learner: `MPL hand in PyBullet, PPO`."""
    config = one.config
    if not config:
        return one.setup.name
    env, learner = (
        NAMES.get(config["run"][name], config["run"][name]) for name in ("env", "algo")
    )
    simulator = (config.get("scene") or {}).get("simulator")
    where = f" in {NAMES.get(simulator, simulator)}" if simulator else ""
    return f"{env}{where}, {learner}"


def about(one: SetupResult, score: str) -> str:
    """What was compared, in a sentence or two."""
    scene = one.config.get("scene") or {}
    seen = (
        ""
        if scene.get("object_seen", "exact") == "exact"
        else f"object {scene['object_seen']}"
    )
    length = one.config.get("run", {}).get("total_timesteps")
    steps = f"{length:,} steps a run" if length else ""
    parts = [part for part in (subject(one), scene.get("task"), seen, steps) if part]
    said = f"{one.setup.name}: {', '.join(parts)}."
    if one.setup.compare is None:
        return said
    first, second = map(one.setup.label, one.setup.arms[:2])
    return (
        f"{said} Compares {first} with {second}, in pairs of runs with the same seed, by "
        f"{MEANS[score]} ({RATES[one.setup.measure]})."
    )


def provenance(records: list[Record]) -> str:
    """How many runs of which commit."""
    done = sum(record.state == "done" for record in records)
    commits = Counter(
        short(record.config["provenance"][-1]["commit"])
        for record in records
        if record.config and record.config.get("provenance")
    )
    by = " and ".join(f"{n} of commit {commit}" for commit, n in commits.most_common(3))
    more = f" and {len(commits) - 3} others" if len(commits) > 3 else ""
    return f"{done} of {len(records)} runs are done{f': {by}{more}' if by else ''}."


def plural(n: int, what: str) -> str:
    """`1 pair`, `2 pairs`"""
    return f"{n} {what}{'' if n == 1 else 's'}"


def signed(value: float) -> str:
    """With its sign."""
    return (
        "–" if math.isnan(value) else f"{round(value, 2) + 0.0:+.2f}".replace("-", "−")
    )


def ranging(estimate: Estimate) -> str:
    """`+0.05 (−0.02 to +0.12)`"""
    return (
        f"{signed(estimate.value)} ({signed(estimate.low)} to {signed(estimate.high)})"
    )


def answer(setup: Setup, verdict: Verdict, score: str) -> str:
    """The primary comparison of a cell in a sentence or two, with its interval."""
    where, found, stage = (
        _place(setup, verdict.cell),
        verdict.pairs.difference,
        verdict.stage,
    )
    missing = verdict.n_seeds - len(verdict.pairs)
    if not len(verdict.pairs):
        return f"{where}: no seed has both runs yet."
    pairs = plural(len(verdict.pairs), "pair")
    pairs = f"{len(verdict.pairs)} of {verdict.n_seeds} pairs" if missing else pairs
    first, second = map(setup.label, setup.arms[:2])
    gap = f"{first} − {second} in {MEANS[score]}: {ranging(found)}"
    if stage and not stage.look:
        return f"{where}: {gap}, {pairs}; the first look is still to come."
    p = verdict.pairs.p_value if verdict.valid_p == 1 else verdict.p_holm
    told = (
        pairs
        if math.isnan(p)
        else f"p {'< 0.001' if p < 0.001 else f'= {p:.3f}'}, {pairs}"
    )
    look = (
        f" Look {stage.look} of {stage.of}: {ENDINGS[stage.ending]}." if stage else ""
    )
    if verdict.is_difference:
        is_higher = found.value > 0
        bounds = found[1:] if is_higher else (-found.high, -found.low)
        low, high = (f"{bound:.2f}".replace("-", "−") for bound in bounds)
        change = f"{'raised' if is_higher else 'lowered'} {MEANS[score]}"
        numbers = f"{abs(found.value):.2f} ({low} to {high}; {told})"
        other = "" if setup.is_touch else f" against {second}"
        return f"{where}: {first[0].upper()}{first[1:]} {change} by {numbers}{other}.{look}"
    fewest = statistics.fewest_pairs(verdict.alpha / len(setup.cells))
    if stage and not stage.ending:
        said = "not decided yet"
    elif len(verdict.pairs) < fewest and not (
        stage and stage.ending == "no difference"
    ):
        said = f"too few runs to find a difference at {verdict.alpha:g}, which takes {fewest} pairs"
    elif found.low == found.high:  # as where no run learned anything
        said = "no difference, all pairs are alike"
    else:
        bound = max(-found.low, found.high)
        said = (
            f"no significant difference, and one above about {bound:.2f} is ruled out"
        )
    return f"{where}: {said} ({gap}; {told}).{look}"


def _place(setup: Setup, cell: str) -> str:
    return setup.name if setup.cells == [cell] else f"{setup.name}, {cell}"


def room(setup: Setup, cell: str, found: Headroom) -> str:
    """What touch gives of what sight would give, or that the scene cannot tell."""
    where = _place(setup, cell)
    sight = (
        f"without touch, seeing the object makes a difference of {ranging(found.room)}"
    )
    if not found.is_enough:
        return (
            f"{where}: this scene cannot tell what touch is worth: {sight}, and {LEAST_ROOM} is the "
            f"least ({found.n} seeds)."
        )
    value, low, high = (f"{x:.0%}" for x in found.share)
    share = f"touch gives {value} ({low} to {high}) of what sight gives"
    return f"{where}: {share}; {sight} ({found.n} seeds)."


def answers(analysis: Analysis) -> list[str]:
    """Every comparison's answer, and what touch is worth beside sight."""
    said = []
    for one in analysis.setups:
        for cell, found in one.comparisons.items():
            said.append(answer(one.setup, found.verdict, analysis.study.primary.score))
            if found.headroom is not None:
                said.append(room(one.setup, cell, found.headroom))
    return said


def made_with(config: dict[str, Any]) -> set[tuple[str, str]]:
    """(package, version) of all that could change what a run came to; several of one where it went on
    with others. MPI does nothing for a single process, nor one simulator in a scene of the other."""
    made = config.get("provenance", [])
    simulator = (config.get("scene") or {}).get("simulator")
    idle = {"mujoco", "pybullet"} - {simulator} if simulator else set()
    idle |= {"mpi4py"} if config.get("ranks", 1) == 1 else set()
    commits = {("commit", str(one["commit"])) for one in made}
    versions = commits.union(*(one["versions"].items() for one in made))
    return {(name, version) for name, version in versions if name not in idle}


def warnings(analysis: Analysis) -> list[str]:
    """What a reader must know before he believes the numbers."""
    found, states = [], Counter[str]()
    for one in analysis.setups:
        for record in one.records:
            comparison = one.comparisons.get(record.run.cell)
            stage = comparison.verdict.stage if comparison else None
            if record.has_ended or not (
                stage and stage.ending
            ):  # else nobody needs it any more
                states[record.state] += 1
    if unfinished := [
        f"{n} {state}" for state, n in sorted(states.items()) if state != "done"
    ]:
        found.append(
            f"Of {len(analysis.records)} runs {', '.join(unfinished)}: they are in no figure."
        )
    groups = [group for one in analysis.setups for group in one.groups.values()]
    if (fewest := min(map(len, groups), default=FEW_RUNS)) < FEW_RUNS:
        found.append(
            f"The smallest group has {plural(fewest, 'run')}. Bands of learning curves of fewer than "
            f"{FEW_RUNS} runs are too narrow: they contain the truth less often than they say."
        )
    levels = [
        [
            statistics.aggregate(one.scores[name], "iqm")
            for name in ("final", "converged")
        ]
        for one in groups
    ]
    if rising := sum(final - converged > STILL_RISING for final, converged in levels):
        found.append(
            f"In {rising} of {len(groups)} groups the runs end well above the level where they spent "
            "most epochs: they were too short for converged rates, the paper's measure, to mean much."
        )
    for one in analysis.setups:
        if not one.groups:
            found.append(
                f"{one.setup.name}: no finished run with a {one.setup.measure}."
            )
    for one in analysis.setups:
        if (
            len(
                {
                    frozenset(made_with(record.config))
                    for record in one.records
                    if record.config
                }
            )
            > 1
        ):
            found.append(
                f"{one.setup.name}: versions or commits differ between runs, and could change results: "
                "see Versions."
            )
    if diverged := sum(record.diverged > 0 for record in analysis.records):
        found.append(f"Episodes diverged in {plural(diverged, 'run')}: see Runs.")
    return found
