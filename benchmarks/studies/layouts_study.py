"""Which layouts differ, and what predicts it? Tables of the study `layouts`, from its collected runs.

python -m benchmarks layouts_study

The questions stand in studies/layouts.toml. A cell is a set-up (a learner and a hand) with a layout, or
without touch; its samples are runs of independent seeds, which are not compared in pairs.
"""

from __future__ import annotations

import itertools
import re
from functools import cache

import numpy as np
import pandas as pd
import scipy.stats
from matplotlib.figure import Figure
from tactilerl import statistics, style
from tactilerl.statistics import Array, Estimate
from tactilerl.study.records import Record
from tactilerl.study.report import p_value

from benchmarks.command import data, markdown
from benchmarks.studies.study_tables import drawn, estimate, load

STUDY = "layouts"
PAPERS = tuple(f"layout {i}" for i in range(1, 7))
CHOSEN = ("4 chosen", "8 chosen")
LAYOUTS, NONE = PAPERS + CHOSEN, "no touch"
LEARNERS, HANDS = ("ppo", "ddpg_her"), ("mpl", "shadow", "allegro")
SETUPS = tuple(itertools.product(LEARNERS, HANDS))
PAIRS = tuple(itertools.combinations(range(len(LAYOUTS)), 2))
TEST, RUN = "last test", "mean over the run"
WINDOWS = {"a fifth": (0.0, 0.2), "half": (0.3, 0.5), "all": (0.8, 1.0)}
PREDICTORS = ("number of taxels", "area", "success at the first touch")
MARGIN, DEAD = 0.05, 0.05
N_RESAMPLES = 2_000
Cells = dict[tuple[str, str], list[Array]]
"""Scores (seeds,) of each layout, then without touch, in each set-up."""


def row(record: Record) -> dict[str, object]:
    """Return the cell of a run and its scores."""
    run, scene = record.config["run"], record.config["scene"]
    tests = record.column("final_test_success_rate")
    return {
        "setup": (run["algo"], run["env"]),
        "layout": title(scene["layout"]) if scene["touch"] == "on" else NONE,
        TEST: tests[np.isfinite(tests)][-1:].mean(),
        RUN: part(record, 0.0),
        **{name: part(record, begin, end) for name, (begin, end) in WINDOWS.items()},
    }


def title(layout: str) -> str:
    """Return the name of a layout in tables: `layout 1`, `4 chosen`."""
    match = re.fullmatch(r"docs/data/chosen/\w+_(\d+)\.toml", layout)
    return f"{match[1]} chosen" if match else f"layout {layout}"


def part(record: Record, begin: float, end: float = 1.0) -> float:
    """Return mean success between two fractions of a run's steps; a row is of those up to its own."""
    steps, values = record.column("env_steps"), record.column("success_rate")
    before = np.r_[0.0, steps[:-1]]
    until, since = np.minimum(steps, end * steps[-1]), np.maximum(before, begin * steps[-1])
    return float(np.average(values, weights=np.clip(until - since, 0.0, None)))


@cache
def runs() -> pd.DataFrame:
    """Return the finished runs of the study."""
    return pd.DataFrame([row(record) for record in load(STUDY)[1] if record.is_finished])


def cells(score: str = TEST) -> Cells:
    """Return a score of all runs by set-up and cell; set-ups with two runs in each cell."""
    groups = runs().groupby(["setup", "layout"])[score].apply(np.array).to_dict()
    found = {
        setup: [groups.get((setup, name), np.empty(0)) for name in (*LAYOUTS, NONE)] for setup in SETUPS
    }
    return {setup: of for setup, of in found.items() if min(map(len, of)) > 1}


def name_of(setup: tuple[str, str]) -> str:
    """Return a set-up as the tables call it."""
    learner, hand = setup
    return f"{style.NAMES[hand]}, {style.NAMES[learner]}"


def means(of: Cells) -> Array:
    """Return the mean of each cell, (set-ups, layouts and no touch)."""
    return np.array([[cell.mean() for cell in group] for group in of.values()])


def contrast(of: Cells, weights: Array, confidence: float = 0.95) -> tuple[Estimate, float]:
    """Return the mean over set-ups of weighted sums of their cells, and its p-value against 0.

    Welch's interval: each cell has a variance of its own, degrees of freedom are Satterthwaite's.
    """
    samples = [cell for group in of.values() for cell in group]
    factors = np.tile(weights, len(of)) / len(of)
    value = float(factors @ [cell.mean() for cell in samples])
    parts = np.array(
        [f**2 * cell.var(ddof=1) / len(cell) for f, cell in zip(factors, samples, strict=True)]
    )
    df = parts.sum() ** 2 / (parts**2 / [len(cell) - 1 for cell in samples]).sum()
    t = scipy.stats.t(df, value, np.sqrt(parts.sum()))
    low, high = t.interval(confidence)
    return Estimate(value, float(low), float(high)), float(2 * min(t.cdf(0.0), t.sf(0.0)))


