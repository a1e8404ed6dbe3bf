"""Which layouts differ, and what predicts it? Tables of the collected studies of layouts.

python -m benchmarks layouts_study

The questions stand in studies/layouts.toml and layouts_pybullet.toml. A cell is a set-up (a learner and
a hand) with a layout, or without touch; its samples are runs of independent seeds, which are not
compared in pairs.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from functools import cache, partial

import numpy as np
import pandas as pd
import scipy.stats
from matplotlib.figure import Figure
from tactilerl import statistics, style
from tactilerl.statistics import Array, Estimate
from tactilerl.study.records import Record
from tactilerl.study.report import p_value

from benchmarks.command import DATA, data, markdown
from benchmarks.studies.study_tables import drawn, estimate, last_test, load, part

STUDIES: dict[str, tuple[str, ...]] = {"layouts": (), "layouts_pybullet": ("predictors",)}
"""Studies, with the questions that each does not ask."""
COLLECTED = [study for study in STUDIES if (DATA / f"{study}.tar.gz").is_file()]
NONE = "no touch"
LEARNERS, HANDS = ("ppo", "ddpg_her"), ("mpl", "shadow", "allegro")
TEST, RUN = "last test", "mean over the run"
WINDOWS = {"first fifth": (0.0, 0.2), "30 to 50 %": (0.3, 0.5), "last fifth": (0.8, 1.0)}
PREDICTORS = ("number of taxels", "area", "success at the first touch")
MARGIN, DEAD = 0.05, 0.05
N_RESAMPLES = 2_000
Cells = dict[tuple[str, str], dict[str, Array]]
"""Scores (seeds,) of each layout, then without touch, in each set-up; all have the same names."""


def row(record: Record) -> dict[str, object]:
    """Return the cell of a run and its scores."""
    run, scene = record.config["run"], record.config["scene"]
    return {
        "setup": (run["algo"], run["env"]),
        "layout": title(scene["layout"]) if scene["touch"] == "on" else NONE,
        TEST: last_test(record),
        RUN: part(record, 0.0),
        **{name: part(record, begin, end) for name, (begin, end) in WINDOWS.items()},
    }


def title(layout: str) -> str:
    """Return the name of a layout in tables: `layout 1`, `4 chosen`."""
    match = re.fullmatch(r"docs/data/chosen/\w+_(\d+)\.toml", layout)
    return f"{match[1]} chosen" if match else f"layout {layout}"


@cache
def runs(study: str) -> pd.DataFrame:
    """Return the runs of a study, of seeds whose runs are all finished."""
    records = load(study)[1]
    cut_off = {record.run.seed for record in records if not record.is_finished}
    return pd.DataFrame([row(record) for record in records if record.run.seed not in cut_off])


def cells(study: str, score: str = TEST) -> Cells:
    """Return a score of all runs by set-up and cell; set-ups with two runs in each cell."""
    groups = runs(study).groupby(["setup", "layout"])[score].apply(np.array).to_dict()
    present = {name for _, name in groups}
    names = [*sorted(present - {NONE}, key=lambda name: (name.endswith("chosen"), name)), NONE]
    found = {
        setup: {name: groups.get((setup, name), np.empty(0)) for name in names}
        for setup in itertools.product(LEARNERS, HANDS)
    }
    return {setup: of for setup, of in found.items() if min(map(len, of.values())) > 1}


def layouts(of: Cells) -> list[str]:
    """Return the layouts: the paper's in order, then those that were chosen."""
    return [name for name in next(iter(of.values())) if name != NONE]


def name_of(setup: tuple[str, str]) -> str:
    """Return a set-up as the tables call it."""
    learner, hand = setup
    return f"{style.NAMES[hand]}, {style.NAMES[learner]}"


def means(of: Cells) -> Array:
    """Return the mean of each cell, (set-ups, layouts and no touch)."""
    return np.array([[cell.mean() for cell in group.values()] for group in of.values()])


