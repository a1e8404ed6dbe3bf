"""What pairs of runs gain in the collected studies: correlation, and runs that an effect needs.

    python -m benchmarks pairs docs/data/{handover,paper}.tar.gz --out docs/data/pairs.json

A t test of a difference of 0.1 with a power of 0.8. Pairs of all cells of a set-up stand together,
about one mean, or each about the mean of its cell, as in `tactilerl study plan`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from tactilerl.statistics import final_rate
from tactilerl.study import records
from tactilerl.study.grid import SCORES, Setup
from tactilerl.study.planning import runs_needed, spread
from tactilerl.study.records import Record
from tactilerl.study.verdicts import BySeed, both_arms, in_pairs, runs_of

from benchmarks.command import parser, write
from benchmarks.printing import markdown

EFFECT, POWER, ALPHA = 0.1, 0.8, 0.05
LONG_TAIL = 0.3
PARTS = ("together", "within cells")
Cell = tuple[np.ndarray, np.ndarray]
"""Treatment and control, both (pairs,)."""


def cells(setup: Setup, found: list[Record], score: str) -> list[Cell]:
    """The pairs of each cell, by a score or the mean of the last 30 %."""
    paired = []
    for cell in setup.cells:
        if score in SCORES:
            both = both_arms(found, setup, cell, score)
        else:
            both = [last(runs_of(found, setup, cell, arm)) for arm in setup.arms[:2]]
        pairs = in_pairs(both, 100)
        paired.append((pairs.treatment, pairs.control))
    return paired


def last(runs: list[Record]) -> BySeed:
    """The mean of each run's last 30 %."""
    return {r.run.seed: float(final_rate(r.curve[1][None], LONG_TAIL)[0]) for r in runs}


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
            "runs_unpaired": runs_needed(EFFECT, sd_arm, POWER, ALPHA, in_pairs=False),
            "pairs": runs_needed(EFFECT, sd, POWER, ALPHA, in_pairs=True),
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
        "| runs of each group, unpaired → pairs | within settings |",
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
            if setup.compare and any(r.run.setup == setup.name and r.is_finished for r in found):
                for score in (*SCORES, "last 30 %"):
                    rows.append(row(study.name, setup.name, score, cells(setup, found, score)))
    content = {"effect": EFFECT, "power": POWER, "alpha": ALPHA, "rows": rows}
    show(content)
    write(options.out, content)
