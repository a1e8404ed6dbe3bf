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
from tactilerl.study.records import Record
from tactilerl.study.report import p_value

from benchmarks.command import data, markdown
from benchmarks.studies.study_tables import DEAD, estimate, in_common, load, number, part, title

LAYOUTS = ("layout 1", "layout 2", "layout 5", "8 chosen")
PAPERS, CHOSEN, NONE = LAYOUTS[:-1], LAYOUTS[-1], "no touch"
RUN, END = 0.0, 0.8  # fractions of the steps from which on success counts
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


def in_whole_seeds(begin: float = RUN) -> Groups:
    """Return mean success from a fraction of the steps on, of seeds with a run of each layout and none.

    A set-up needs two such seeds.
    """
    scores: Groups = {}
    for setup, groups in by_layout().items():
        by_seed = [
            {record.run.seed: part(record, begin) for record in groups.get(name, [])}
            for name in (*LAYOUTS, NONE)
        ]
        seeds, values = in_common(by_seed)
        if len(seeds) >= 2:
            scores[setup] = values
    return scores


def in_mujoco(begin: float = RUN) -> Groups:
    """Return touch minus no touch within seeds, (layouts, seeds), in the set-ups of MuJoCo."""
    return {
        setup: groups[:-1] - groups[-1]
        for setup, groups in in_whole_seeds(begin).items()
        if setup.simulator == "mujoco"
    }


def show_worth() -> None:
    """Print what touch adds in each set-up: the mean over the layouts within each seed."""
    over_run, at_end = in_whole_seeds(), in_whole_seeds(END)
    # Five pairs cannot fall below 0.06 when signs are flipped, so these are t tests.
    gains = {setup: with_touch(groups) - groups[-1] for setup, groups in over_run.items()}
    corrected = statistics.holm([scipy.stats.ttest_1samp(g, 0).pvalue for g in gains.values()])
    rows = []
    for (setup, gain), p in zip(gains.items(), corrected, strict=True):
        groups, end = over_run[setup], at_end[setup]
        levels = f"{groups[-1].mean():.2f}", f"{with_touch(groups).mean():.2f}"
        last = t_interval(with_touch(end) - end[-1])
        rows.append((setup, len(gain), *levels, t_interval(gain), p_value(p), last))
    head = "| set-up | seeds | no touch | touch | touch − no touch | p, Holm | the same, last fifth |"
    markdown(head, rows)


def with_touch(groups: Array) -> Array:
    """Return the mean over the layouts, (seeds,), of scores (layouts and no touch, seeds)."""
    mean: Array = groups[:-1].mean(axis=0)
    return mean


def t_interval(differences: Array) -> str:
    """Return the mean of differences (seeds,) with its 95 % interval, as text."""
    return estimate(*over_setups([differences[None]]), "+.2f")


def show_layouts() -> None:
    """Print what each layout reaches over the run, and over its last fifth."""
    over_run, at_end = in_whole_seeds(), in_whole_seeds(END)
    levels = {
        str(setup): (groups.mean(axis=1), at_end[setup].mean(axis=1))
        for setup, groups in over_run.items()
    }
    levels["mean"] = tuple(np.mean([*levels.values()], axis=0))
    rows = [
        (name, *(f"{a:.2f} / {b:.2f}" for a, b in zip(*of, strict=True))) for name, of in levels.items()
    ]
    markdown(f"| set-up | {' | '.join((*LAYOUTS, NONE))} |", rows)


def show_dead() -> None:
    """Print how many of all runs end below DEAD, with touch and without."""
    rows, totals = [], np.zeros((len(LAYOUTS) + 1, 2), int)
    for setup, groups in by_layout().items():
        runs = [groups.get(name, []) for name in (*LAYOUTS, NONE)]
        counts = [(sum(part(r, 0.5) < DEAD for r in group), len(group)) for group in runs]
        totals += counts
        rows.append((setup, *(f"{dead} of {n}" for dead, n in counts)))
    rows.append(("all set-ups", *(f"{dead} of {n}" for dead, n in totals)))
    markdown(f"| set-up | {' | '.join((*LAYOUTS, NONE))} |", rows)