def contrast(
    of: Cells, weights: Mapping[str, float], confidence: float = 0.95
) -> tuple[Estimate, float]:
    """Return the mean over set-ups of weighted sums of cells, by name, and its p-value against 0.

    Welch's interval: each cell has a variance of its own, degrees of freedom are Satterthwaite's.
    """
    samples = [group[name] for group in of.values() for name in weights]
    factors = np.tile([*weights.values()], len(of)) / len(of)
    value = float(factors @ [cell.mean() for cell in samples])
    parts = factors**2 * [cell.var(ddof=1) / len(cell) for cell in samples]
    df = parts.sum() ** 2 / (parts**2 / [len(cell) - 1 for cell in samples]).sum()
    t = scipy.stats.t(df, value, np.sqrt(parts.sum()))
    low, high = t.interval(confidence)
    return Estimate(value, float(low), float(high)), float(2 * min(t.cdf(0.0), t.sf(0.0)))


def gain(of: Cells) -> dict[str, float]:
    """Return the weights of the mean over the layouts minus no touch."""
    return {**dict.fromkeys(layouts(of), 1 / len(layouts(of))), NONE: -1.0}


def resampled(of: Cells) -> Array:
    """Return means of cells from resampled seeds, (resamples, set-ups, layouts and no touch)."""
    rng = np.random.default_rng(0)

    def drawn(cell: Array) -> Array:
        return rng.choice(cell, (N_RESAMPLES, len(cell))).mean(axis=1)

    values = [[drawn(cell) for cell in group.values()] for group in of.values()]
    return np.moveaxis(np.array(values), -1, 0)


def parts_of(of: Cells) -> dict[str, Cells]:
    """Return each set-up alone, and all of them."""
    return {**{name_of(s): {s: group} for s, group in of.items()}, "all set-ups": of}


# -- 1 and 2: touch, and layouts ---------------------------------------------------------------


def show_touch(study: str) -> None:
    """Print what touch adds in each set-up, as the mean over the layouts."""
    of, rows = cells(study), []
    gains = [contrast({setup: group}, gain(of)) for setup, group in of.items()]
    corrected = statistics.holm([p for _, p in gains])
    for (setup, group), (added, _), p in zip(of.items(), gains, corrected, strict=True):
        levels = [f"{cell.mean():.2f}" for cell in group.values()]
        n_seeds = min(map(len, group.values()))
        rows.append((name_of(setup), n_seeds, *levels, estimate(added, "+.2f"), p_value(p)))
    names = " | ".join((*layouts(of), NONE))
    markdown(f"| set-up | seeds | {names} | touch − no touch | p, Holm |", rows)


def differences(of: Cells) -> dict[tuple[str, str], Estimate]:
    """Return each pair of layouts, averaged over set-ups, with simultaneous 95 % intervals.

    They are Tukey's, of each seed's mean over the set-ups.
    """
    n, names = min(len(cell) for group in of.values() for cell in group.values()), layouts(of)
    scores = np.array([[group[name][:n] for name in names] for group in of.values()]).mean(axis=0)
    test = scipy.stats.tukey_hsd(*scores)
    found = test.statistic, *test.confidence_interval()
    pairs = itertools.combinations(range(len(names)), 2)
    return {(names[i], names[j]): Estimate(*(float(each[i, j]) for each in found)) for i, j in pairs}


def differ(pairs: dict[tuple[str, str], Estimate]) -> list[tuple[str, str]]:
    """Return the pairs of layouts whose interval leaves out 0."""
    return [pair for pair, one in pairs.items() if one.low > 0 or one.high < 0]


def show_pairs(study: str) -> None:
    """Print the pairs of layouts that differ somewhere, in each set-up and pooled."""
    by_part = {name: differences(of) for name, of in parts_of(cells(study)).items()}
    pairs, found = by_part["all set-ups"], [*map(differ, by_part.values())]
    rows = [("pairs that differ", *(f"{len(some)} of {len(pairs)}" for some in found))]
    for pair in pairs:
        if any(pair in some for some in found):
            values = (estimate(each[pair], "+.2f") for each in by_part.values())
            rows.append((" − ".join(pair), *values))
    markdown(f"| | {' | '.join(by_part)} |", rows)


def rank_correlation(a: Array, b: Array) -> float:
    """Return Spearman's correlation of two rows of layouts."""
    return float(scipy.stats.spearmanr(a, b).statistic)


