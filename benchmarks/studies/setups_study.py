"""Does the answer depend on the set-up? Tables of the study `setups`, from its collected runs.

python -m benchmarks setups_study --out docs/data/setups.json

Set-ups differ in hand, simulator and learner. The file has what takes minutes: the shares of variance
with their intervals.
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

from benchmarks.command import DATA, data, parser, write
from benchmarks.printing import markdown
from benchmarks.studies import agreement
from benchmarks.studies.design_study import title
from benchmarks.studies.study_tables import estimate, load, mean
from tactilerl import statistics, style
from tactilerl.statistics import Array
from tactilerl.study import verdicts
from tactilerl.study.records import Record
from tactilerl.study.verdicts import BySeed

LAYOUTS = ("layout 1", "layout 2", "layout 5", "8 chosen")
CHOSEN, NONE, SIGHT = LAYOUTS[-1], "no touch", "sight"
ORDER = ("ppo", "ddpg_her", "mpl", "shadow", "allegro", "mujoco", "pybullet")
IS_THERE = (DATA / "setups.tar.gz").exists()
LEAST_SIGHT, LEAST_GAIN = 0.85, 0.3  # of the pilot, for a set-up to take part


class SetUp(NamedTuple):
    """What the paper changed all at once."""

    learner: str
    hand: str
    simulator: str

    def __str__(self) -> str:
        return ", ".join(style.NAMES[part] for part in (self.hand, self.simulator, self.learner))


Learned = dict[SetUp, dict[str, BySeed]]
"""A score by set-up, layout (or no touch) and seed."""


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


def gains(of: dict[str, BySeed]) -> Array:
    """Each layout minus no touch in the seeds that all of them have, (layouts, seeds)."""
    seeds = sorted(set.intersection(*(set(of[name]) for name in (*LAYOUTS, NONE))))
    return np.array([[of[layout][seed] - of[NONE][seed] for seed in seeds] for layout in LAYOUTS])


def show_worth() -> None:
    """Does touch help in every set-up? Its gain is the mean over the layouts within each seed."""
    found = learned("area")
    gain = {setup: gains(of).mean(axis=0) for setup, of in found.items()}
    # Five pairs cannot fall below 0.06 when signs are flipped, so this is a t test.
    p_values = [scipy.stats.ttest_1samp(each, 0).pvalue for each in gain.values()]
    rows = [
        (setup, len(gain[setup]), mean(of[NONE].values()), mean(gain[setup], "+.2f"), f"{p:.3f}")
        for (setup, of), p in zip(found.items(), statistics.holm(p_values), strict=True)
    ]
    markdown("| set-up | seeds | no touch | touch − no touch | p, Holm |", rows)


def show_layouts() -> None:
    """What each layout reaches; the chosen taxels against the best of the others."""
    rows = []
    for setup, of in learned("area").items():
        gain = gains(of)
        means = gain.mean(axis=1)
        best = int(np.argmax(means[:-1]))
        behind = gain[-1] - gain[best]
        levels = (f"{np.mean([*of[layout].values()]):.2f}" for layout in LAYOUTS)
        rows.append((setup, *levels, LAYOUTS[best], mean(behind, "+.2f")))
    head = f"| set-up | {' | '.join(LAYOUTS)} | best of the paper's | {CHOSEN} − it |"
    markdown(head, rows)


def show_order() -> None:
    """Do the set-ups put the layouts into the same order?"""
    rows = []
    for score, name in (("area", "mean over the run"), ("final", "last tenth")):
        each = [gains(of) for of in learned(score).values()]
        order = agreement.agreement_of(each)
        concordance, p = agreement.concordance(np.array([one.mean(axis=1) for one in each]))
        rows.append((name, len(each), f"{concordance:.2f}", f"{p:.4f}", estimate(order, ".2f")))
    head = "| gain by | set-ups | Kendall's W | p, by permutation | mean rank correlation of two |"
    markdown(head, rows)


def show_variance(shares: dict[str, Sequence[float]]) -> None:
    """Of the gains: what takes which share of their variance."""
    rows = [(name, estimate(statistics.Estimate(*share), ".2f")) for name, share in shares.items()]
    markdown("| part of the gain's variance | share |", rows)


PREDICTORS: dict[str, Callable[[dict[str, Any]], float]] = {
    "number of taxels": lambda row: row["taxels"],
    "share of starts felt in time": lambda row: row["felt"],
    "hand that closes at the first touch": lambda row: row["success"],
    "the same, waiting at its best": lambda row: row["best"]["success"],
}
"""What might foretell the order of a hand's layouts (`python -m benchmarks design --only hands`)."""


def predicted(name: str, setups: Iterable[SetUp]) -> dict[SetUp, Array]:
    """What a predictor says of the four layouts in each set-up."""
    of_hands, read = data("design")["hands"], PREDICTORS[name]
    return {s: np.array([read(of_hands[s.hand][layout]) for layout in LAYOUTS]) for s in setups}


def show_predictors() -> None:
    """What foretells the order of layouts? Rank correlation within set-ups, averaged over them."""
    each = {setup: gains(of) for setup, of in learned("area").items()}
    rows = []
    for name in PREDICTORS:
        told = {s: one for s, one in predicted(name, each).items() if np.ptp(one) > 0}  # else no order
        order = agreement.foretold([*told.values()], [each[setup] for setup in told])
        rows.append((name, len(told), estimate(order, ".2f")))
    markdown("| predictor | set-ups | mean rank correlation with the gain |", rows)


def draw(folder: Path) -> None:
    """What each predictor says of a layout, and what the layout gained in learning (setups.png)."""
    each = {setup: gains(of).mean(axis=1) for setup, of in learned("area").items()}
    picture = Figure(figsize=(9, 3.4), layout="constrained")
    panels = picture.subplots(1, len(PREDICTORS), sharey=True)
    for axes, name in zip(panels, PREDICTORS, strict=True):
        for setup, told in predicted(name, each).items():
            at = np.argsort(told, kind="stable")
            axes.plot(told[at], each[setup][at], label=str(setup), **look(setup))
        axes.set_xlabel(textwrap.fill(name, 22))
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


def variance_shares(of: Learned) -> dict[str, Any]:
    """By a mixed model of the gains."""
    rows = [
        (float(gain), str(setup), layout, f"{setup} {seed}")
        for setup, found in of.items()
        for layout, row in zip(LAYOUTS, gains(found), strict=True)
        for seed, gain in enumerate(row)
    ]
    return {name: list(share) for name, share in agreement.variance_shares(rows).items()}


STUDY: dict[str, Callable[[], None]] = {
    "setups worth": show_worth,
    "setups layouts": show_layouts,
    "setups order": show_order,
    "setups predictors": show_predictors,
}


def main() -> None:
    """All tables of the study; JSON with what takes minutes."""
    options = parser(__doc__).parse_args()
    shares = variance_shares(learned("area"))
    write(options.out, {"variance": shares})
    show_variance(shares)
    for show in STUDY.values():
        show()


TABLES: dict[str, Callable[[], None]] = {}
if (DATA / "setups_pilot.tar.gz").exists():
    TABLES["setups pilot"] = show_pilot
if IS_THERE:
    TABLES |= {**STUDY, "setups variance": lambda: show_variance(data("setups")["variance"])}