def minus(i: int, j: int) -> Array:
    """Return the weights of one cell minus another."""
    weights = np.zeros(len(LAYOUTS) + 1)
    weights[i], weights[j] = 1.0, -1.0
    return weights


GAIN = np.r_[np.full(len(LAYOUTS), 1 / len(LAYOUTS)), -1.0]  # all layouts minus no touch


def resampled(of: Cells) -> tuple[Array, Array]:
    """Return means of cells from resampled seeds, and their squared standard errors.

    Each is (resamples, set-ups, layouts and no touch).
    """
    rng = np.random.default_rng(0)
    drawn = [[rng.choice(cell, (N_RESAMPLES, len(cell))) for cell in of[s]] for s in of]
    mean = np.array([[runs.mean(axis=1) for runs in group] for group in drawn])
    square = np.array([[runs.var(axis=1, ddof=1) / runs.shape[1] for runs in group] for group in drawn])
    return np.moveaxis(mean, -1, 0), np.moveaxis(square, -1, 0)


def parts_of(of: Cells) -> dict[str, Cells]:
    """Return each set-up alone, and all of them."""
    return {**{name_of(s): {s: group} for s, group in of.items()}, "all set-ups": of}


# -- 1 and 2: touch, and layouts ---------------------------------------------------------------


def show_touch() -> None:
    """Print what touch adds in each set-up, as the mean over the layouts."""
    of = cells()
    gains = [contrast({setup: group}, GAIN) for setup, group in of.items()]
    corrected = statistics.holm([p for _, p in gains])
    rows = []
    for (setup, group), (gain, _), p in zip(of.items(), gains, corrected, strict=True):
        levels = [f"{cell.mean():.2f}" for cell in group]
        rows.append((name_of(setup), len(group[-1]), *levels, estimate(gain, "+.2f"), p_value(p)))
    markdown(f"| set-up | seeds | {' | '.join((*LAYOUTS, NONE))} | touch − no touch | p, Holm |", rows)


def differences(of: Cells) -> list[Estimate]:
    """Return each pair of layouts, averaged over set-ups, with intervals that hold for all at once.

    They reach as far as the largest |t| of any pair in 95 % of the studies from resampled seeds.
    """
    left, right = np.transpose(PAIRS)

    def pairs(mean: Array, square: Array) -> tuple[Array, Array]:
        """Return differences and standard errors (..., pairs) from (..., set-ups, cells)."""
        level, variance = mean.mean(axis=-2), square.sum(axis=-2) / len(of) ** 2
        error = np.sqrt(variance[..., left] + variance[..., right])
        return level[..., left] - level[..., right], error

    squares = [[cell.var(ddof=1) / len(cell) for cell in group] for group in of.values()]
    value, error = pairs(means(of), np.array(squares))
    drawn, drawn_error = pairs(*resampled(of))
    largest = (np.abs(drawn - value) / np.maximum(drawn_error, 1e-12)).max(axis=1)
    reach = np.quantile(largest, 0.95) * error
    return [Estimate(*map(float, one)) for one in zip(value, value - reach, value + reach, strict=True)]


def differ(pairs: list[Estimate]) -> list[bool]:
    """Return which intervals leave out 0."""
    return [pair.low > 0 or pair.high < 0 for pair in pairs]


def show_pairs() -> None:
    """Print the pairs of layouts that differ somewhere, in each set-up and pooled."""
    by_part = {name: differences(of) for name, of in parts_of(cells()).items()}
    found = np.array([differ(pairs) for pairs in by_part.values()])
    rows = [("pairs that differ", *(f"{n} of {len(PAIRS)}" for n in found.sum(axis=1)))]
    for k in np.flatnonzero(found.any(axis=0)):
        i, j = PAIRS[k]
        values = (estimate(pairs[k], "+.2f") for pairs in by_part.values())
        rows.append((f"{LAYOUTS[i]} − {LAYOUTS[j]}", *values))
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


