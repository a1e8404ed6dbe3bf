"""The paper's published results, as far as its text gives them (published.toml)."""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import scipy

from ..statistics import CONFIDENCE, Estimate, Metric


@dataclass(frozen=True)
class Published:
    """One of the paper's two tables."""

    table: int
    steps: int
    """Of a run."""
    estimates: dict[tuple[str, str], dict[Metric, Estimate]]
    """By (cell, run type)."""
    overlaps: dict[str, float]
    """By cell: share of the control's interval that the main runs' covers."""


def find(config: dict[str, Any]) -> Published | None:
    """What the paper has for the set-up of a run's config.json; None where it has nothing."""
    run, scene = config["run"], config.get("scene") or {}
    text = files(__package__).joinpath("published.toml").read_text(encoding="utf-8")
    for data in tomllib.loads(text).values():
        mine = run["algo"], run["env"], scene.get("simulator")
        if (data["algo"], data["env"], data["simulator"]) == mine:
            estimates: dict[tuple[str, str], dict[Metric, Estimate]] = {}
            for layout, run_type, *values in data["rows"]:
                named = zip(("median", "iqm", "mean"), values[:3], values[3:], strict=True)
                estimates[f"layout {layout}", run_type] = {m: Estimate(v, *i) for m, v, i in named}  # type: ignore[misc]
            overlaps = {f"layout {i}": share for i, share in enumerate(data["overlap"], 1)}
            return Published(data["table"], data["steps"], estimates, overlaps)
    return None


def power(treatment: Estimate, control: Estimate, alpha: float = 0.05) -> float:
    """Power of a z test to find the difference of two published means again, from their intervals."""
    to_error = 2 * scipy.stats.norm.isf((1 - CONFIDENCE) / 2)
    errors = [(one.high - one.low) / to_error for one in (treatment, control)]
    shift = abs(treatment.value - control.value) / math.hypot(*errors)
    critical = scipy.stats.norm.isf(alpha / 2)
    return float(scipy.stats.norm.cdf(shift - critical) + scipy.stats.norm.cdf(-critical - shift))
