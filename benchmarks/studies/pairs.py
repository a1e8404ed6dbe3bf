"""What pairs of runs gain in the collected studies: correlation, and runs that an effect needs.

    python -m benchmarks pairs docs/data/{handover,paper}.tar.gz --out docs/data/pairs.json

A t test of a difference of 0.1 with a power of 0.8. Pairs of all cells of a set-up stand together,
about one mean, or each about the mean of its cell, as in `tactilerl study plan`.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.command import parser, write
from benchmarks.printing import markdown
from tactilerl import statistics
from tactilerl.study import records
from tactilerl.study.grid import SCORES, Setup
from tactilerl.study.planning import spread
from tactilerl.study.records import Record
from tactilerl.study.verdicts import is_finished, scores

EFFECT, POWER, ALPHA = 0.1, 0.8, 0.05
LONG_TAIL = 0.3
PARTS = ("together", "within cells")
Cell = tuple[np.ndarray, np.ndarray]
"""Treatment and control, both (pairs,)."""


def reached(record: Record, measure: str) -> dict[str, float]:
    """All scores of a run, and the mean of the last 30 %."""
    tail = statistics.final_rate(record.curve(measure)[1][None], LONG_TAIL)[0]
    return {**scores(record, measure), "last 30 %": float(tail)}


def cells(setup: Setup, of_setup: list[Record], score: str) -> list[Cell]:
    """The pairs of each cell, from finished runs."""
    found: dict[tuple[str, str], dict[int, float]] = defaultdict(dict)
    for r in of_setup:
        found[r.run.cell, r.run.arm][r.run.seed] = reached(r, setup.measure)[score]
    paired = []
    for cell in setup.cells:
        a, b = (found[cell, arm] for arm in setup.arms[:2])
        seeds = sorted(a.keys() & b.keys())
        paired.append((np.array([a[seed] for seed in seeds]), np.array([b[seed] for seed in seeds])))
    return paired


def row(study: str, setup: str, score: str, of_cells: list[Cell]) -> dict[str, Any]:
    """What the pairs of a set-up say, together and within cells."""
    together = [(np.concatenate([a for a, _ in of_cells]), np.concatenate([b for _, b in of_cells]))]
    found: dict[str, Any] = {"study": study, "setup": setup, "score": score}
    found["pairs"] = len(together[0][0])
    found["difference"] = float(np.mean(together[0][0] - together[0][1]))
    for name, some in zip(PARTS, (together, of_cells), strict=True):
        correlation, sd, sd_arm = spread(some)
        found[name] = {
            "correlation": None if np.isnan(correlation) else correlation,
            "runs_unpaired": statistics.runs_needed(EFFECT, sd_arm, POWER, ALPHA, in_pairs=False),
            "pairs": statistics.runs_needed(EFFECT, sd, POWER, ALPHA, in_pairs=True),
        }
    return found


def show(content: dict[str, Any]) -> None:
    """A line per study and score, as Markdown."""
    rows = []
    for one in content["rows"]:
        name = f"`{one['study']}`, {one['setup']}" if one["score"] == "area" else ""
        r = one["together"]["correlation"]
        correlation = "–" if r is None else f"{r:.2f}".replace("-", "−")
        needed = (f"{one[part]['runs_unpaired']} → {one[part]['pairs']}" for part in PARTS)
        rows.append((name, one["score"], one["pairs"], correlation, *needed))
    markdown(
        "| study | score | pairs | correlation within seeds "
        "| runs of each arm, unpaired → pairs | within cells |",
        rows,
    )


def main() -> None:
    """Read collected studies, print the table, write JSON."""
    flags = parser(__doc__)
    flags.add_argument("studies", nargs="+", type=Path)
    options = flags.parse_args()
    rows = []
    for path in options.studies:
        study, found = records.load(path)
        for setup in study.setups:
            own = [r for r in found if r.run.setup == setup.name and is_finished(r, setup.measure)]
            if setup.compare and own:
                for score in (*SCORES, "last 30 %"):
                    rows.append(row(study.name, setup.name, score, cells(setup, own, score)))
    content = {"effect": EFFECT, "power": POWER, "alpha": ALPHA, "rows": rows}
    show(content)
    write(options.out, content)
