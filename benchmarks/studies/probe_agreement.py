"""Do hands and simulators agree about layouts?

Rank correlation of the gains that `tactilerl probe` found, with an interval.

    python -m benchmarks probe_agreement probes/shadow_mujoco probes/mpl_mujoco ... --out agreement.json

Reads gains.npz of each folder: the gain of each layout in all grasps, then in bootstrap samples.
Two folders' grasps are independent of each other, and so are their samples.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.command import parser, write
from benchmarks.printing import interval, markdown
from benchmarks.studies.agreement import rank_agreement
from benchmarks.studies.probe_tables import in_words


def gains(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """(1 + resamples,) of each layout, by joint noise."""
    found: dict[str, dict[str, np.ndarray]] = {}
    with np.load(folder / "gains.npz") as data:
        for key in data.files:
            noise, _, layout = key.partition(" ")
            found.setdefault(noise, {})[layout] = data[key]
    return found


def agreement(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> dict[str, Any]:
    """Spearman's rank correlation of the layouts that both have, with a percentile interval."""
    layouts = [name for name in a if name in b]
    n = min(len(found[layouts[0]]) for found in (a, b))
    both = np.array([[found[name][:n] for name in layouts] for found in (a, b)])
    value, *ends = rank_agreement(both[..., 0], both[..., 1:])
    return {"layouts": layouts, "spearman": value, "interval": ends}


def show(rows: list[dict[str, Any]]) -> None:
    """As Markdown."""
    noises = sorted({row["joint_noise"] for row in rows})
    cells = {
        (row["a"], row["b"], row["joint_noise"]): interval(row["spearman"], *row["interval"])
        for row in rows
    }
    head = " | ".join(f"{noise:g} rad of noise" for noise in noises)
    pairs = dict.fromkeys((a, b) for a, b, _ in cells)
    markdown(
        f"| | | {head} |",
        ((in_words(a), in_words(b), *(cells[a, b, noise] for noise in noises)) for a, b in pairs),
    )


def main() -> None:
    """Print a table, write JSON."""
    flags = parser(__doc__)
    flags.add_argument("folders", nargs="+", type=Path)
    args = flags.parse_args()
    found = {folder.name: gains(folder) for folder in args.folders}
    rows = [
        {"joint_noise": float(noise), "a": a, "b": b, **agreement(one[noise], other[noise])}
        for (a, one), (b, other) in itertools.combinations(found.items(), 2)
        for noise in one
        if noise in other
    ]
    show(rows)
    write(args.out, rows)
