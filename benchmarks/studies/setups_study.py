"""Does the answer depend on the set-up? Tables of the study `setups`, from its collected runs.

python -m benchmarks setups_study

Set-ups differ in hand, simulator and learner.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.stats
from tactilerl import statistics, style
from tactilerl.statistics import Array, Estimate
from tactilerl.study import pairs as study_pairs
from tactilerl.study.pairs import BySeed
from tactilerl.study.records import Record
from tactilerl.study.report import p_value

from benchmarks.command import data, markdown
from benchmarks.studies.study_tables import estimate, in_common, load, number, title

LAYOUTS = ("layout 1", "layout 2", "layout 5", "8 chosen")
CHOSEN, NONE = LAYOUTS[-1], "no touch"
ORDER = ("ppo", "ddpg_her", "mpl", "shadow", "allegro", "mujoco", "pybullet")
N_PERMUTATIONS = 50_000
MARGIN = 0.05  # by which chosen taxels may be behind


class SetUp(NamedTuple):
    """What the paper changed all at once."""

    learner: str
    hand: str
    simulator: str

    def __str__(self) -> str:
        return ", ".join(style.NAMES[part] for part in (self.hand, self.simulator, self.learner))


Learned = dict[SetUp, dict[str, BySeed]]
"""A score by set-up, layout (or no touch) and seed."""
Groups = dict[SetUp, Array]
"""A score of each set-up, (layouts and no touch, seeds)."""


def place(record: Record) -> tuple[SetUp, str]:
    """Return the set-up of a run, and its layout as the tables call it."""
    config = record.config or {}
    run, scene = config["run"], config["scene"]
    layout = title(scene["layout"]) if scene["touch"] == "on" else NONE
    return SetUp(run["algo"], run["env"], scene["simulator"]), layout


def learned(score: str) -> Learned:
    """Return the scores of all finished runs, over the steps that all runs of a set-up have."""
    groups: dict[SetUp, dict[str, list[Record]]] = defaultdict(lambda: defaultdict(list))
    for record in load("setups")[1]:
        if record.is_finished:
            setup, layout = place(record)
            groups[setup][layout].append(record)
    return {
        setup: dict(zip(runs, study_pairs.scored(score, *runs.values()), strict=True))
        for setup, runs in sorted(groups.items(), key=lambda item: [*map(ORDER.index, item[0])])
    }


def in_whole_seeds(score: str) -> Groups:
    """Return set-ups with two seeds or more that have a run of each layout and one without touch."""
    found: Groups = {}
    for setup, of in learned(score).items():
        seeds, groups = in_common([of.get(name, {}) for name in (*LAYOUTS, NONE)])
        if len(seeds) >= 2:
            found[setup] = groups
    return found


def gains(score: str = "area") -> Groups:
    """Return touch minus no touch within seeds, (layouts, seeds)."""
    return {setup: groups[:-1] - groups[-1] for setup, groups in in_whole_seeds(score).items()}


def show_worth() -> None:
    """Print what touch adds in each set-up: the mean over the layouts within each seed."""
    found = in_whole_seeds("area")
    # Five pairs cannot fall below 0.06 when signs are flipped, so these are t tests.
    each = ((groups[:-1] - groups[-1]).mean(axis=0) for groups in found.values())
    tests = [scipy.stats.ttest_1samp(gain, 0) for gain in each]
    rows = []
    corrected = statistics.holm([test.pvalue for test in tests])
    for (setup, groups), test, p in zip(found.items(), tests, corrected, strict=True):
        gain = groups[:-1].mean() - groups[-1].mean()
        shown = estimate(Estimate(gain, *test.confidence_interval()), "+.2f")
        rows.append((setup, groups.shape[1], f"{groups[-1].mean():.2f}", shown, p_value(p)))
    markdown("| set-up | seeds | no touch | touch − no touch | p, Holm |", rows)


def show_layouts() -> None:
    """Print what each layout reaches, and whether the chosen taxels are within MARGIN of all others."""
    rows = []
    for setup, groups in in_whole_seeds("area").items():
        *others, chosen = layouts = groups[:-1]
        at_least, is_within = compared(chosen, others)
        n_dead = int((layouts < groups[-1].min()).sum())
        levels = [f"{level:.2f}" for level in layouts.mean(axis=1)]
        best = min(chosen.mean() - other.mean() for other in others)
        ahead = (number(value, "+.2f") for value in (best, at_least))
        rows.append((setup, *levels, n_dead, *ahead, is_within))
    last = f"{CHOSEN} − the best of the paper's | lowest bound | within {MARGIN}"
    markdown(f"| set-up | {' | '.join(LAYOUTS)} | runs below no touch | {last} |", rows)


def compared(chosen: Array, others: Sequence[Array]) -> tuple[float, str]:
    """Return how far runs (seeds,) are ahead of all others at least, and whether by −MARGIN or more.

    One-sided 95 % bounds of t tests against each of the others: "yes" takes all of them, "no" one that
    is corrected for their number.
    """
    tests = [scipy.stats.ttest_1samp(chosen - other, 0) for other in others]
    at_least = min(test.confidence_interval(0.90).low for test in tests)
    if min(test.confidence_interval(1 - 0.1 / len(others)).high for test in tests) < -MARGIN:
        return at_least, "no"
    return at_least, "yes" if at_least > -MARGIN else "cannot tell"


def show_chosen() -> None:
    """Print each layout's mean over the set-ups, and the chosen taxels minus it."""
    by_setup = [*in_whole_seeds("area").values()]
    chosen = LAYOUTS.index(CHOSEN)
    rows = []
    for i, name in enumerate((*LAYOUTS, NONE)):
        level = np.mean([groups[i].mean() for groups in by_setup])
        ahead = ""
        if name != CHOSEN:
            differences = [groups[chosen] - groups[i] for groups in by_setup]
            ahead = estimate(over_setups(differences), "+.2f")
        rows.append((name, f"{level:.2f}", ahead))
    markdown(f"| | mean over the set-ups | {CHOSEN} − this |", rows)


