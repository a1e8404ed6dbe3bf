"""Collect what may predict how well a layout is learned: taxels, area, success at the first touch.

for hand in mpl shadow allegro; do
    tactilerl design --scene handover_anywhere --env $hand --taxels 1..8 --out FOLDER/$hand
done
python -m benchmarks first_touch --designs FOLDER --out docs/data/first_touch.json
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from tactilerl.envs import hands, layouts

from benchmarks.command import DATA, earlier, parser, write

PAPERS = "123456"
N_CHOSEN = 4, 8


def of_hand(hand_name: str, design: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Return the numbers of the paper's layouts and of chosen taxels, by the names that tables have."""
    hand, found = hands.get(hand_name), {}
    for row in design["rows"]:
        if row["layout"] in PAPERS:
            name, layout = f"layout {row['layout']}", row["layout"]
        elif row["layout"] == "chosen" and row["taxels"] in N_CHOSEN:
            name = f"{row['taxels']} chosen"
            layout = str(DATA / "chosen" / f"{hand_name}_touch_{row['taxels']}.toml")
        else:
            continue
        radii = layouts.load(layout).place(hand).radii
        area = 1e6 * math.pi * float((radii**2).sum())
        found[name] = {"taxels": len(radii), "area_mm2": round(area, 2), "success": row["success"]}
    return found


def main() -> None:
    """Read the designs of all hands."""
    arguments = parser(__doc__)
    arguments.add_argument("--designs", type=Path, required=True, help="folder with one for each hand")
    chosen = arguments.parse_args()
    found = {}
    for path in sorted(chosen.designs.glob("*/design.json")):
        hand = path.parent.name
        found[hand] = of_hand(hand, earlier(path))
    print(json.dumps(found, indent=1))
    write(chosen.out, found)
