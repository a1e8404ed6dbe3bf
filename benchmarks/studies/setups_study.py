"""Does the answer depend on the set-up? Tables of the study `setups`, from its collected runs.

python -m benchmarks setups_study

Set-ups differ in hand, simulator and learner.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy.stats
from matplotlib.figure import Figure
from tactilerl import statistics, style
from tactilerl.statistics import Array, Estimate
from tactilerl.study import pairs as study_pairs
from tactilerl.study.pairs import BySeed
from tactilerl.study.records import Record
from tactilerl.study.report import p_value

from benchmarks.command import data, markdown
from benchmarks.studies.learner_tables import DEAD, part
from benchmarks.studies.study_tables import estimate, in_common, load, number, title

LAYOUTS = ("layout 1", "layout 2", "layout 5", "8 chosen")
CHOSEN, NONE = LAYOUTS[-1], "no touch"
LEARNERS = ("ppo", "ddpg_her")
ORDER = (*LEARNERS, "mpl", "shadow", "allegro", "mujoco", "pybullet")
N_PERMUTATIONS = 50_000
N_SIMULATED = 5_000  # studies without an interaction
MARGIN = 0.05  # by which chosen taxels may be behind


class SetUp(NamedTuple):
    """What the paper changed all at once."""

    learner: str
    hand: str
    simulator: str

    def __str__(self) -> str:
        return ", ".join(style.NAMES[part] for part in (self.hand, self.simulator, self.learner))


Groups = dict[SetUp, Array]
"""A score of each set-up, (layouts and no touch, seeds)."""
Score = Callable[[dict[str, list[Record]]], dict[str, BySeed]]
"""Return a score by layout and seed, of a set-up's runs by layout."""


def place(record: Record) -> tuple[SetUp, str]:
    """Return the set-up of a run, and its layout as the tables call it."""
    config = record.config or {}
    run, scene = config["run"], config["scene"]
    layout = title(scene["layout"]) if scene["touch"] == "on" else NONE
    return SetUp(run["algo"], run["env"], scene["simulator"]), layout


def by_layout() -> dict[SetUp, dict[str, list[Record]]]:
    """Return the finished runs by set-up, and by layout or no touch."""
    groups: dict[SetUp, dict[str, list[Record]]] = defaultdict(lambda: defaultdict(list))
    for record in load("setups")[1]:
        if record.is_finished:
            setup, layout = place(record)
            groups[setup][layout].append(record)
    in_order = sorted(groups.items(), key=lambda item: [*map(ORDER.index, item[0])])
    return {setup: dict(runs) for setup, runs in in_order}


def over_run(groups: dict[str, list[Record]]) -> dict[str, BySeed]:
    """Return mean success over the steps that all runs of a set-up have."""
    return dict(zip(groups, study_pairs.scored("area", *groups.values()), strict=True))


def at_end(groups: dict[str, list[Record]]) -> dict[str, BySeed]:
    """Return mean success over the last fifth of each run of a set-up."""
    return {
        layout: {record.run.seed: part(record, 0.8) for record in runs}
        for layout, runs in groups.items()
    }


def in_whole_seeds(score: Score = over_run) -> Groups:
    """Return set-ups with two seeds or more that have a run of each layout and one without touch."""
    scores: Groups = {}
    for setup, groups in by_layout().items():
        by_seed = score(groups)
        seeds, values = in_common([by_seed.get(name, {}) for name in (*LAYOUTS, NONE)])
        if len(seeds) >= 2:
            scores[setup] = values
    return scores


def in_mujoco(score: Score = over_run) -> Groups:
    """Return touch minus no touch within seeds, (layouts, seeds), in the set-ups of MuJoCo."""
    return {
        setup: groups[:-1] - groups[-1]
        for setup, groups in in_whole_seeds(score).items()
        if setup.simulator == "mujoco"
    }


def show_worth() -> None:
    """Print what touch adds in each set-up: the mean over the layouts within each seed."""
    by_setup, ends = in_whole_seeds(), in_whole_seeds(at_end)
    # Five pairs cannot fall below 0.06 when signs are flipped, so these are t tests.
    each = ((groups[:-1] - groups[-1]).mean(axis=0) for groups in by_setup.values())
    tests = [scipy.stats.ttest_1samp(gain, 0) for gain in each]
    rows = []
    corrected = statistics.holm([test.pvalue for test in tests])
    for (setup, groups), test, p in zip(by_setup.items(), tests, corrected, strict=True):
        touch, none = groups[:-1].mean(), groups[-1].mean()
        gain = estimate(Estimate(touch - none, *test.confidence_interval()), "+.2f")
        end = ends[setup]
        levels = (f"{level:.2f}" for level in (none, touch))
        last = f"{end[:-1].mean():.2f}, {end[-1].mean():.2f}"
        rows.append((setup, groups.shape[1], *levels, gain, p_value(p), last))
    head = "| set-up | seeds | no touch | touch | touch − no touch | p, Holm |"
    markdown(f"{head} last fifth: touch, no touch |", rows)