def concordance(values: Array) -> tuple[float, float]:
    """Return Kendall's W of the order of layouts over set-ups, (set-ups, layouts), and its p-value."""

    def w(*ranks: Array, axis: int) -> Array:
        sums: Array = np.sum(ranks, axis=0)
        return 12 * sums.var(axis=axis) / (len(ranks) ** 2 * (sums.shape[axis] ** 2 - 1))

    ranks = scipy.stats.rankdata(values, axis=1)
    of_orders = {"permutation_type": "pairings", "alternative": "greater", "vectorized": True}
    test = scipy.stats.permutation_test(ranks, w, **of_orders, n_resamples=N_RESAMPLES, rng=0)
    return float(test.statistic), float(test.pvalue)


def show_agreement(study: str) -> None:
    """Print how far set-ups agree in the order of the layouts."""
    of, rows = cells(study), []
    groups = {f"hands, {style.NAMES[one]}": [s for s in of if s[0] == one] for one in LEARNERS}
    for name, members in {"set-ups": [*of], **groups}.items():
        if len(members) > 2:
            values = means({setup: of[setup] for setup in members})[:, :-1]
            w, p = concordance(values)
            rows.append((name, f"Kendall's W {w:.2f}", f"p {p_value(p)}"))
    for hand in HANDS:
        both = {(learner, hand): of[learner, hand] for learner in LEARNERS if (learner, hand) in of}
        if len(both) == 2:
            drawn = [rank_correlation(*sample[:, :-1]) for sample in resampled(both)]
            low, high = statistics.percentile_interval(np.array(drawn))
            value = Estimate(rank_correlation(*means(both)[:, :-1]), low, high)
            rows.append(
                (f"learners, {style.NAMES[hand]}", f"rank correlation {estimate(value, '.2f')}", "")
            )
    markdown("| over | agreement | test |", rows)


# -- 3: what predicts it -------------------------------------------------------------------------


def predictors(hands: list[str], names: list[str]) -> Array:
    """Return what may predict a layout's score, (hands, layouts, predictors).

    Success is of `tactilerl design --scene handover_anywhere --env HAND --taxels 1..8`.
    """
    known = data("first_touch")
    rows = [[known[hand][layout] for layout in names] for hand in hands]
    return np.array([[(np.log(r["taxels"]), r["area_mm2"], r["success"]) for r in row] for row in rows])


def predicted(x: Array, y: Array, by_hand: bool) -> float:
    """Return the share of the variance of y (hands, layouts) within hands that x predicts, left out.

    x is (hands, layouts, predictors). A left-out layout is predicted from its hand's other layouts and
    the common slope; of a left-out hand, differences from its mean are.
    """
    n_hands, n_layouts = y.shape
    sum_of_errors = sum_of_squares = 0.0
    for h, k in itertools.product(range(n_hands), [slice(None)] if by_hand else range(n_layouts)):
        keep = np.ones((n_hands, n_layouts), bool)
        keep[h, k] = False
        others = keep[h] if keep[h].any() else ~keep[h]
        rows = [(x[i][keep[i]], y[i][keep[i]]) for i in range(n_hands) if keep[i].sum() > 1]
        centred = [(a - a.mean(axis=0), b - b.mean()) for a, b in rows]
        slope = np.linalg.lstsq(*map(np.concatenate, zip(*centred, strict=True)))[0]
        expected = y[h][others].mean() + (x[h, k] - x[h][others].mean(axis=0)) @ slope
        sum_of_errors += float(np.square(y[h, k] - expected).sum())
        sum_of_squares += float(np.square(y[h, k] - y[h][others].mean()).sum())
    return 1.0 - sum_of_errors / sum_of_squares


def show_predictors(study: str) -> None:
    """Print the share of the variance between layouts that is predicted where one was left out."""
    rows = []
    for learner in LEARNERS:
        of = {setup: group for setup, group in cells(study).items() if setup[0] == learner}
        if len(of) < 2:
            continue
        x = predictors([hand for _, hand in of], layouts(of))
        y, drawn = means(of)[:, :-1], resampled(of)
        for name, columns in {
            **{n: [i] for i, n in enumerate(PREDICTORS)},
            "all three": [0, 1, 2],
        }.items():
            shares = []
            for by_hand in (True, False):
                samples = [predicted(x[..., columns], sample[:, :-1], by_hand) for sample in drawn]
                low, high = statistics.percentile_interval(np.array(samples))
                value = Estimate(predicted(x[..., columns], y, by_hand), low, high)
                shares.append(estimate(value, ".2f"))
            rows.append((style.NAMES[learner], name, *shares))
    markdown("| learner | predictor | a hand left out | a layout left out |", rows)


