"""What came out, in words: what was compared, the answer, and what a reader must know first."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np

from ..statistics import FEW_RUNS, FEWEST_PAIRS, Estimate
from ..style import NAMES, arm
from .analysis import Analysis, Group, SetupResult
from .grid import SCORES, Setup
from .records import Record
from .verdicts import LEAST_ROOM, Headroom, Verdict

STILL_RISING = 0.1  # final over converged rate
MEASURES = {
    "success_rate": "success rate of the training episodes",
    "test_success_rate": "success rate of the tests",
}


def subject(one: SetupResult) -> str:
    """Hand, simulator and learner: `MPL hand in PyBullet, PPO`."""
    config = one.config
    if not config:
        return one.setup.name
    env, learner = (NAMES.get(config["run"][name], config["run"][name]) for name in ("env", "algo"))
    simulator = (config.get("scene") or {}).get("simulator")
    where = f" in {NAMES.get(simulator, simulator)}" if simulator else ""
    return f"{env}{where}, {learner}"


def about(one: SetupResult, score: str) -> str:
    """What was compared, in a sentence or two."""
    config = one.config
    scene = config.get("scene") or {}
    told = "" if scene.get("object_seen", "exact") == "exact" else f"object {scene['object_seen']}"
    length = config.get("run", {}).get("total_timesteps")
    steps = f"{length:,} steps a run" if length else ""
    parts = [part for part in (subject(one), scene.get("task"), told, steps) if part]
    said = f"{one.setup.name}: {', '.join(parts)}."
    if one.setup.compare is None:
        return said
    names = [arm(one.setup.label(each)) for each in one.setup.arms[:2]]
    return (
        f"{said} Compares {names[0]} with {names[1]}, in pairs of the same seed, by {SCORES[score]} "
        f"of the {MEASURES[one.setup.measure]}."
    )


def provenance(records: list[Record]) -> str:
    """How many runs of which commit."""
    done = sum(record.state == "done" for record in records)
    commits = Counter(
        str(record.config["provenance"][-1]["commit"])[:12]
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
    return "–" if math.isnan(value) else f"{round(value, 2) + 0.0:+.2f}".replace("-", "−")


def ranging(estimate: Estimate) -> str:
    """`+0.05 (−0.02 to +0.12)`"""
    return f"{signed(estimate.value)} ({signed(estimate.low)} to {signed(estimate.high)})"


def answer(setup: Setup, verdict: Verdict) -> str:
    """The primary comparison of a cell in one sentence, with its interval."""
    treatment, control = map(setup.label, setup.arms[:2])
    where = _place(setup, verdict.cell)
    pairs, stage, missing = verdict.pairs, verdict.stage, verdict.n_seeds - len(verdict.pairs)
    if not len(pairs):
        return f"{where}: no seed has both runs yet."
    found = pairs.difference
    count = f"{len(pairs)} of {verdict.n_seeds} pairs" if missing else plural(len(pairs), "pair")
    numbers = f"{treatment} − {control}: {ranging(found)}"
    if stage is not None and not stage.look:
        return f"{where}: {numbers} in {count}; the first look is still to come."
    corrected = ", corrected" if len(setup.cells) > 1 or stage is not None else ""
    p_value = verdict.pairs.p_value if verdict.valid_p == 1 else verdict.p_holm
    p = "p < 0.001" if p_value < 0.001 else f"p = {p_value:.3f}"
    numbers += f", {count}" if math.isnan(p_value) else f", {p}{corrected}, {count}"
    look = "" if stage is None else f" Look {stage.look} of {stage.of}: {ENDINGS[stage.ending]}."
    if verdict.is_difference:
        first, second = (treatment, control) if found.value > 0 else (control, treatment)
        return f"{where}: {first} is ahead of {second} ({numbers}).{look}"
    if stage is not None and not stage.ending:
        return f"{where}: not decided yet ({numbers}).{look}"
    if len(pairs) < FEWEST_PAIRS:
        few = f"too few runs to detect a difference at {verdict.alpha:g}, which takes {FEWEST_PAIRS}"
        return f"{where}: {few} pairs ({numbers}).{look}"
    if found.low == found.high:  # as where no run learned anything
        return f"{where}: no difference was detected, all pairs are alike ({numbers}).{look}"
    bound = math.ceil(100 * max(-found.low, found.high)) / 100
    return (
        f"{where}: no difference was detected ({numbers}); a difference above {bound:.2f} can be "
        f"ruled out.{look}"
    )


def _place(setup: Setup, cell: str) -> str:
    return setup.name if setup.cells == [cell] else f"{setup.name}, {cell}"


ENDINGS = {
    "": "the study goes on",
    "difference": "stopped for a difference",
    "no difference": "stopped, for a difference that matters is ruled out",
    "last look": "all runs are done",
}


def room(setup: Setup, cell: str, found: Headroom) -> str:
    """What touch gives of what sight would give, or that the scene cannot tell."""
    where = _place(setup, cell)
    sight = f"a control that sees the object is {ranging(found.room)} above one that does not"
    if not found.is_enough:
        return (
            f"{where}: this scene cannot tell what touch is worth: {sight}, and {LEAST_ROOM} is the "
            f"least ({found.n} seeds)."
        )
    value, low, high = (f"{x:.0%}" for x in found.share)
    share = f"touch gives {value} ({low} to {high}) of what sight gives"
    return f"{where}: {share}: {sight} ({found.n} seeds)."


def answers(analysis: Analysis) -> list[str]:
    """Every comparison's answer, and what touch is worth beside sight."""
    said = []
    for one in analysis.setups:
        for cell, found in one.comparisons.items():
            said.append(answer(one.setup, found.verdict))
            if found.headroom is not None:
                said.append(room(one.setup, cell, found.headroom))
    return said


