"""What decides a comparison, and when: the primary score of a study, and looks on the way."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from ..errors import InputError

SCORES = {
    "area": "area under the curve",
    "final": "final rate",
    "converged": "converged rate",
}
"""What one run reached: docs/statistics.md."""


@dataclass(frozen=True)
class Primary:
    """What decides a comparison; written down before the runs."""

    score: Literal["area", "final", "converged"] = "area"


@dataclass(frozen=True)
class Looks:
    """When a study looks at its primary comparisons, and what ends one."""

    pairs: list[int] = field(default_factory=lambda: [6, 9, 12, 16])
    """Seeds that have been run by then; the last look is at all of them."""
    alpha: Annotated[float, "(0, 1)"] = 0.05
    """Error of all looks together; as much of it may be spent as seeds have been run (`spent`)."""
    effect: Annotated[float, "(0, 1)"] = 0.1
    """A comparison ends, too, where a difference of so much is ruled out, either way."""

    def validate(self) -> None:
        """InputError unless the looks follow one another."""
        if sorted(set(self.pairs)) != self.pairs or min(self.pairs, default=0) < 2:
            raise InputError(
                f"looks.pairs: found {self.pairs}, allowed growing numbers, such as [6, 9, 12, 16]"
            )

    def spent(self, n_comparisons: int) -> list[float]:
        """Error of one of so many comparisons (Bonferroni) up to each look: in proportion to the pairs
        (Kim and DeMets 1987)."""
        return [self.alpha / n_comparisons * n / self.pairs[-1] for n in self.pairs]
