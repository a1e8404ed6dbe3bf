"""A study's scores for other programs: unrounded as CSV, and as arrays that rliable takes."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from .. import statistics
from ..statistics import Array
from .analysis import Analysis
from .grid import SCORES

COLUMNS = ["setup", "setting", "arm", "score", "n", "estimate", "low", "high", "p_holm"]


def scores(analysis: Analysis) -> bytes:
    """A row for each arm and score, and for each difference in pairs: its estimate, low and high."""
    table = pd.DataFrame(_rows(analysis), columns=COLUMNS).dropna(
        axis="columns", how="all"
    )
    return table.to_csv(index=False, lineterminator="\n").encode()


def _rows(analysis: Analysis) -> Iterator[tuple[Any, ...]]:
    primary = analysis.study.primary.score
    for one in analysis.setups:
        for (cell, arm), group in one.groups.items():
            for score in SCORES:
                mean = statistics.mean(group.scores[score], group.counts)
                yield (
                    one.setup.name,
                    cell,
                    one.setup.label(arm),
                    score,
                    len(group),
                    *mean,
                    None,
                )
        difference = " − ".join(map(one.setup.label, one.setup.arms[:2]))
        for cell, found in one.comparisons.items():
            for score, pairs in (
                {primary: found.verdict.pairs} | found.secondary
            ).items():
                p_holm = found.verdict.p_holm if score == primary else None
                yield (
                    one.setup.name,
                    cell,
                    difference,
                    score,
                    len(pairs),
                    *pairs.difference,
                    p_holm,
                )


def arrays(analysis: Analysis) -> bytes:
    """The primary score by arm, (runs, settings), as npz: of the seeds that all settings have.

    `dict(numpy.load("scores.npz"))` is what rliable calls a score dictionary.
    """
    found: dict[str, Array] = {}
    for one in analysis.setups:
        for arm in one.setup.arms:
            table = pd.DataFrame({
                cell: pd.Series(group.scores[analysis.study.primary.score], group.seeds)
                for (cell, other), group in one.groups.items()
                if other == arm
            })  # fmt: skip
            table = table.reindex(one.setup.seeds).dropna()
            if table.size:
                parts = [
                    one.setup.name if len(analysis.setups) > 1 else "",
                    one.setup.label(arm),
                ]
                found[", ".join(filter(None, parts))] = np.ascontiguousarray(table)
    file = io.BytesIO()
    np.savez(file, **found)  # type: ignore[arg-type]
    return file.getvalue()
