"""Draw the figures of the docs from the data committed beside them.

python -m benchmarks figures
"""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from tactilerl.envs import hands, layouts
from tactilerl.pictures.hand_map import TaxelMap
from tactilerl.study.analysis import analyse
from tactilerl.study.figures import curves
from tactilerl.style import DPI, HEAD, STYLE

from benchmarks.command import DOCS, no_flags
from benchmarks.studies import setups_study, study_tables

IMAGES, FOUR = DOCS / "images", str(DOCS / "data/chosen/anywhere_4.toml")
# Collected study: its set-ups whose curves are drawn, and the pictures.
STUDIES = {
    "learners": {"ppo": "learning_shadow_ppo"},
    "paper": {"mujoco": "paper_mujoco", "pybullet": "paper_pybullet"},
}


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
        unrolled("layouts", "shadow", [*layouts.PAPER], 2, "Shadow Hand: the paper's six layouts")
        unrolled("design_places", "mpl", [FOUR, "1"], 1, "MPL hand: four chosen taxels, and layout 1")
        study_tables.draw(IMAGES)
        setups_study.draw(IMAGES)
    for study, pictures in STUDIES.items():
        study_curves(study, pictures)
