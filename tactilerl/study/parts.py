"""Any two parts of studies against each other: other layouts, other hyperparameters, other code.

A part is written `PATH` or `PATH:NAME,NAME`, where each name is that of a set-up, a cell or an arm.
Groups of runs are compared that have the same other names in both parts.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .. import statistics
from ..errors import InputError
from .records import Record, load
from .verdicts import Pairs, in_pairs, scored, span

UNTOLD = ("seed", "workers", "threads", "tensorboard")
Place = tuple[str, ...]
"""Names of set-up, cell and arm that nobody chose."""


@dataclass(frozen=True)
class Row:
    """One group of runs in both parts."""

    place: str
    runs: tuple[int, int]
    until: float
    """Steps over which they are compared: those of the shortest run."""
    pairs: Pairs
    """Of the seeds that both have."""
    p_holm: float

    def as_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        counts = {"runs": self.runs, "until": self.until, "pairs": len(self.pairs)}
        p_values = {"p": self.pairs.p_value, "p_holm": self.p_holm}
        return {"place": self.place, **counts, **self.pairs.difference._asdict(), **p_values}


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


def compare(a: Part, b: Part, score: str) -> list[Row]:
    """`a` minus `b`, in every group that both have."""
    if len(a) == len(b) == 1:
        pairs = [(next(iter(a)), next(iter(b)))]
    else:
        pairs = [(place, place) for place in a if place in b]
    if not pairs:
        names = (", ".join(" ".join(place) for place in part) for part in (a, b))
        raise InputError("compare: found {} in one and {} in the other, nothing in both".format(*names))
    rows = []
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
            raise InputError(f"compare: {place}: found no seed that both have, needed for pairs")
        rows.append(Row(place, (len(both[0]), len(both[1])), end, compared, np.nan))
    corrected = statistics.holm([row.pairs.p_value for row in rows])
    return [replace(row, p_holm=float(p)) for row, p in zip(rows, corrected, strict=True)]


def differing(a: Part, b: Part) -> list[str]:
    """What the first runs of both parts were told differently, besides the seed; and their commits."""
    configs = [next(iter(part.values()))[0].config or {} for part in (a, b)]
    flat = [
        {k: v for name in ("run", "scene", "learner") for k, v in (c.get(name) or {}).items()}
        | {"commit": str((c.get("provenance") or [{}])[-1].get("commit"))[:12]}
        for c in configs
    ]
    names = [name for name in flat[0] | flat[1] if name not in UNTOLD]
    values = {name: [one.get(name) for one in flat] for name in names}
    return [f"{name} {x} − {y}" for name, (x, y) in values.items() if x != y]
