"""Does the answer depend on the set-up? Tables of the study `setups`, from its collected runs.

python -m benchmarks setups_study

Set-ups differ in hand, simulator and learner.
"""

from __future__ import annotations

import textwrap
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.stats
from matplotlib.figure import Figure
from tactilerl import statistics, style
from tactilerl.statistics import Array, Estimate
from tactilerl.study import verdicts
from tactilerl.study.records import Record
from tactilerl.study.tables import p_value
from tactilerl.study.verdicts import BySeed

from benchmarks.command import data
from benchmarks.printing import markdown
from benchmarks.studies import agreement
from benchmarks.studies.design_study import title
from benchmarks.studies.study_tables import estimate, in_common, load, number

LAYOUTS = ("layout 1", "layout 2", "layout 5", "8 chosen")
CHOSEN, NONE, SIGHT = LAYOUTS[-1], "no touch", "sight"
ORDER = ("ppo", "ddpg_her", "mpl", "shadow", "allegro", "mujoco", "pybullet")
LEAST_SIGHT, LEAST_GAIN = 0.85, 0.3  # of the pilot, for a set-up to take part
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
Arms = dict[SetUp, Array]
"""A score of each set-up, (layouts and no touch, seeds)."""


def place(record: Record) -> tuple[SetUp, str]:
    """The set-up of a run, and its layout as the tables call it."""
    config = record.config or {}
    run, scene = config["run"], config["scene"]
    layout = title(scene["layout"]) if scene["touch"] == "on" else NONE
    if scene["object_seen"] != "hidden":
        layout = SIGHT
    return SetUp(run["algo"], run["env"], scene["simulator"]), layout


def learned(score: str, name: str = "setups") -> Learned:
    """Of every run that is done, over the steps that all runs of its set-up have."""
    groups: dict[SetUp, dict[str, list[Record]]] = defaultdict(lambda: defaultdict(list))
    for record in load(name)[1]:
        if record.is_finished:
            setup, layout = place(record)
            groups[setup][layout].append(record)
    return {
        setup: dict(zip(runs, verdicts.scored(score, *runs.values()), strict=True))
        for setup, runs in sorted(groups.items(), key=lambda item: [*map(ORDER.index, item[0])])
    }


def show_pilot() -> None:
    """Which set-ups can tell what touch is worth?"""
    rows = []
    for setup, of in learned("final", "setups_pilot").items():
        sight, touch, none = (np.array([*of[name].values()]) for name in (SIGHT, LAYOUTS[0], NONE))
        takes_part = sight.mean() >= LEAST_SIGHT and touch.mean() - none.mean() >= LEAST_GAIN
        each = (", ".join(f"{one:.2f}" for one in group) for group in (sight, touch, none))
        rows.append((setup, *each, "yes" if takes_part else "no"))
    markdown("| set-up | sight | touch | no touch | takes part |", rows)


def in_whole_seeds(score: str) -> Arms:
    """Set-ups with at least two seeds that have a run of each layout and one without touch."""
    found: Arms = {}
    for setup, of in learned(score).items():
        seeds, arms = in_common([of.get(name, {}) for name in (*LAYOUTS, NONE)])
        if len(seeds) >= 2:
            found[setup] = arms
    return found


def gains(score: str = "area") -> Arms:
    """Touch minus no touch within seeds, (layouts, seeds)."""
    return {setup: arms[:-1] - arms[-1] for setup, arms in in_whole_seeds(score).items()}


def show_worth() -> None:
    """Does touch help in every set-up? Its gain is the mean over the layouts within each seed."""
    found = in_whole_seeds("area")
    # Five pairs cannot fall below 0.06 when signs are flipped, so these are t tests.
    each = ((arms[:-1] - arms[-1]).mean(axis=0) for arms in found.values())
    tests = [scipy.stats.ttest_1samp(gain, 0) for gain in each]
    rows = []
    corrected = statistics.holm([test.pvalue for test in tests])
    for (setup, arms), test, p in zip(found.items(), tests, corrected, strict=True):
        gain = arms[:-1].mean() - arms[-1].mean()
        shown = estimate(Estimate(gain, *test.confidence_interval()), "+.2f")
        rows.append((setup, arms.shape[1], f"{arms[-1].mean():.2f}", shown, p_value(p)))
    markdown("| set-up | seeds | no touch | touch − no touch | p, Holm |", rows)


def show_layouts() -> None:
    """What each layout reaches, and whether the chosen taxels are within MARGIN of every other."""
    rows = []
    for setup, arms in in_whole_seeds("area").items():
        *others, chosen = layouts = arms[:-1]
        at_least, is_within = compared(chosen, others)
        n_dead = int((layouts < arms[-1].min()).sum())
        levels = [f"{level:.2f}" for level in layouts.mean(axis=1)]
        best = min(chosen.mean() - other.mean() for other in others)
        ahead = (number(value, "+.2f") for value in (best, at_least))
        rows.append((setup, *levels, n_dead, *ahead, is_within))
    last = f"{CHOSEN} − the best of the paper's | lowest bound | within {MARGIN}"
    markdown(f"| set-up | {' | '.join(LAYOUTS)} | runs below no touch | {last} |", rows)


def compared(chosen: Array, others: Sequence[Array]) -> tuple[float, str]:
    """By how much runs (seeds,) are ahead of all others at least; are they within MARGIN?

    One-sided 95 % bounds of t tests against each of the others: "yes" takes all of them, "no" one that
    is corrected for their number.
    """
    tests = [scipy.stats.ttest_1samp(chosen - other, 0) for other in others]
    at_least = min(test.confidence_interval(0.90).low for test in tests)
    if min(test.confidence_interval(1 - 0.1 / len(others)).high for test in tests) < -MARGIN:
        return at_least, "no"
    return at_least, "yes" if at_least > -MARGIN else "cannot tell"