def show_chosen() -> None:
    """Print whether the chosen taxels are within MARGIN of each of the paper's layouts."""
    ahead = {
        setup: groups[len(PAPERS)] - groups[: len(PAPERS)] for setup, groups in in_whole_seeds().items()
    }
    parts = {str(setup): [one] for setup, one in ahead.items()}
    for learner in LEARNERS:
        of_learner = [one for setup, one in ahead.items() if setup.learner == learner]
        parts[f"{style.NAMES[learner]}, mean"] = of_learner
    parts["all set-ups, mean"] = [*ahead.values()]
    rows = []
    for name, differences in parts.items():
        cells = (estimate(one, "+.2f") for one in over_setups(differences))
        at_least, is_within = compared(differences)
        rows.append((name, *cells, number(at_least, "+.2f"), is_within))
    others = " | ".join(f"{CHOSEN} − {name}" for name in PAPERS)
    markdown(f"| set-up | {others} | lowest bound | within {MARGIN} |", rows)


def compared(differences: Sequence[Array]) -> tuple[float, str]:
    """Return how far the chosen taxels are ahead at least, and whether by −MARGIN or more.

    `differences` to the paper's layouts (layouts, seeds) are of one or several set-ups. One-sided
    95 % bounds: "yes" takes all of them, "no" one that is corrected for their number.
    """
    at_least = min(one.low for one in over_setups(differences, 0.90))
    at_most = min(one.high for one in over_setups(differences, 1 - 0.1 / len(PAPERS)))
    if at_most < -MARGIN:
        return at_least, "no"
    return at_least, "yes" if at_least > -MARGIN else "cannot tell"


def over_setups(differences: Sequence[Array], confidence: float = 0.95) -> list[Estimate]:
    """Return, by layout, the mean over these set-ups of differences (layouts, seeds).

    Intervals are those of t tests; over several set-ups, whose noise differs, after Satterthwaite.
    They hold for these set-ups, not for new ones.
    """
    means = np.mean([one.mean(axis=1) for one in differences], axis=0)
    parts = np.array([one.var(axis=1, ddof=1) / one.shape[1] for one in differences])
    spare = np.array([[one.shape[1] - 1] for one in differences])
    df = parts.sum(axis=0) ** 2 / (parts**2 / spare).sum(axis=0)
    scale = np.sqrt(parts.sum(axis=0)) / len(differences)
    limits = scipy.stats.t.interval(confidence, df, means, scale)
    return [Estimate(*map(float, one)) for one in zip(means, *limits, strict=True)]


def show_order() -> None:
    """Print whether MuJoCo's set-ups put the layouts into the same order, and differ alike."""
    rows = []
    for name, begin in (("mean over the run", RUN), ("last fifth", END)):
        gains = in_mujoco(begin)
        values = np.array([one.mean(axis=1) for one in gains.values()])
        w, p = concordance(values, [str(i) for i in range(len(values))])
        _, p_by_hand = concordance(values, [setup.hand for setup in gains])
        p_values = (p_value(one) for one in (p, p_by_hand, interaction([*gains.values()])))
        rows.append((name, len(gains), f"{w:.2f}", *p_values))
    head = "| gain by | set-ups | Kendall's W | p, by set-up | p, by hand | p of set-up × layout |"
    markdown(head, rows)


def show_between() -> None:
    """Print how far the paper's layouts are apart, as means over all set-ups."""
    pairs = [*itertools.combinations(range(len(PAPERS)), 2)]
    columns = []
    for begin in (RUN, END):
        groups = [*in_whole_seeds(begin).values()]
        gaps = [np.array([one[a] - one[b] for a, b in pairs]) for one in groups]
        columns.append([estimate(one, "+.3f") for one in over_setups(gaps)])
    names = [f"{PAPERS[a]} − {PAPERS[b]}" for a, b in pairs]
    rows = zip(names, *columns, strict=True)
    markdown("| mean over all set-ups | mean success over the run | last fifth |", rows)


