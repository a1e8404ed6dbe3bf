"""A page on which one places taxels: one file, which works offline in any browser."""

from __future__ import annotations

import base64
import json
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..envs import layouts
from ..pictures import hand_map
from ..pictures.hand_map import LETTERS, Unrolled
from ..style import NAMES
from .choice import Design
from .cover import Starts

TEMPLATE = Path(__file__).with_name("design.html")


def page(design: Design) -> bytes:
    """Return the page of a design."""
    data = zlib.compress(json.dumps(_data(design)).encode(), 9)
    html = TEMPLATE.read_text(encoding="utf-8")
    return html.replace("@DATA@", base64.b64encode(data).decode()).encode()


def _data(design: Design) -> dict[str, Any]:
    """Return what the page has to know, which design.html reads."""
    pool, hand, taxels = design.pool, design.pool.hand, design.pool.skin
    drawn, simulator = Unrolled(hand), pool.first.simulator
    hand_name = NAMES.get(pool.env, Path(pool.env).stem)
    candidates = pool.whole
    words, dots = hand_map.described(taxels, hand), []
    for index, place in enumerate(hand_map.places(taxels)):
        x, y = drawn.point(place)
        layout = layouts.of_taxels(taxels.take([index]), hand, "")
        dots.append(
            {
                "x": round(x, 2),
                "y": round(y, 2),
                "radius": place.radius,
                "name": taxels.names[index],
                "where": words[index],
                "board": int(pool.prices.groups[index]) if pool.prices else 0,
                "toml": layout.toml().split("\n", 1)[1],  # without the description
                "candidate": index in candidates,
            }
        )
    losses = zip(pool.losses.names, pool.losses.members, strict=True)
    return {
        "title": f"{hand_name} in {NAMES.get(simulator, simulator)}: "
        + ", ".join(pool.scenes),
        "panels": [
            {"x": panel.x, "y": panel.y, "box": panel.box} for panel in drawn.panels
        ],
        "labels": drawn.labels,
        "letters": LETTERS,
        "extent": drawn.extent,
        "dots": dots,
        "recordings": [
            {
                "waits": wait,
                "choice": _starts(design.judge.choice[wait]),
                "test": _starts(starts),
            }
            for wait, starts in design.judge.test.items()
        ],
        "survives": pool.flags.survives,
        "loss": layouts.short(pool.flags.survives or "taxel"),
        "losses": [[name, np.flatnonzero(lost).tolist()] for name, lost in losses],
        "rows": [asdict(row) for row in design.rows],
        "verdict": design.sentences(),
        "kept": pool.existing,
        "sensor": {
            "name": layouts.short(pool.flags.sensor),
            "radius": pool.first.taxel_radius,
            "threshold": pool.first.taxel_threshold,
        },
        "cost": asdict(pool.prices.cost) if pool.prices else None,
        "budget": pool.flags.budget,
        "sets": list(design.chosen.items()),
        "layouts": pool.references,
    }


def _starts(starts: Starts) -> dict[str, Any]:
    """Return when each taxel fires, when closing succeeds, and when the object is let go."""
    return {
        "fires": starts.fires.tolist(),
        "succeeds": [np.flatnonzero(row).tolist() for row in starts.succeeds],
        "lets_go": starts.lets_go.tolist(),
    }
