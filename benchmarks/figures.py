"""Draw the figures of the docs from the data committed beside them.

python -m benchmarks figures
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from adjustText import adjust_text
from matplotlib.ticker import LogLocator, NullFormatter
from tactilerl.envs import hands, layouts
from tactilerl.pictures.hand_map import TaxelMap
from tactilerl.study.analysis import analyse
from tactilerl.study.figures import curves
from tactilerl.style import DPI, HEAD, NAMES, OTHERS, STYLE

from benchmarks.command import DOCS, data, no_flags
from benchmarks.studies import study_tables

IMAGES, FOUR = DOCS / "images", str(DOCS / "data/chosen/anywhere_4.toml")
SETTING, SHIPPED = OTHERS[:2]
# Collected study: its set-ups whose curves are drawn, and the pictures.
STUDIES = {
    "learners": {"ppo": "learning_shadow_ppo"},
    "paper": {"mujoco": "paper_mujoco", "pybullet": "paper_pybullet"},
}


def speed_against_error() -> None:
    """Draw every setting of every hand in every simulator."""
    figure, grid = plt.subplots(2, 2, figsize=(9, 8), layout="constrained")
    labels = []
    for axes, (name, table) in zip(grid.flat, data("speed_vs_error").items(), strict=True):
        labels.append(settings(axes, table["settings"]))
        hand, _, simulator = name.split()
        axes.set_title(f"{NAMES[hand]} in {NAMES[simulator]}")
        axes.set(yscale="log", xlabel="speed, as shipped = 1", ylabel="median error, mm")
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.margins(0.14)
    figure.suptitle("Physics settings: scripted grasps against a reference with small steps", **HEAD)
    figure.canvas.draw()  # so that the labels know where they are
    figure.set_layout_engine("none")
    for axes, (texts, points) in zip(grid.flat, labels, strict=True):
        arrow = {"arrowstyle": "-", "color": "#888888", "lw": 0.6}
        adjust_text(texts, *points, ax=axes, expand=(1.3, 1.8), arrowprops=arrow, iter_lim=300)
    save(figure, "speed_vs_error")


def settings(axes: Any, rows: dict[str, dict[str, Any]]) -> tuple[list[Any], np.ndarray]:
    """Draw a point for each setting; return the names beside them, and the points (2, n).

    Settings with the shipped errors to the last digit are the same physics, and left out; so are
    those that held nothing.
    """
    error = "error_median_mm"
    shipped = rows["as shipped"]
    held = {
        name: (row["speed"], row[error])
        for name, row in rows.items()
        if row is shipped or row.get(error, shipped[error]) != shipped[error]
    }
    texts = []
    for name, at in held.items():
        is_shipped = name == "as shipped"
        is_best = not any(speed > at[0] and least < at[1] for speed, least in held.values())
        colour = SHIPPED if is_shipped else SETTING
        style = "full" if is_best or is_shipped else "none"
        axes.plot(*at, "s" if is_shipped else "o", color=colour, fillstyle=style)
        if is_best or is_shipped:
            texts.append(axes.text(*at, name, fontsize=8, color=colour))
    return texts, np.array(list(held.values())).T


def study_curves(study: str, pictures: dict[str, str]) -> None:
    """Draw the learning curves of some set-ups, as the report of their study does."""
    for one in analyse(*study_tables.load(study)).setups:
        if one.setup.name in pictures:
            picture = curves(one, "png")
            (IMAGES / f"{pictures[one.setup.name]}.png").write_bytes(picture)


def unrolled(picture: str, hand: str, names: Sequence[str], rows: int, title: str) -> None:
    """Draw some layouts on an unrolled hand."""
    columns = len(names) // rows
    size = 7.4 / 3 * columns, 3.2 * rows
    figure, grid = plt.subplots(rows, columns, figsize=size, layout="constrained")
    for axes, name in zip(grid.flat, names, strict=True):
        layout = layouts.load(name)
        taxels = layout.place(hands.get(hand))
        drawn = TaxelMap(hands.get(hand), taxels, height=900)
        axes.imshow(drawn.picture(np.zeros(len(taxels), bool)))
        named = f"layout {name}, {len(taxels)} taxels\n{layout.description}"
        axes.set_title("chosen, 4 taxels" if name == FOUR else named, fontsize="medium")
        axes.axis("off")
    figure.suptitle(title, **HEAD)
    save(figure, picture)


def save(figure: plt.Figure, name: str) -> None:
    """Save a figure as PNG on white, which dark pages show as a card."""
    figure.savefig(IMAGES / f"{name}.png", dpi=DPI, metadata={"Software": None})
    plt.close(figure)


def main() -> None:
    """Draw every figure that comes from docs/data, in the style of the studies' reports."""
    no_flags(__doc__)
    with matplotlib.rc_context(STYLE):
        speed_against_error()
        unrolled("layouts", "shadow", [*layouts.PAPER], 2, "Shadow Hand: the paper's six layouts")
        unrolled("design_places", "mpl", [FOUR, "1"], 1, "MPL hand: four chosen taxels, and layout 1")
        study_tables.draw(IMAGES)
    for study, pictures in STUDIES.items():
        study_curves(study, pictures)
