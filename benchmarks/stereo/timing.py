"""Time of matchers side by side: alternating, so that a busy machine slows all of them alike."""

from __future__ import annotations

from collections.abc import Iterable
from statistics import median
from typing import Any

from .methods import Method
from .pairs import Pair

LEAST = 3


def timings(pair: Pair, methods: Iterable[Method], repeats: int, budget: float) -> list[dict[str, Any]]:
    """Milliseconds of each method, and ratios to the first one's, over ``repeats`` rounds.

    ``min_ratio``: of the least times; ``median_ratio``: median of the rounds' own ratios; ``cpu_ratio``: of the least
    processor times (all threads added up), which other programs disturb least. One untimed round compiles and warms
    up; programs elsewhere do that themselves. A method that has used up ``budget`` seconds stops after three rounds,
    or after one that alone took twice that.
    """
    methods = list(methods)
    for method in methods:
        if method.told is None:
            method.run(pair)
    taken: dict[str, list[tuple[float, float]]] = {m.name: [] for m in methods}
    for _ in range(repeats):
        for method in methods:
            mine = taken[method.name]
            if _enough([wall for wall, _ in mine], budget):
                continue
            mine.append(method.seconds(pair))
    first = taken[methods[0].name]
    first_wall, first_cpu = (min(t[i] for t in first) for i in (0, 1))
    return [
        {
            "pair": pair.name,
            "size": [pair.left.shape[1], pair.left.shape[0]],
            "disparities": pair.range[1],
            "method": name,
            "rounds": len(mine),
            "min_ms": 1e3 * min(wall for wall, _ in mine),
            "median_ms": 1e3 * median(wall for wall, _ in mine),
            "min_ratio": min(wall for wall, _ in mine) / first_wall,
            "median_ratio": median(a[0] / b[0] for a, b in zip(mine, first, strict=False)),
            "cpu_ratio": min(cpu for _, cpu in mine) / first_cpu,
        }
        for name, mine in taken.items()
    ]


def _enough(seconds: list[float], budget: float) -> bool:
    least = 1 if max(seconds, default=0.0) > 2.0 * budget else LEAST
    return len(seconds) >= least and sum(seconds) > budget
