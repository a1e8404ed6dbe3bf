"""A study's scores for other programs: unrounded as CSV, and as arrays that rliable takes."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from .. import statistics
from ..statistics import Array
from .analysis import Analysis, SetupResult
from .grid import SCORES


def scores(analysis: Analysis) -> bytes:
    """A row for each arm and score, and for each difference in pairs: its estimate, low and high."""
    return pd.DataFrame(_rows(analysis)).to_csv(index=False, lineterminator="\n").encode()


def _rows(analysis: Analysis) -> Iterator[dict[str, Any]]:
    for one in analysis.setups:
        for (cell, arm), group in one.groups.items():
            for score in SCORES:
                mean = statistics.mean(group.scores[score], group.counts)._asdict()
                yield _row(one, cell, one.setup.label(arm), score, len(group), mean)
        difference = " − ".join(map(one.setup.label, one.setup.arms[:2]))
        for cell, found in one.comparisons.items():
            verdict = found.verdict
            primary = {analysis.study.primary.score: verdict.pairs}
            for score, pairs in (primary | found.secondary).items():
                row = _row(one, cell, difference, score, len(pairs), pairs.difference._asdict())
                yield row | ({"p_holm": verdict.p_holm} if score in primary else {})


def _row(
    one: SetupResult, cell: str, arm: str, score: str, n: int, found: dict[str, float]
) -> dict[str, Any]:
    estimate = {"estimate": found["value"], "low": found["low"], "high": found["high"]}
    return {"setup": one.setup.name, "setting": cell, "arm": arm, "score": score, "n": n} | estimate


def arrays(analysis: Analysis) -> bytes:
    """The primary score by arm, (runs, settings), as npz: of the seeds that all settings have.

    `dict(numpy.load("scores.npz"))` is what rliable calls a score dictionary.
    """
    found: dict[str, Array] = {}
    for one in analysis.setups:
        for arm in one.setup.arms:
            by_seed = [
                dict(zip(group.seeds, group.scores[analysis.study.primary.score], strict=True))
                for (_, other), group in one.groups.items()
                if other == arm
            ]
            seeds = [seed for seed in one.setup.seeds if all(seed in each for each in by_seed)]
            if by_seed and seeds:
                parts = [one.setup.name if len(analysis.setups) > 1 else "", one.setup.label(arm)]
                table = [[each[seed] for each in by_seed] for seed in seeds]
                found[", ".join(filter(None, parts))] = np.array(table)
    file = io.BytesIO()
    np.savez(file, **found)  # type: ignore[arg-type]
    return file.getvalue()