def _still_rises(group: Group) -> bool:
    """Does the converged rate miss what the runs can do at their end?"""
    final, converged = (group.estimate("iqm", score).value for score in ("final", "converged"))
    return final - converged > STILL_RISING


def made_with(config: dict[str, Any]) -> set[tuple[str, str]]:
    """(package, version) of all that a run was made with; several of one where it went on with
    others."""
    made = config.get("provenance", [])
    commits = {("commit", str(one["commit"])) for one in made}
    return commits.union(*(one["versions"].items() for one in made))


def needless(analysis: Analysis) -> set[str]:
    """Runs left out, by name, because their comparison ended at an earlier look."""
    return {
        record.run.name
        for one in analysis.setups
        for record in one.records
        if not record.has_ended and (found := one.comparisons.get(record.run.cell))
        if found.verdict.stage and found.verdict.stage.ending
    }


def warnings(analysis: Analysis, few: int = FEW_RUNS) -> list[str]:
    """What a reader must know before he believes the numbers."""
    found, unneeded = [], needless(analysis)
    states = Counter(r.state for r in analysis.records if r.run.name not in unneeded)
    unfinished = [f"{n} {state}" for state, n in sorted(states.items()) if state != "done"]
    if unfinished:
        found.append(f"Of {len(analysis.records)} runs {', '.join(unfinished)}: they are in no figure.")
    groups = [group for one in analysis.setups for group in one.groups.values()]
    if (fewest := min(map(len, groups), default=few)) < few:
        found.append(
            f"The smallest group has {plural(fewest, 'run')}. Intervals of an arm with fewer "
            f"than {few} runs are too narrow: they contain the truth less often than they say."
        )
    if rising := sum(map(_still_rises, groups)):
        found.append(
            f"In {rising} of {len(groups)} groups the runs end well above the level where they spent "
            "most epochs: they were too short for converged rates, the paper's measure, to mean much."
        )
    for one in analysis.setups:
        if not one.groups:
            found.append(f"{one.setup.name}: no finished run with a {one.setup.measure}.")
    if len({frozenset(made_with(one.config)) for one in analysis.records if one.config}) > 1:
        found.append("The runs were made with different versions or commits: see Versions.")
    diverged = [
        r.run.name
        for r in analysis.records
        if sum(np.nansum(r.column(c)) for c in ("diverged", "test_diverged")) > 0
    ]
    if diverged:
        found.append(f"Episodes diverged in {plural(len(diverged), 'run')}: see Runs.")
    return found