def show_agreement() -> None:
    """Print how far set-ups agree in the order of the layouts."""
    of, rows = cells(), []
    groups = {f"hands, {style.NAMES[one]}": [s for s in of if s[0] == one] for one in LEARNERS}
    for name, members in {"set-ups": [*of], **groups}.items():
        if len(members) > 2:
            values = means({setup: of[setup] for setup in members})[:, :-1]
            w, p = concordance(values)
            rows.append((name, f"Kendall's W {w:.2f}", f"p {p_value(p)}"))
    for hand in HANDS:
        both = {(learner, hand): of[learner, hand] for learner in LEARNERS if (learner, hand) in of}
        if len(both) == 2:
            drawn = [rank_correlation(*sample[:, :-1]) for sample in resampled(both)[0]]
            low, high = statistics.percentile_interval(np.array(drawn))
            value = Estimate(rank_correlation(*means(both)[:, :-1]), low, high)
            rows.append(
                (f"learners, {style.NAMES[hand]}", f"rank correlation {estimate(value, '.2f')}", "")
            )
    markdown("| over | agreement | test |", rows)


# -- 3: what predicts it -------------------------------------------------------------------------


def predictors(hands: list[str]) -> Array:
    """Return what may predict a layout's score, (hands, layouts, predictors).

    Success is of `tactilerl design --scene handover_anywhere --env HAND --taxels 1..8`.
    """
    known = data("first_touch")
    rows = [[known[hand][layout] for layout in LAYOUTS] for hand in hands]
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


def show_predictors() -> None:
    """Print the share of the variance between layouts that is predicted where one was left out."""
    rows = []
    for learner in LEARNERS:
        of = {setup: group for setup, group in cells().items() if setup[0] == learner}
        if len(of) < 2:
            continue
        x, y, drawn = predictors([hand for _, hand in of]), means(of)[:, :-1], resampled(of)[0]
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


def show_equivalence() -> None:
    """Print whether few placed taxels are as good as each of the paper's layouts."""
    rows = []
    for (name, of), few in itertools.product(parts_of(cells()).items(), CHOSEN):
        pairs = [contrast(of, minus(LAYOUTS.index(few), LAYOUTS.index(one)), 0.90)[0] for one in PAPERS]
        low, high = min(pair.low for pair in pairs), max(pair.high for pair in pairs)
        verdict = "cannot tell"
        if low > -MARGIN:
            verdict = "equivalent" if high < MARGIN else "as good"
        elif any(pair.high < -MARGIN for pair in pairs):
            verdict = "worse"
        rows.append((name, few, *(estimate(pair, "+.2f") for pair in pairs), verdict))
    markdown(f"| set-up | taxels | {' | '.join(f'− {one}' for one in PAPERS)} | verdict |", rows)


def show_dead() -> None:
    """Print how many runs end dead."""
    rows = []
    for setup, group in cells().items():
        rows.append((name_of(setup), *(f"{(cell < DEAD).sum()} of {len(cell)}" for cell in group)))
    markdown(f"| set-up | {' | '.join((*LAYOUTS, NONE))} |", rows)


def show_budgets() -> None:
    """Print what the first two questions say after a part of the run."""
    last, rows = means(cells())[:, :-1].mean(axis=0), []
    for name in (*WINDOWS, RUN, TEST):
        of = cells(name)
        alone = [sum(differ(differences({s: group}))) for s, group in of.items()]
        row = estimate(contrast(of, GAIN)[0], "+.2f"), np.mean(alone), sum(differ(differences(of)))
        correlation = rank_correlation(means(of)[:, :-1].mean(axis=0), last)
        rows.append((name, row[0], f"{row[1]:.1f}", row[2], f"{correlation:.2f}"))
    head = "| score | touch − no touch | pairs that differ in a set-up | pooled |"
    markdown(f"{head} rank correlation with the last test |", rows)


def picture() -> Figure:
    """Draw the last test of each layout in each set-up, with intervals over the seeds."""
    of = cells()
    levels = {
        name: [contrast({s: group}, weights)[0] for s, group in of.items()]
        for name, weights in zip((*LAYOUTS, NONE), np.eye(len(LAYOUTS) + 1), strict=True)
    }
    colours = *style.MORE_COLOURS[: len(PAPERS)], *style.GROUPS[:2], "0.6"
    figure = drawn(levels, [*map(name_of, of)], colours)
    figure.axes[0].set(xlabel="success in the last test, without noise", xlim=(0, 1))
    return figure


TABLES = {
    "layouts touch": show_touch,
    "layouts pairs": show_pairs,
    "layouts agreement": show_agreement,
    "layouts predictors": show_predictors,
    "layouts equivalence": show_equivalence,
    "layouts dead": show_dead,
    "layouts budgets": show_budgets,
}
