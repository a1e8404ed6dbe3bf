"""The paper's published results, as far as its text gives them (published.toml)."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from ..statistics import Estimate, Metric


@dataclass(frozen=True)
class Published:
    """One of the paper's two tables."""

    table: int
    runs: int
    steps: int
    """Of a run."""
    estimates: dict[tuple[str, str], dict[Metric, Estimate]]
    """By (cell, run type)."""
    overlaps: dict[str, float]
    """By cell: share of the control's interval that the main runs' covers."""


@cache
def _tables() -> dict[str, Any]:
    return tomllib.loads(files(__package__).joinpath("published.toml").read_text(encoding="utf-8"))


def find(config: dict[str, Any]) -> Published | None:
    """What the paper has for the set-up of a run's config.json; None where it has nothing."""
    scene = config.get("scene") or {}
    mine = (config["run"]["algo"], config["run"]["env"], scene.get("simulator"))
    for data in _tables().values():
        if (data["algo"], data["env"], data["simulator"]) == mine:
            return _published(data)
    return None


def _published(data: dict[str, Any]) -> Published:
    estimates: dict[tuple[str, str], dict[Metric, Estimate]] = {}
    for layout, run_type, median, iqm, mean, *intervals in data["rows"]:
        values = zip(("median", "iqm", "mean"), (median, iqm, mean), intervals, strict=True)
        estimates[f"layout {layout}", run_type] = {m: Estimate(v, *i) for m, v, i in values}  # type: ignore[misc]
    overlaps = {f"layout {i}": share for i, share in enumerate(data["overlap"], 1)}
    return Published(data["table"], data["runs"], data["steps"], estimates, overlaps)
