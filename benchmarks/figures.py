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
from adjustText import adjust_text

from benchmarks.command import ROOT
from tactilerl.envs import hands, layouts
from tactilerl.pictures.hand_map import TaxelMap

DOCS = ROOT / "docs"
WINDOW = 100  # episodes of the running success rate
SEEDS = range(3)
# Picture: title, what is drawn, what the runs' files begin with.
RUNS = {
    "learning_shadow_ppo": (
        "PPO, Shadow Hand in MuJoCo, lift-and-hold, layout 4",
        f"success rate, last {WINDOW} episodes",
        {"main": "ppo_shadow_layout4"},
    ),
    "learning_shadow_ddpg_her": (
        "DDPG+HER, Shadow Hand in MuJoCo, reach-goal, layout 2",
        "success rate of 20 test episodes",
        {
            "40 updates a cycle": "ddpg_her_shadow_layout2",
            "16 updates a cycle": "ddpg_her_shadow_layout2_n_batches16",
            "8 updates a cycle": "ddpg_her_shadow_layout2_n_batches8",
            "16, bfloat16": "ddpg_her_shadow_layout2_n_batches16_bfloat16",
        },
    ),
}
COLOURS = {
    "main": "#e0a800",  # as in the paper
    "40 updates a cycle": "#777777",
    "16 updates a cycle": "#e0a800",
    "8 updates a cycle": "#2b6cb0",
    "16, bfloat16": "#38a169",
}


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
    """Every setting of every hand in every simulator; those on the front filled and named. Settings
    with the shipped one's errors to the last digit are the same physics, and left out."""
    data = json.loads((DOCS / "data" / "speed_vs_error.json").read_text(encoding="utf-8"))
    figure, grid = plt.subplots(2, 2, figsize=(11, 9))
    for axes, (name, table) in zip(grid.flat, data.items(), strict=True):
        shipped = table["settings"]["as shipped"]
        held = {
            setting: row
            for setting, row in table["settings"].items()
            if row is shipped
            or row.get("error_median_mm", shipped["error_median_mm"]) != shipped["error_median_mm"]
        }
        front = pareto([(row["speed"], row["error_median_mm"]) for row in held.values()])
        labels = []
        for (setting, row), is_best in zip(held.items(), front, strict=True):
            is_shipped = setting == "as shipped"
            at = row["speed"], row["error_median_mm"]
            colour = "#b03020" if is_shipped else "#2b6cb0"
            style = "full" if is_best or is_shipped else "none"
            axes.plot(*at, "s" if is_shipped else "o", color=colour, fillstyle=style)
            if is_best or is_shipped:
                labels.append(axes.text(*at, setting, fontsize=8, color=colour))
        axes.set(title=name, yscale="log", xlabel="speed, shipped = 1", ylabel="error, median mm")
        axes.margins(0.12)
        axes.grid(alpha=0.3)
        adjust_text(labels, ax=axes, arrowprops={"arrowstyle": "-", "color": "#888888", "lw": 0.6})
    figure.tight_layout()
    figure.savefig(DOCS / "images" / "speed_vs_error.png", dpi=100)


def pareto(points: list[tuple[float, float]]) -> list[bool]:
    """Of (speed, error): which are such that none is at once faster and nearer?"""
    return [not any(s > speed and e < error for s, e in points) for speed, error in points]


def learning_curves(title: str, what: str, files: dict[str, str]) -> plt.Figure:
    """Seeds thin, their mean thick."""
    figure, axes = plt.subplots(figsize=(7, 4))
    for label, name in files.items():
        curves = [curve(DOCS / "data" / f"{name}_main_s{seed}.csv") for seed in SEEDS]
        for steps, rate in curves:
            axes.plot(steps, rate, color=COLOURS[label], lw=0.8, alpha=0.6)
        steps = np.unique(np.concatenate([steps for steps, _ in curves]))
        steps = steps[steps <= min(steps[-1] for steps, _ in curves)]
        mean = np.mean([np.interp(steps, *each) for each in curves], axis=0)
        axes.plot(
            steps, mean, color=COLOURS[label], lw=2.5, label=f"{label}, mean of {len(curves)} seeds"
        )
    axes.set(title=title, xlabel="environment steps", ylabel=what, ylim=(0, 1.02))
    axes.grid(alpha=0.3)
    axes.legend()
    figure.tight_layout()
    return figure


def layouts_unrolled() -> None:
    """The paper's six, on the Shadow Hand."""
    hand = hands.get("shadow")
    figure, grid = plt.subplots(2, 3, figsize=(8, 6.4))
    for axes, name in zip(grid.flat, layouts.PAPER, strict=True):
        layout = layouts.load(name)
        taxels = layout.place(hand)
        axes.imshow(TaxelMap(hand, taxels, 600).picture(np.zeros(len(taxels), bool)))
        axes.set_title(f"{name}: {layout.description}, {len(taxels)} taxels", fontsize=9)
        axes.axis("off")
    figure.tight_layout()
    figure.savefig(DOCS / "images" / "layouts.png", dpi=120)


def main() -> None:
    """Speed against error, the layouts, and one picture for each entry of RUNS."""
    speed_against_error()
    layouts_unrolled()
    for name, (title, what, files) in RUNS.items():
        learning_curves(title, what, files).savefig(DOCS / "images" / f"{name}.png", dpi=110)