def over_setups(differences: Sequence[Array]) -> Estimate:
    """Return the mean over these set-ups of differences (seeds,), with a t interval (Satterthwaite)."""
    value = float(np.mean([one.mean() for one in differences]))
    parts = np.array([one.var(ddof=1) / len(one) for one in differences])
    df = parts.sum() ** 2 / (parts**2 / [len(one) - 1 for one in differences]).sum()
    scale = np.sqrt(parts.sum()) / len(differences)
    return Estimate(value, *scipy.stats.t.interval(0.95, df, value, scale))


def show_order() -> None:
    """Print whether the set-ups put the layouts into the same order (Kendall's W)."""
    rows = []
    for name, score in (("mean over the run", "area"), ("last tenth", "final")):
        by_setup = gains(score)
        values = np.array([one.mean(axis=1) for one in by_setup.values()])
        hands = [setup.hand for setup in by_setup]
        w, p = concordance(values, [str(i) for i in range(len(values))])
        _, p_by_hand = concordance(values, hands)
        rows.append((name, f"{w:.2f}", p_value(p), p_value(p_by_hand)))
    markdown("| gain by | Kendall's W | p, by set-up | p, by hand |", rows)


def concordance(values: Array, blocks: Sequence[str]) -> tuple[float, float]:
    """Return Kendall's W of the order of layouts over set-ups, and its p-value.

    `values` has shape (setups, layouts). The test shuffles the order of all set-ups of a
    block, such as a hand, in the same way.
    """
    n_setups, n_layouts = values.shape
    ranks = scipy.stats.rankdata(values, axis=1)
    friedman = scipy.stats.friedmanchisquare(*values.T).statistic
    names = np.array(blocks)
    sums = np.array([ranks[names == name].sum(axis=0) for name in dict.fromkeys(blocks)])
    rng = np.random.default_rng(0)
    shuffled = rng.permuted(np.broadcast_to(sums, (N_PERMUTATIONS, *sums.shape)), axis=2)
    # Rows of ranks have the same sum, so the variance of the column sums orders W.
    spread = shuffled.sum(axis=1).var(axis=1)
    as_large = (spread >= ranks.sum(axis=0).var() - 1e-9).sum()
    return float(friedman / (n_setups * (n_layouts - 1))), (1 + as_large) / (1 + N_PERMUTATIONS)


def prediction(
    predictors: Sequence[Array], values: Array, blocks: Sequence[str]
) -> tuple[float, float]:
    """Return the rank correlation of a predictor with values, averaged over set-ups, and p.

    Both have shape (setups, layouts). The exact two-sided test reorders the predictor in
    all ways, which the set-ups of a block share.
    """
    told, reached = (
        scipy.stats.zscore(scipy.stats.rankdata(x, axis=-1), axis=-1) for x in (predictors, values)
    )
    orders = np.array([*itertools.permutations(range(values.shape[1]))])
    names, sums = np.array(blocks), np.zeros(1)
    for name in dict.fromkeys(blocks):
        (members,) = np.nonzero(names == name)
        by_order = told[members[0]][orders] @ reached[members].sum(axis=0)
        sums = np.add.outer(sums, by_order).ravel()
    sums = np.round(sums / values.size, 9)
    return float(sums[0]), float((np.abs(sums) >= abs(sums[0])).mean())


PREDICTORS: dict[str, Callable[[dict[str, Any]], float]] = {
    "number of taxels": lambda row: row["taxels"],
    "success at the first touch, as the scene begins": lambda row: row["success"],
    "success at the first touch, waiting at its best": lambda row: row["best"]["success"],
}
"""What might predict the order of a hand's layouts (`python -m benchmarks design` of 0.4.0). The
share of starts felt in time puts them into the same order as the second."""


def predicted(name: str, setups: Iterable[SetUp]) -> dict[SetUp, Array]:
    """Return what a predictor says of the four layouts in each set-up."""
    of_hands, read = data("design")["hands"], PREDICTORS[name]
    return {s: np.array([read(of_hands[s.hand][layout]) for layout in LAYOUTS]) for s in setups}


def show_predictors() -> None:
    """Print what predicts the order of layouts: rank correlations, averaged over set-ups."""
    found = gains()
    values = np.array([one.mean(axis=1) for one in found.values()])
    rows = []
    for name in PREDICTORS:
        told = [*predicted(name, found).values()]
        correlation, p = prediction(told, values, [setup.hand for setup in found])
        rows.append((name, number(correlation, ".2f"), p_value(p)))
    markdown("| predictor | mean rank correlation with the gain | p, by hand |", rows)


TABLES = {
    "setups worth": show_worth,
    "setups layouts": show_layouts,
    "setups order": show_order,
    "setups predictors": show_predictors,
    "setups chosen": show_chosen,
}
