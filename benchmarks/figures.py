"""Draw the figures of the docs from the data committed beside them.

python -m benchmarks figures
"""

from __future__ import annotations

import csv
import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from benchmarks.command import ROOT

DOCS = ROOT / "docs"
WINDOW = 100  # episodes of the running success rate
# Picture: title, what is drawn, the runs.
RUNS = {
    "learning_shadow_ppo": (
        "PPO, Shadow Hand in MuJoCo, lift-and-hold, layout 4",
        f"success rate, last {WINDOW} episodes",
        {"main, seed 0": "ppo_shadow_layout4_main_s0.csv"},
    ),
    "learning_shadow_ddpg_her": (
        "DDPG+HER, Shadow Hand in MuJoCo, reach-goal, layout 2",
        "success rate of 20 test episodes",
        {"main, seed 0": "ddpg_her_shadow_layout2_main_s0.csv"},
    ),
}
COLOURS = {"main": ("#e0a800", "#b07d00", "#f2cf63"), "control": ("#2b6cb0",)}  # as in the paper


def curve(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(steps, success rate) of a progress table: of the test episodes where there are some,
    else over at least the last WINDOW episodes."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    steps = np.array([float(row["env_steps"]) for row in rows])
    if "test_success_rate" in rows[0]:
        return steps, np.array([float(row["test_success_rate"]) for row in rows])
    episodes = np.array([float(row["episodes"]) for row in rows])
    successes = episodes * np.array([float(row["success_rate"]) for row in rows])
    rates = []
    for end in range(1, len(rows) + 1):
        start = end - 1
        while start > 0 and episodes[start:end].sum() < WINDOW:
            start -= 1
        rates.append(successes[start:end].sum() / episodes[start:end].sum())
    return steps, np.array(rates)


def speed_against_error() -> None:
    """Every setting of every hand in every simulator, those on the front filled."""
    data = json.loads((DOCS / "data" / "speed_vs_error.json").read_text(encoding="utf-8"))
    figure, grid = plt.subplots(2, 2, figsize=(10, 8))
    for axes, (name, table) in zip(grid.flat, data.items(), strict=True):
        for setting, row in table["settings"].items():
            if "error_median_mm" not in row:
                continue  # nothing was held
            is_shipped, on_front = setting == "as shipped", row.get("on_front", False)
            axes.plot(
                row["speed"], row["error_median_mm"], "s" if is_shipped else "o", color="#2b6cb0",
                fillstyle="full" if on_front else "none",
            )  # fmt: skip
            axes.annotate(f" {setting}", (row["speed"], row["error_median_mm"]), fontsize=6)
        axes.set(title=name, yscale="log", xlabel="speed, shipped = 1", ylabel="error, mm")
        axes.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(DOCS / "images" / "speed_vs_error.png", dpi=110)


def main() -> None:
    """Speed against error, and one picture for each entry of RUNS."""
    speed_against_error()
    for name, (title, what, files) in RUNS.items():
        figure, axes = plt.subplots(figsize=(7, 4))
        colours = {run_type: iter(some) for run_type, some in COLOURS.items()}
        for label, file in files.items():
            colour = next(colours[label.partition(",")[0]])
            axes.plot(*curve(DOCS / "data" / file), label=label, color=colour)
        axes.set(title=title, xlabel="environment steps", ylabel=what, ylim=(0, 1.02))
        axes.grid(alpha=0.3)
        axes.legend()
        figure.tight_layout()
        figure.savefig(DOCS / "images" / f"{name}.png", dpi=110)
