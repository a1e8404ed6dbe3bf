"""Any two parts of studies against each other: other layouts, other hyperparameters, other code.

A part is written `PATH` or `PATH:NAME,NAME`, where each name is that of a set-up, a cell or an arm.
Groups of runs are compared that have the same other names in both parts.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from .. import statistics
from ..errors import InputError
from ..machine import short
from .records import UNTOLD, Record, load, settings
from .verdicts import in_pairs, scored, span

Place = tuple[str, ...]
"""Names of set-up, cell and arm that nobody chose."""


Part = dict[Place, list[Record]]
"""Finished runs, by what tells their group from others."""


def read(text: str) -> Part:
    """A part as it is written on the command line; InputError where there is no such part."""
    whole, path, chosen = Path(text), text, ""
    if not os.path.exists(whole):  # False for any name
        path, _, chosen = text.rpartition(":") if ":" in text else (text, "", "")
    study, records = load(Path(path))
    places, part = study.choose(chosen, path), Part()
    for record in records:
        if record.run.name in places and record.is_finished:
            part.setdefault(places[record.run.name], []).append(record)
    if not part:
        raise InputError(f"{text}: no finished run in it")
    return part


def compare(a: Part, b: Part, score: str) -> list[dict[str, Any]]:
    """`a` minus `b`, a row for every group that both have: its `place`, the `runs` of each, `until`
    which step they are compared (the end of the shortest run), the number of `pairs` of the same seed,
    the difference (`value`, `low`, `high`) and its `p` and `p_holm`."""
    if len(a) == len(b) == 1:
        pairs = [(next(iter(a)), next(iter(b)))]
    else:
        pairs = [(place, place) for place in a if place in b]
    if not pairs:
        names = (", ".join(" ".join(place) for place in part) for part in (a, b))
        raise InputError(
            "compare: found {} in one and {} in the other, nothing in both".format(
                *names
            )
        )
    rows: list[dict[str, Any]] = []
    for at_a, at_b in pairs:
        both = a[at_a], b[at_b]
        begin, end = span([*both[0], *both[1]])
        if begin > end:
            raise InputError(
                f"compare: a run has its first epoch at {begin:,.0f} steps, another its last at "
                f"{end:,.0f}: found no steps that all have"
            )
        compared, place = in_pairs(scored(score, *both)), " ".join(at_a) or "all"
        if not len(compared):
            raise InputError(
                f"compare: {place}: found no seed that both have, needed for pairs"
            )
        counts = {"runs": [*map(len, both)], "until": end, "pairs": len(compared)}
        gap = compared.difference._asdict()
        rows.append({"place": place, **counts, **gap, "p": compared.p_value})
    corrected = statistics.holm([row["p"] for row in rows])
    return [row | {"p_holm": float(p)} for row, p in zip(rows, corrected, strict=True)]


def differing(a: Part, b: Part) -> list[str]:
    """What the first runs of both parts were told differently, besides the seed; their commits, and by
    which success rate they are judged."""
    flat = []
    for first in (next(iter(part.values()))[0] for part in (a, b)):
        config = first.config or {}
        commit = short((config.get("provenance") or [{}])[-1].get("commit"))
        flat.append(settings(config) | {"commit": commit, "measure": first.run.measure})
    names = [name for name in flat[0] | flat[1] if name not in UNTOLD]
    values = {name: [one.get(name) for one in flat] for name in names}
    return [f"{name} {x} − {y}" for name, (x, y) in values.items() if x != y]
