"""Time of matchers side by side: alternating, so that a busy machine slows all of them alike."""

from __future__ import annotations

import time
from collections.abc import Iterable
from statistics import median
from typing import Any

from .methods import Method
from .pairs import Pair

LEAST = 3


def timings(pair: Pair, methods: Iterable[Method], repeats: int, budget: float) -> list[dict[str, Any]]:
    """Milliseconds of each method and their ratio to the first one's: least and median of ``repeats`` rounds.

    One untimed round compiles and warms up. A method that has used up ``budget`` seconds stops after three rounds.
    """
    methods = list(methods)
    for method in methods:
        method.run(pair)
    taken: dict[str, list[float]] = {m.name: [] for m in methods}
    for _ in range(repeats):
        for method in methods:
            mine = taken[method.name]
            if len(mine) >= LEAST and sum(mine) > budget:
                continue
            start = time.perf_counter()
            method.run(pair)
            mine.append(time.perf_counter() - start)
    first = taken[methods[0].name]
    return [
        {
            "pair": pair.name,
            "size": [pair.left.shape[1], pair.left.shape[0]],
            "disparities": pair.range[1],
            "method": name,
            "rounds": len(seconds),
            "min_ms": 1e3 * min(seconds),
            "median_ms": 1e3 * median(seconds),
            "min_ratio": min(seconds) / min(first),
            "median_ratio": median(seconds) / median(first),
        }
        for name, seconds in taken.items()
    ]