def interaction(gains: Sequence[Array]) -> float:
    """Return the p-value of: layouts differ by the same amounts in all set-ups (layouts, seeds).

    The F test of set-up x layout, whose null is drawn with each set-up's own noise, normal and the
    same for its layouts. Layouts of one seed share what that seed does.
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


def prediction(predictor: Array, values: Array, blocks: Sequence[str]) -> tuple[float, float, float]:
    """Return the rank correlation of a predictor with values, averaged over set-ups, and two p-values.

    Both have shape (setups, layouts). The exact two-sided tests reorder the layouts of each block,
    such as a hand, in all ways; or those of all blocks in the same way.
    """
    ranks = (scipy.stats.rankdata(x, axis=-1) for x in (predictor, values))
    expected, reached = (scipy.stats.zscore(one, axis=-1) for one in ranks)
    orders = np.array([*itertools.permutations(range(values.shape[1]))])
    names, sums, shared = np.array(blocks), np.zeros(1), np.zeros(len(orders))
    for name in dict.fromkeys(blocks):
        (members,) = np.nonzero(names == name)
        by_order = expected[members[0]][orders] @ reached[members].sum(axis=0)
        sums = np.add.outer(sums, by_order).ravel()
        shared += by_order
    correlation, by_hand, in_common = (np.round(x / values.size, 9) for x in (sums[0], sums, shared))
    as_large = (np.abs(x) >= abs(correlation) for x in (by_hand, in_common))
    return float(correlation), *(float(one.mean()) for one in as_large)


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
        correlation, *p_values = prediction(predictor, values, hands)
        over_hands = []
        for learner in LEARNERS:
            is_of = [setup.learner == learner for setup in gains]
            result = scipy.stats.spearmanr(predictor[is_of].ravel(), values[is_of].ravel())
            over_hands.append(number(result.statistic, ".2f"))
        rows.append((name, number(correlation, ".2f"), *map(p_value, p_values), *over_hands))
    head = "| predictor of the gain | within a hand | p | p, the same order on all hands |"
    markdown(f"{head} over hands, PPO | over hands, DDPG+HER |", rows)


def draw(folder: Path) -> None:
    """Draw what each layout reaches in each set-up, with t intervals over the seeds."""
    by_setup = in_whole_seeds()
    rows = zip(*(over_setups([groups]) for groups in by_setup.values()), strict=True)
    levels = dict(zip((*LAYOUTS, NONE), rows, strict=True))
    picture = drawn(levels, [*map(str, by_setup)], (*style.MORE_COLOURS[:3], *style.GROUPS[:2]))
    picture.axes[0].set(xlabel="mean success over the run", xlim=(0, None))
    picture.suptitle("Success by layout, in each set-up", **style.HEAD)
    picture.savefig(folder / "setups.png", dpi=style.DPI, metadata={"Software": None})


def drawn(levels: dict[str, Sequence[Estimate]], names: list[str], colours: Sequence[str]) -> Figure:
    """Return a figure with a row for each set-up, by name, and in it the level of each layout."""
    picture = Figure(figsize=(7, 0.5 + 0.55 * len(names)), layout="constrained")
    axes, rows = picture.subplots(), np.arange(len(names))
    for i, (layout, of_layout) in enumerate(levels.items()):
        means, low, high = np.transpose([(one.value, one.low, one.high) for one in of_layout])
        places = rows + 0.65 / len(levels) * (i - (len(levels) - 1) / 2)
        shown: dict[str, Any] = {"fmt": "o", "ms": 5, "lw": 1.5, "color": colours[i], "label": layout}
        axes.errorbar(means, places, xerr=(means - low, high - means), **shown)
    axes.set_yticks(rows, names)
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    picture.legend(loc="outside lower center", ncols=5)
    return picture


TABLES = {
    "setups worth": show_worth,
    "setups layouts": show_layouts,
    "setups order": show_order,
    "setups between": show_between,
    "setups predictors": show_predictors,
    "setups chosen": show_chosen,
    "setups dead": show_dead,
}