def show_layouts() -> None:
    """Print what each layout reaches, and whether the chosen taxels are within MARGIN of all others."""
    rows = []
    for setup, groups in in_whole_seeds().items():
        *others, chosen = layouts = groups[:-1]
        at_least, is_within = compared(chosen, others)
        levels = [f"{level:.2f}" for level in layouts.mean(axis=1)]
        best = min(chosen.mean() - other.mean() for other in others)
        ahead = (number(value, "+.2f") for value in (best, at_least))
        rows.append((setup, *levels, *ahead, is_within))
    last = f"{CHOSEN} − the best of the paper's | lowest bound | within {MARGIN}"
    markdown(f"| set-up | {' | '.join(LAYOUTS)} | {last} |", rows)


def show_dead() -> None:
    """Print how many runs end below DEAD, with touch and without."""
    rows = []
    for setup, groups in by_layout().items():
        dead = {k: [part(one, 0.5) < DEAD for one in runs] for k, runs in groups.items()}
        cells = (f"{sum(dead.get(k, []))} of {len(dead.get(k, []))}" for k in (*LAYOUTS, NONE))
        rows.append((setup, *cells))
    markdown(f"| set-up | {' | '.join((*LAYOUTS, NONE))} |", rows)


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
    by_setup = in_whole_seeds()
    chosen = LAYOUTS.index(CHOSEN)
    rows = []
    for i, name in enumerate((*LAYOUTS, NONE)):
        cells = [f"{np.mean([groups[i].mean() for groups in by_setup.values()]):.2f}"]
        if name != CHOSEN:
            ahead = {setup: groups[chosen] - groups[i] for setup, groups in by_setup.items()}
            pooled = [*ahead.values()]
            cells.append(estimate(over_setups(pooled), "+.2f"))
            cells.append(number(over_setups(pooled, 0.90).low, "+.2f"))
            for learner in LEARNERS:
                of_learner = [one for setup, one in ahead.items() if setup.learner == learner]
                cells.append(estimate(over_setups(of_learner), "+.2f"))
        rows.append((name, *cells, *[""] * (5 - len(cells))))
    learners = " | ".join(style.NAMES[learner] for learner in LEARNERS)
    markdown(f"| | mean over the set-ups | {CHOSEN} − this | lowest bound | {learners} |", rows)


def over_setups(differences: Sequence[Array], confidence: float = 0.95) -> Estimate:
    """Return the mean over these set-ups of differences (seeds,), with a t interval (Satterthwaite)."""
    value = float(np.mean([one.mean() for one in differences]))
    parts = np.array([one.var(ddof=1) / len(one) for one in differences])
    df = parts.sum() ** 2 / (parts**2 / [len(one) - 1 for one in differences]).sum()
    scale = np.sqrt(parts.sum()) / len(differences)
    return Estimate(value, *scipy.stats.t.interval(confidence, df, value, scale))


def show_order() -> None:
    """Print whether MuJoCo's set-ups put the layouts into the same order, and differ alike."""
    rows = []
    for name, score in (("mean over the run", over_run), ("last fifth", at_end)):
        gains = in_mujoco(score)
        values = np.array([one.mean(axis=1) for one in gains.values()])
        w, p = concordance(values, [str(i) for i in range(len(values))])
        _, p_by_hand = concordance(values, [setup.hand for setup in gains])
        p_values = (p_value(one) for one in (p, p_by_hand, interaction([*gains.values()])))
        rows.append((name, f"{w:.2f}", *p_values))
    markdown("| gain by | Kendall's W | p, by set-up | p, by hand | p of set-up × layout |", rows)


def interaction(gains: Sequence[Array]) -> float:
    """Return the p-value of: layouts differ by the same amounts in all set-ups (layouts, seeds).

    The F test of set-up x layout, whose null is drawn with each set-up's own noise, because noise
    differs between set-ups. Layouts of one seed share what that seed does.
    """

    def ratio(blocks: Sequence[Array]) -> Array:
        """Return the F statistic of studies, each set-up as (studies, layouts, seeds)."""
        means = np.stack([one.mean(axis=-1) for one in blocks], axis=1)
        weights = np.array([one.shape[-1] for one in blocks])[:, None]
        means = means - means.mean(axis=2, keepdims=True)
        common = (weights * means).sum(axis=1, keepdims=True) / weights.sum()
        between = (weights * (means - common) ** 2).sum(axis=(1, 2))
        within = sum((residuals(one) ** 2).sum(axis=(1, 2)) for one in blocks)
        n_layouts = means.shape[2]
        df = (len(blocks) - 1) * (n_layouts - 1), (weights - 1).sum() * (n_layouts - 1)
        return (between / df[0]) / (within / df[1])

    rng = np.random.default_rng(0)
    noise = []
    for one in gains:
        df = (one.shape[0] - 1) * (one.shape[1] - 1)
        std = np.sqrt((residuals(one[None]) ** 2).sum() / df)
        noise.append(std * rng.standard_normal((N_SIMULATED, *one.shape)))
    as_large = (ratio(noise) >= ratio([one[None] for one in gains])[0]).sum()
    return float((1 + as_large) / (1 + N_SIMULATED))


