"""Draw the figures of the docs from the data committed beside them.

python benchmarks/figures.py
"""

from __future__ import annotations

import csv
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

DOCS = Path(__file__).resolve().parents[1] / "docs"
WINDOW = 100  # episodes of the running success rate
RUNS = {
    "learning_shadow_ppo": (
        "PPO, Shadow Hand in MuJoCo, lift-and-hold, layout 4, seed 0",
        {"main": "ppo_shadow_layout4_main_s0.csv", "control": "ppo_shadow_layout4_control_s0.csv"},
    )
}
COLOURS = {"main": "#e0a800", "control": "#2b6cb0"}  # the paper's: yellow and blue


def curve(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(steps, success rate over at least the last WINDOW episodes) of a progress table."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    steps = np.array([float(row["env_steps"]) for row in rows])
    episodes = np.array([float(row["episodes"]) for row in rows])
    successes = episodes * np.array([float(row["success_rate"]) for row in rows])
    rates = []
    for end in range(1, len(rows) + 1):
        start = end - 1
        while start > 0 and episodes[start:end].sum() < WINDOW:
            start -= 1
        rates.append(successes[start:end].sum() / episodes[start:end].sum())
    return steps, np.array(rates)


def main() -> None:
    """One picture for each entry of RUNS."""
    for name, (title, files) in RUNS.items():
        figure, axes = plt.subplots(figsize=(7, 4))
        for label, file in files.items():
            axes.plot(*curve(DOCS / "data" / file), label=label, color=COLOURS[label])
        axes.set(title=title, xlabel="environment steps", ylim=(0, 1))
        axes.set_ylabel(f"success rate, last {WINDOW} episodes")
        axes.grid(alpha=0.3)
        axes.legend()
        figure.tight_layout()
        figure.savefig(DOCS / "images" / f"{name}.png", dpi=110)


if __name__ == "__main__":
    main()
