"""Ways over the shortest ones, and shares with their intervals: what a set of drives says, and how sure that is."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

LONGEST = 1.15
"""Of a way over the shortest one."""
RESAMPLED = 4000
"""Sets that are drawn anew, with replacement, from the drives."""


def wilson(hits: float, n: float, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's interval (95 %) of a share of ``n`` independent trials."""
    if n <= 0:
        return math.nan, math.nan
    p = hits / n
    middle, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    low, high = (min(max((middle + s * half) / (1 + z * z / n), 0.0), 1.0) for s in (-1, 1))
    return low, high


def share(hits: int, n: int) -> str:
    """A share and Wilson's interval, per cent."""
    if n == 0:
        return "-"
    low, high = wilson(hits, n)
    return f"{100 * hits / n:.0f} % ({100 * low:.0f}-{100 * high:.0f})"


@dataclass(frozen=True)
class Ratios:
    """Of several ways, each with the shortest there is, (length, length), m."""

    ways: Sequence[tuple[float, float]]

    def each(self) -> list[float]:
        """Way over the shortest, in order of size."""
        return sorted(way / shortest for way, shortest in self.ways)

    def within(self) -> int:
        """How many are at most :data:`LONGEST`."""
        return sum(r <= LONGEST for r in self.each())

    def together(self) -> float:
        """All ways over all that are the shortest."""
        return sum(way for way, _ in self.ways) / sum(shortest for _, shortest in self.ways)

    def interval(self) -> tuple[float, float]:
        """Between what 95 % of as many ways, drawn anew from these, are together (bootstrap, percentiles)."""
        rng = random.Random(1)
        drawn = sorted(Ratios(rng.choices(self.ways, k=len(self.ways))).together() for _ in range(RESAMPLED))
        return drawn[RESAMPLED // 40], drawn[-1 - RESAMPLED // 40]

    def cells(self) -> list[str]:
        """Together with its interval; median, worst; how many are within: as in :data:`HEADINGS`."""
        if not self.ways:
            return ["-", "-", "-"]
        low, high = self.interval()
        ratios = self.each()
        return [
            f"{self.together():.2f} ({low:.2f}-{high:.2f})",
            f"{median(ratios):.2f}, {ratios[-1]:.2f}",
            f"{self.within()}: {share(self.within(), len(ratios))}",
        ]


HEADINGS = ["way / shortest: together", "median, worst", f"at most {LONGEST:g}"]
"""Of the columns that :meth:`Ratios.cells` fills."""
