"""Order of frames without jumps, where the camera jumps in the given one."""

from __future__ import annotations

import numpy as np

from rille.stages.core.arrays import Floats


def without_jumps(places: Floats) -> list[tuple[int, int]]:
    """First and last row, of places (n, 3), of the runs of rows that follow each other without a jump, in that order.

    A run whose first row is behind its last one is taken backwards. Empty where there are fewer than two jumps, which a
    camera that comes back may make, or where another order has jumps, too. The first run stays the first.
    """
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    # Three median steps are a jump; half of it joins two runs.
    jump = 3.0 * float(np.median(steps)) if steps.size else 0.0
    ends = np.flatnonzero(steps > jump)
    if not 2 <= len(ends) <= len(places) // 3:
        return []
    first, *left = list(zip([0, *(ends + 1).tolist()], [*ends.tolist(), len(places) - 1], strict=True))
    path = [first]
    while left:
        either = [*left, *((b, a) for a, b in left)]
        away = np.linalg.norm(places[[a for a, _ in either]] - places[path[-1][1]], axis=1)
        k = int(np.argmin(away))
        if away[k] > 0.5 * jump:
            return []
        path.append(either[k])
        left.pop(k % len(left))
    return path
