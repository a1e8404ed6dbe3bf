"""The layouts of studies/design.toml and setups.toml: chosen taxels, the dense skin they come from,
random sets of it; and what is chosen for the other hands.

python -m benchmarks design_layouts
"""

from __future__ import annotations

import numpy as np
from tactilerl.envs import hands, layouts
from tactilerl.envs.layouts import Taxels
from tactilerl.probe import candidates, design
from tactilerl.runs.cores import free_cores

from benchmarks.command import DATA, no_flags

NUMBERS = (1, 2, 4, 8, 14)
RANDOM = (4, 8)
SETS = 3
OTHERS, EIGHT = ("shadow", "allegro"), 8  # hands that carry no taxels chosen for the MPL hand
FOLDER = DATA / "chosen"


def main() -> None:
    """Writes them to docs/data/chosen."""
    no_flags(__doc__)
    flags = candidates.DesignFlags(taxels=f"1..{max(NUMBERS)}", beside=())
    made = design.design(flags, free_cores())
    for n in NUMBERS:
        _write(f"anywhere_{n}", made.layout(n).toml())
    for other in OTHERS:
        eight = candidates.DesignFlags(env=other, taxels=str(EIGHT), beside=())
        _write(f"{other}_anywhere_{EIGHT}", design.design(eight, free_cores()).layout(EIGHT).toml())
    hand = hands.get(made.result["env"])
    skin = candidates.candidates(flags, hand)

    def write(name: str, taxels: Taxels, about: str) -> None:
        _write(name, layouts.of_taxels(taxels, hand, about).toml())

    write("anywhere_skin", skin, f"a taxel every {flags.skin}: what the others are chosen from")
    rng = np.random.default_rng(0)
    for n in RANDOM:
        for i in range(1, SETS + 1):
            drawn = np.sort(rng.choice(len(skin), n, replace=False))
            write(f"anywhere_random_{n}_{i}", skin.take(drawn.tolist()), f"{n} random taxels")


def _write(name: str, text: str) -> None:
    (FOLDER / f"{name}.toml").write_text(text, encoding="utf-8")