def residuals(values: Array) -> Array:
    """Return values (studies, layouts, seeds) without the effects of layout and seed."""
    values = values - values.mean(axis=1, keepdims=True)
    return values - values.mean(axis=2, keepdims=True)


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
    predictor: Array, values: Array, blocks: Sequence[str], is_within: bool
) -> tuple[float, float]:
    """Return the rank correlation of a predictor with values, both (setups, layouts), and its p.

    Within set-ups, it is the mean of theirs; otherwise all values are ranked together. The exact
    two-sided test reorders the predictor in all ways, which the set-ups of a block share.
    """

    def standardized(x: Array) -> Array:
        ranks = scipy.stats.rankdata(x, axis=-1 if is_within else None)
        axis = -1 if is_within else None
        return scipy.stats.zscore(ranks, axis=axis).reshape(values.shape)

    expected, reached = standardized(predictor), standardized(values)
    orders = np.array([*itertools.permutations(range(values.shape[1]))])
    names, sums = np.array(blocks), np.zeros(1)
    for name in dict.fromkeys(blocks):
        (members,) = np.nonzero(names == name)
        by_order = expected[members[0]][orders] @ reached[members].sum(axis=0)
        sums = np.add.outer(sums, by_order).ravel()
    sums = np.round(sums / values.size, 9)
    return float(sums[0]), float((np.abs(sums) >= abs(sums[0])).mean())


PREDICTORS: dict[str, Callable[[dict[str, Any]], float]] = {
    "number of taxels": lambda row: row["taxels"],
    "success at the first touch": lambda row: row["success"],
}
"""What might predict the order of a hand's layouts (`python -m benchmarks design` of 0.4.0)."""


def show_predictors() -> None:
    """Print what predicts gains in MuJoCo's set-ups: within a hand's layouts, and over hands too."""
    gains = in_mujoco()
    values = np.array([one.mean(axis=1) for one in gains.values()])
    hands = [setup.hand for setup in gains]
    of_hands, rows = data("design")["hands"], []
    for name, read in PREDICTORS.items():
        predictor = np.array([[read(of_hands[hand][layout]) for layout in LAYOUTS] for hand in hands])
        cells = []
        for is_within in (True, False):
            correlation, p = prediction(predictor, values, hands, is_within)
            cells += [number(correlation, ".2f"), p_value(p)]
        rows.append((name, *cells))
    head = "| predictor of the gain | rank correlation within a hand | p | over hands | p |"
    markdown(head, rows)


def draw(folder: Path) -> None:
    """Draw what each layout reaches in each set-up, with t intervals over the seeds."""
    by_setup = in_whole_seeds()
    picture = Figure(figsize=(7, 0.5 + 0.55 * len(by_setup)), layout="constrained")
    axes = picture.subplots()
    places = np.arange(len(by_setup))
    for i, name in enumerate((*LAYOUTS, NONE)):
        scores = [groups[i] for groups in by_setup.values()]
        means = np.array([one.mean() for one in scores])
        half = [scipy.stats.sem(one) * scipy.stats.t.ppf(0.975, len(one) - 1) for one in scores]
        colour = (*style.MORE_COLOURS[:3], *style.GROUPS[:2])[i]
        shown: dict[str, Any] = {"fmt": "o", "ms": 5, "lw": 1.5, "color": colour, "label": name}
        axes.errorbar(means, places + 0.13 * (i - 2), xerr=half, **shown)
    axes.set_yticks(places, [str(setup) for setup in by_setup])
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    axes.set(xlabel="mean success over the run", xlim=(0, None))
    picture.suptitle("Success by layout, in each set-up", **style.HEAD)
    picture.legend(loc="outside lower center", ncols=len(LAYOUTS) + 1)
    picture.savefig(folder / "setups.png", dpi=style.DPI, metadata={"Software": None})


TABLES = {
    "setups worth": show_worth,
    "setups layouts": show_layouts,
    "setups order": show_order,
    "setups predictors": show_predictors,
    "setups chosen": show_chosen,
    "setups dead": show_dead,
}