def show_chosen() -> None:
    """The chosen taxels against each of the paper's layouts: the mean over these set-ups."""
    found = [*gains().values()]
    rows = []
    for i, layout in enumerate(LAYOUTS[:-1]):
        ahead = [each[-1] - each[i] for each in found]
        value = np.mean([one.mean() for one in ahead])
        parts = np.array([one.var(ddof=1) / len(one) for one in ahead])
        n_free = [len(one) - 1 for one in ahead]
        df = parts.sum() ** 2 / (parts**2 / n_free).sum()  # Satterthwaite's
        ends = scipy.stats.t.interval(0.95, df, value, np.sqrt(parts.sum()) / len(ahead))
        rows.append((layout, estimate(Estimate(float(value), *ends), "+.2f")))
    markdown(f"| layout | {CHOSEN} − this layout, mean over the set-ups |", rows)


def show_order() -> None:
    """Do the set-ups put the layouts into the same order?"""
    rows = []
    for name, score, middle in (
        ("mean over the run", "area", np.mean),
        ("the same, median of the seeds", "area", np.median),
        ("last tenth", "final", np.mean),
    ):
        each = gains(score)
        values = np.array([middle(one, axis=1) for one in each.values()])
        concordance, by_setup = agreement.concordance(values)
        _, by_hand = agreement.concordance(values, [setup.hand for setup in each])
        correlation = number(agreement.rank_agreement(values).value, ".2f")
        p_values = map(p_value, (by_setup, by_hand))
        rows.append((name, f"{concordance:.2f}", correlation, *p_values))
    head = "gain by | Kendall's W | mean rank correlation of two set-ups | p, by set-up | p, by hand"
    markdown(f"| {head} |", rows)


def show_variance() -> None:
    """What takes which share of the gains' variance? Do layouts differ alike everywhere (p)?"""
    found = [*gains().values()]
    n_seeds = min(one.shape[1] for one in found)
    balanced = np.array([one[:, :n_seeds] for one in found])
    rows = [
        (name, estimate(share, ".2f"), p_value(agreement.differ(balanced)) if "×" in name else "")
        for name, share in agreement.variance_shares(balanced).items()
    ]
    markdown("| part of the gain's variance | share | p |", rows)


PREDICTORS: dict[str, Callable[[dict[str, Any]], float]] = {
    "number of taxels": lambda row: row["taxels"],
    "success at the first touch, as the scene begins": lambda row: row["success"],
    "success at the first touch, waiting at its best": lambda row: row["best"]["success"],
}
"""What might predict the order of a hand's layouts (`python -m benchmarks design --only hands`). The
share of starts felt in time puts them into the same order as the second."""


def predicted(name: str, setups: Iterable[SetUp]) -> dict[SetUp, Array]:
    """What a predictor says of the four layouts in each set-up."""
    of_hands, read = data("design")["hands"], PREDICTORS[name]
    return {s: np.array([read(of_hands[s.hand][layout]) for layout in LAYOUTS]) for s in setups}


def show_predictors() -> None:
    """What predicts the order of layouts? Rank correlation within set-ups, averaged over them."""
    found = gains()
    values = np.array([one.mean(axis=1) for one in found.values()])
    rows = []
    for name in PREDICTORS:
        told = [*predicted(name, found).values()]
        correlation, p = agreement.predicted_by_block(told, values, [setup.hand for setup in found])
        rows.append((name, number(correlation, ".2f"), p_value(p)))
    markdown("| predictor | mean rank correlation with the gain | p, by hand |", rows)


def draw(folder: Path) -> None:
    """What each predictor says of a layout, and what the layout gained in learning (setups.png)."""
    each = {setup: one.mean(axis=1) for setup, one in gains().items()}
    picture = Figure(figsize=(8, 3.4), layout="constrained")
    panels = picture.subplots(1, len(PREDICTORS), sharey=True)
    for axes, name in zip(panels, PREDICTORS, strict=True):
        for setup, told in predicted(name, each).items():
            at = np.argsort(told, kind="stable")
            axes.plot(told[at], each[setup][at], label=str(setup), **look(setup))
        axes.set_xlabel(textwrap.fill(name, 26))
    panels[0].set(xscale="log", ylabel="gain in success over the run")
    panels[0].set_xticks((10, 30, 100), ("10", "30", "100"))
    panels[0].minorticks_off()
    picture.suptitle("Arrivals anywhere: what four layouts gain in each set-up", **style.HEAD)
    picture.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    picture.savefig(folder / "setups.png", dpi=style.DPI, metadata={"Software": None})


def look(setup: SetUp) -> dict[str, Any]:
    """A colour for the hand, a line for the learner, a marker for the simulator."""
    return {
        "color": style.OTHERS[ORDER.index(setup.hand) - ORDER.index("mpl")],
        "linestyle": {"ppo": "-", "ddpg_her": "--"}[setup.learner],
        "marker": {"mujoco": "o", "pybullet": "s"}[setup.simulator],
        "linewidth": 1,
        "markersize": 4,
    }


TABLES = {
    "setups pilot": show_pilot,
    "setups worth": show_worth,
    "setups layouts": show_layouts,
    "setups order": show_order,
    "setups variance": show_variance,
    "setups predictors": show_predictors,
    "setups chosen": show_chosen,
}
