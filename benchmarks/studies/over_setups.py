"""What the set-ups of a collected study say together: the order of the cells, and a mixed model.

    python -m benchmarks over_setups docs/data/paper.tar.gz

Two or more set-ups with the same three or more cells, such as the paper's two with its six layouts:
do they put them into the same order? Set-ups that cross hands, simulators and algorithms: is the
treatment's effect the same in all of them?
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from benchmarks.command import parser, write
from benchmarks.printing import markdown
from benchmarks.studies import agreement
from tactilerl import statistics
from tactilerl.statistics import Estimate
from tactilerl.study import records
from tactilerl.study.analysis import Group, SetupResult, analyse

FACTORS = ("hand", "simulator", "algorithm")
COLUMNS = ["score", "treatment", *FACTORS, "cell"]
Orders = dict[str, Estimate]
"""Rank correlation by what the cells are ordered by."""


class Term(NamedTuple):
    """A fixed effect of the mixed model."""

    name: str
    effect: Estimate
    p_value: float


def mixed_model(table: pd.DataFrame) -> list[Term]:
    """Is the treatment's effect the same over hands, simulators and algorithms? (statsmodels'
    MixedLM)

    score ~ treatment x (each factor of two or more levels) + random intercept per cell (set-up x
    layout), of a table with a row a run and `COLUMNS`. Effects against the first level of each factor.
    ValueError where the model cannot be fitted.
    """
    from statsmodels.formula.api import mixedlm

    varied = [name for name in FACTORS if table[name].nunique() > 1]
    # Interactions of the treatment with each factor, not of the factors with each other.
    terms = " + ".join(f"C({name})" for name in varied)
    formula = "score ~ treatment" + (f" * ({terms})" if varied else "")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a variance of cells at its bound 0 is no fault
        try:
            fit = mixedlm(formula, table, groups=table["cell"]).fit(reml=True)
        except np.linalg.LinAlgError as error:
            raise ValueError(f"the mixed model cannot be fitted: {error}") from error
    bounds = fit.conf_int(1 - statistics.CONFIDENCE)
    return [
        Term(name, Estimate(float(value), *map(float, bounds.loc[name])), float(fit.pvalues[name]))
        for name, value in fit.fe_params.items()
    ]


def agreements(setups: Sequence[SetupResult], score: str) -> Orders:
    """Of the cells' order by the treatment alone and by its difference to the control."""
    compared = [one for one in setups if len(one.comparisons) > 1]
    cells = list(compared[0].comparisons) if compared else []
    compared = [one for one in compared if list(one.comparisons) == cells]
    if len(compared) < 2 or len(cells) < 3:
        return {}
    alone = [[_pair(one, cell)[0].scores[score] for cell in cells] for one in compared]
    pairs = [[one.comparisons[cell].verdict.pairs for cell in cells] for one in compared]
    gaps = [[each.treatment - each.control for each in row] for row in pairs]
    rng, found = np.random.default_rng(0), {}
    for name, runs in {"treatment": alone, "difference to the control": gaps}.items():
        if all(len(each) for row in runs for each in row):
            drawn = [
                [statistics.bootstrap(x, "mean", statistics.resample(rng, len(x))) for x in row]
                for row in runs
            ]
            values = np.array([[each.mean() for each in row] for row in runs])
            found[name] = agreement.rank_agreement(values, np.array(drawn))
    return found


def _pair(one: SetupResult, cell: str) -> tuple[Group, Group]:
    """Treatment and control of a cell that has both."""
    treatment, control = one.setup.arms[:2]
    return one.groups[cell, treatment], one.groups[cell, control]


def mixed(setups: Sequence[SetupResult], score: str) -> list[Term]:
    """The terms of the mixed model; ValueError where the set-ups do not cross."""
    compared = [one for one in setups if one.comparisons]
    kinds = {one.setup.name: _factors(one) for one in compared}
    levels = [len({kind[axis] for kind in kinds.values()}) for axis in range(3)]
    if len(set(kinds.values())) < 2 or math.prod(levels) != len(set(kinds.values())):
        raise ValueError(
            "no mixed model: the set-ups do not cross their hands, simulators and algorithms, "
            "so the effect of one cannot be told from that of another"
        )
    rows = [
        (reached, int(group.arm == one.setup.arms[0]), *kinds[one.setup.name], one.setup.name + cell)
        for one in compared
        for cell in one.comparisons
        for group in _pair(one, cell)
        for reached in group.scores[score]
    ]
    return mixed_model(pd.DataFrame(rows, columns=COLUMNS))


def _factors(one: SetupResult) -> tuple[str, str, str]:
    """(hand, simulator, algorithm); the environment where it has no hand."""
    config = next(record.config for record in one.records if record.config)
    scene = config.get("scene") or {}
    return config["run"]["env"], scene.get("simulator", "none"), config["run"]["algo"]


def main() -> None:
    """Both tables, or why there is none."""
    flags = parser(__doc__)
    flags.add_argument("study", type=Path, help="a study's folder or its collected file")
    options = flags.parse_args()
    study, found = records.load(options.study)
    setups = analyse(study, found).setups
    orders = agreements(setups, study.primary.score)
    rows = [(by, f"{x:.2f}", f"{low:.2f} to {high:.2f}") for by, (x, low, high) in orders.items()]
    if rows:
        markdown("| order of layouts by | rank correlation | 95 % |", rows)
    else:
        print("no order: it takes two set-ups with the same three cells")
    fitted: list[Term] = []
    try:
        fitted = mixed(setups, study.primary.score)
    except ValueError as error:
        print(error)
    else:
        rows = [
            (name, f"{x:.3f}", f"{low:.3f} to {high:.3f}", f"{p:.3f}")
            for name, (x, low, high), p in fitted
        ]
        markdown(f"| mixed model of the {study.primary.score} | effect | 95 % | p |", rows)
    write(options.out, {"agreement": orders, "mixed_model": fitted})
