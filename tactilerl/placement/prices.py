"""Tell what sensors and their boards cost, and how many taxels some money buys."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..envs.sensors import Cost
from ..envs.state import Array


@dataclass(frozen=True)
class Prices:
    """Say what sets of taxels cost: each one, and each board that reads some of one group."""

    cost: Cost
    groups: Array
    """(m,) int: each taxel's group. A board serves one group only."""

    @property
    def channels(self) -> int:
        """Number of taxels that a board reads."""
        return self.cost.channels or len(self.groups)

    def _counts(self, taxels: Sequence[int]) -> Array:
        """Return how many of some taxels are in each group (g,)."""
        return np.bincount(self.groups[list(taxels)], minlength=self.groups.max() + 1)

    def of(self, taxels: Sequence[int]) -> float:
        """Return the price of some taxels and their boards."""
        boards = np.ceil(self._counts(taxels) / self.channels).sum()
        return self._price(len(taxels), int(boards))

    def _price(self, n: int, boards: int) -> float:
        return round(self.cost.each * n + self.cost.board * boards, 6)

    def fits(self, taxels: Sequence[int], boards: int) -> Array:
        """Tell which taxels go on to no more than some boards beside these, bool (m,)."""
        counts = self._counts(taxels)
        needs_another = counts % self.channels == 0
        used = np.ceil(counts / self.channels).sum()
        return np.asarray(used + needs_another[self.groups] <= boards)

    def sizes(
        self, taxels: Sequence[int], numbers: range, budget: float
    ) -> list[tuple[int, int]]:
        """Return the numbers of taxels, of these, and of boards that some money buys.

        Raise ValueError where that is not even the least of the `numbers`.
        """
        n_groups, sizes = len(np.unique(self.groups[list(taxels)])), []
        for n in numbers:
            most = min(n, n_groups + max(0, n - n_groups) // self.channels)
            fewest = -(-n // self.channels) if self.cost.board else most
            sizes += [(n, boards) for boards in range(fewest, most + 1)]
        if (least := self._price(*sizes[0])) > budget:
            n, boards = sizes[0]
            raise ValueError(
                f"budget: found {budget:g}, allowed {least:g} or more, the price of "
                f"{n} of these sensors and {boards} of their boards"
            )
        return [size for size in sizes if self._price(*size) <= budget]


def knee(prices: Sequence[float], successes: Sequence[float]) -> int:
    """Return the index from which on more money buys little.

    It is the point that is furthest above the line from the first to the last (Satopää et al. 2011,
    "Finding a 'kneedle' in a haystack"). The first is what one has for nothing.
    """
    x, y = (np.asarray(values, float) for values in (prices, successes))
    run, rise = max(x[-1] - x[0], 1e-9), max(y[-1] - y[0], 1e-9)
    return int(np.argmax((y - y[0]) / rise - (x - x[0]) / run))
