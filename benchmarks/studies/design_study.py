"""What is learned with designed layouts: the tables of docs/design.md, from the collected studies.

python -m benchmarks design_study
"""

from __future__ import annotations

import re
from functools import partial

import numpy as np
from tactilerl import statistics
from tactilerl.study import verdicts
from tactilerl.study.verdicts import BySeed

from benchmarks.command import data
from benchmarks.printing import markdown
from benchmarks.studies.agreement import predicts_order
from benchmarks.studies.study_tables import estimate, in_common, load, mean

STUDIES = {"ppo": "design", "ddpg_her": "design_ddpg_her"}
SKIN, PAPER = "the dense skin", "layout 1"
FILE = re.compile(r"docs/data/chosen/(?:[a-z]+_)?anywhere_(.+)\.toml")
Row = tuple[object, ...]


def title(layout: str) -> str:
    """A layout as the page calls it: `4 chosen`, `4 random, set 2`."""
    found = FILE.fullmatch(layout)
    if found is None:
        return f"layout {layout}"
    kind, *rest = found[1].split("_")
    if kind == "random":
        return f"{rest[0]} random, set {rest[1]}"
    return SKIN if kind == "skin" else f"{kind} chosen"


def learned(learner: str, score: str = "final") -> dict[str, BySeed]:
    """A score of every run of the learner, by layout and seed; `no touch` last."""
    study, found = load(STUDIES[learner])
    touch, blind = (f"{learner}{which}" for which in ("", "_blind"))
    setups = {one.name: one for one in study.setups}
    groups = {
        title(layout): verdicts.runs_of(found, setups[touch], "all", layout)
        for layout in map(str, setups[touch].grid["layout"])
    }
    groups["no touch"] = [run for run in found if run.run.setup == blind and run.is_finished]
    groups = {name: runs for name, runs in groups.items() if runs}
    return dict(zip(groups, verdicts.scored(score, *groups.values()), strict=True))


def show(learner: str) -> None:
    """Each layout: what it learned, and in pairs with layout 1 and with the dense skin."""
    finals = learned(learner)
    areas = learned(learner, "area")
    scripted = baselines()
    differences = {
        name: verdicts.in_pairs([one, finals[PAPER]]) for name, one in finals.items() if name != PAPER
    }
    corrected = statistics.holm([pairs.p_value for pairs in differences.values()])
    p_values = dict(zip(differences, corrected, strict=True))
    rows: list[Row] = []
    for name, final in finals.items():
        pairs = differences.get(name)
        rows.append((
            name,
            *(f"{baseline[name]:.2f}" if name in baseline else "" for baseline in scripted.values()),
            len(final),
            mean(areas[name].values()),
            mean(final.values()),
            estimate(pairs.difference, "+.2f") if pairs else "",
            f"{p_values[name]:.3f}" if pairs else "",
            _share(final, finals.get(SKIN, {})) if name != SKIN else "",
        ))  # fmt: skip
    markdown(
        f"| layout | {' | '.join(scripted)} | runs | success over the run | over its last tenth "
        "| − layout 1 | p, Holm | share of the dense skin's |",
        rows,
    )


def baselines() -> dict[str, dict[str, float]]:
    """Success of a scripted hand that closes at the first touch, by layout: where it waits as the scene
    begins, and where it waits as suits the layout best."""
    found = data("design")["layouts"]
    return {
        "scripted": {name: row["success"] for name, row in found.items()},
        "scripted, waiting at its best": {name: row["best"]["success"] for name, row in found.items()},
    }


def show_order() -> None:
    """Do scripted hands put the layouts into the order in which PPO learns them?"""
    finals = learned("ppo")
    rows: list[Row] = []
    for name, baseline in baselines().items():
        shared = [layout for layout in finals if layout in baseline]
        _, runs = in_common([finals[layout] for layout in shared])
        scripted = np.array([baseline[layout] for layout in shared])
        order = predicts_order(scripted, runs)
        gap = np.abs(scripted - runs.mean(axis=1))
        rows.append(
            (name, len(shared), estimate(order, ".2f"), f"{gap.mean():.2f}", f"{gap.max():.2f}")
        )
    markdown(
        "| baseline | layouts | rank correlation with success learned | mean gap | largest |", rows
    )


def _share(one: BySeed, whole: BySeed) -> str:
    """Of the dense skin's success, in the same seeds."""
    pairs = verdicts.in_pairs([one, whole])
    if len(pairs) < 2:
        return ""
    counts = verdicts.resamples(len(pairs))
    return estimate(statistics.share(pairs.treatment, pairs.control, counts), ".2f")


TABLES = {f"design {name}": partial(show, name) for name in STUDIES}
TABLES["design order ppo"] = show_order