# -- 4, 5, 6: few taxels, dead runs, budgets -----------------------------------------------------


def show_equivalence(study: str) -> None:
    """Print whether few placed taxels are as good as each of the paper's layouts.

    "as good" and "equivalent" are true of all of them, "worse" of any, so its tests are
    corrected for their number (Bonferroni).
    """
    all_cells, rows = cells(study), []
    chosen = [name for name in layouts(all_cells) if name.endswith("chosen")]
    papers = [name for name in layouts(all_cells) if name not in chosen]
    for (name, of), few in itertools.product(parts_of(all_cells).items(), chosen):
        pairs, corrected = (
            [contrast(of, {few: 1.0, one: -1.0}, confidence)[0] for one in papers]
            for confidence in (0.90, 1.0 - 0.10 / len(papers))
        )
        low, high = min(pair.low for pair in pairs), max(pair.high for pair in pairs)
        verdict = "cannot tell"
        if low > -MARGIN:
            verdict = "equivalent" if high < MARGIN else "as good"
        elif any(pair.high < -MARGIN for pair in corrected):
            verdict = "worse"
        rows.append((name, few, *(estimate(pair, "+.2f") for pair in pairs), verdict))
    markdown(f"| set-up | taxels | {' | '.join(f'− {one}' for one in papers)} | verdict |", rows)


def show_dead(study: str) -> None:
    """Print how many runs end dead."""
    of = cells(study)
    rows = [
        (name_of(setup), *(f"{(cell < DEAD).sum()} of {len(cell)}" for cell in group.values()))
        for setup, group in of.items()
    ]
    markdown(f"| set-up | {' | '.join((*layouts(of), NONE))} |", rows)


def show_budgets(study: str) -> None:
    """Print what the first two questions say after a part of the run."""
    last, rows = means(cells(study))[:, :-1].mean(axis=0), []
    for name in (*WINDOWS, RUN, TEST):
        of = cells(study, name)
        added = estimate(contrast(of, gain(of))[0], "+.2f")
        alone = np.mean([len(differ(differences({s: group}))) for s, group in of.items()])
        correlation = rank_correlation(means(of)[:, :-1].mean(axis=0), last)
        rows.append(
            (
                name,
                added,
                f"{alone:.1f}",
                len(differ(differences(of))),
                f"{correlation:.2f}".replace("-", "−"),
            )
        )
    head = "| score | touch − no touch | pairs that differ, mean per set-up | pooled |"
    markdown(f"{head} rank correlation with the last test |", rows)


def with_intervals(group: Mapping[str, Array]) -> dict[str, Estimate]:
    """Return the mean of each cell of a set-up, with 95 % intervals from the spread that all share."""
    squares = sum(((cell - cell.mean()) ** 2).sum() for cell in group.values())
    df = sum(len(cell) - 1 for cell in group.values())
    found = {}
    for name, cell in group.items():
        low, high = scipy.stats.t(df, cell.mean(), np.sqrt(squares / df / len(cell))).interval(0.95)
        found[name] = Estimate(float(cell.mean()), float(low), float(high))
    return found


def picture(study: str) -> Figure:
    """Draw the last test of each layout in each set-up, with intervals over the seeds."""
    of = cells(study)
    by_setup = [*map(with_intervals, of.values())]
    levels = {name: [one[name] for one in by_setup] for name in (*layouts(of), NONE)}
    colours = (*style.MORE_COLOURS, *style.GROUPS)[: len(levels) - 1]
    figure = drawn(levels, [*map(name_of, of)], (*colours, "0.6"))
    figure.axes[0].set(xlabel="success in the last test, without noise", xlim=(0, 1))
    return figure


QUESTIONS = {
    "touch": show_touch,
    "pairs": show_pairs,
    "agreement": show_agreement,
    "predictors": show_predictors,
    "equivalence": show_equivalence,
    "dead": show_dead,
    "budgets": show_budgets,
}
TABLES = {  # of studies that have been run
    f"{study} {name}": partial(show, study)
    for study in COLLECTED
    for name, show in QUESTIONS.items()
    if name not in STUDIES[study]
}
