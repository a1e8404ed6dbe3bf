"""Draw the figures of the docs from the data committed beside them.

python -m benchmarks figures
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image
from tactilerl.envs import hands, layouts, scenes
from tactilerl.envs.grasp import GraspEnv, setup
from tactilerl.envs.simulators import Camera
from tactilerl.files import replacing
from tactilerl.pictures import render
from tactilerl.pictures.hand_map import TaxelMap
from tactilerl.study.analysis import analyse
from tactilerl.study.figures import curves
from tactilerl.style import DPI, HEAD, STYLE

from benchmarks.command import DATA, DOCS, no_flags
from benchmarks.studies import layouts_study, study_tables

IMAGES, FOUR = DOCS / "images", str(DATA / "chosen/anywhere_4.toml")
GRASPS = [("shadow", "mujoco"), ("mpl", "mujoco"), ("mpl", "pybullet"), ("allegro", "mujoco")]
# Collected study: its set-ups whose curves are drawn, and the pictures.
STUDIES = {
    "handover": {"handover": "study"},
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


def grasps() -> None:
    """Draw each hand in a scripted grasp."""
    for hand, simulator in GRASPS:
        scene, out = setup(hand, simulator=simulator, layout="1"), IMAGES / f"{hand}_{simulator}.png"
        render.picture(hand, scene, "grasp", Camera(), out)


def handover(name: str) -> None:
    """Draw a hand that closes around what the giver presses against it."""
    named = scenes.load(name)
    config = setup(named.env, **named.on(named.env))
    with closing(GraspEnv(named.env, config, render_mode="rgb_array")) as env:
        env.reset(seed=0)
        render.take(env)
        state = env.simulator.state()
        middle = (state.palm + state.object_position) / 2
        picture = env.picture(Camera(azimuth=0.0, elevation=-8.0, lookat=tuple(middle.tolist())))
        with replacing(IMAGES / f"{name}.png") as file:
            Image.fromarray(picture).save(file, "PNG")


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
        grasps()
        for name in ("handover", "handover_fingers"):
            handover(name)
        save(study_tables.picture(), "study_layouts")
        for study in layouts_study.COLLECTED:
            save(layouts_study.picture(study), f"{study}_study")
    for study, pictures in STUDIES.items():
        study_curves(study, pictures)
