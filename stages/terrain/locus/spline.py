"""Values and gradients of two cubic splines at the pixels of many lanes at once, for
:mod:`rille.stages.terrain.locus.views`.

Reading the coefficients is a loop of its own; with them in planes of a buffer, one behind the other, several lanes are
computed side by side.
"""

from __future__ import annotations

from numba import njit

LANES = 32
"""Cells that are looked at together."""
SPLINE = 16
"""Coefficients that a value depends on."""
LEFT_AT, RIGHT_AT, LEFT_VALUE, RIGHT_VALUE, WEIGHTS, SLOPES = (k * LANES for k in (0, 2, 4, 7, 10, 18))
"""Planes: x and y in the left and in the right image, a pixel or more from the edge; value and gradient (x, y) of the
left and of the right spline; weights of four coefficients along x, along y, and their derivatives likewise."""
PLANES = 26


@njit(cache=True, nogil=True)
def read(n, left, right, lanes, taps):  # type: ignore[no-untyped-def]
    """Value and gradient of both splines at ``n`` lanes; ``taps``: room for their coefficients."""
    for side in range(2):
        spline = right if side else left
        at = RIGHT_AT if side else LEFT_AT
        for m in range(n):
            c, r = int(lanes[at + m]) - 1, int(lanes[at + LANES + m]) - 1
            for k in range(4):
                for i in range(4):
                    taps[(4 * k + i) * LANES + m] = spline[r + k, c + i]
        if side:
            _weights(n, lanes, RIGHT_AT)
            _sum(n, lanes, taps, RIGHT_VALUE)
        else:
            _weights(n, lanes, LEFT_AT)
            _sum(n, lanes, taps, LEFT_VALUE)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _weights(n, lanes, at):  # type: ignore[no-untyped-def]
    for axis in range(2):
        w, s = WEIGHTS + 4 * axis * LANES, SLOPES + 4 * axis * LANES
        for m in range(n):
            t = lanes[at + axis * LANES + m]
            t = t - int(t)
            q = 1.0 - t
            lanes[w + m], lanes[w + 3 * LANES + m] = q * q * q / 6.0, t * t * t / 6.0
            lanes[w + LANES + m] = (4.0 - 3.0 * t * t * (2.0 - t)) / 6.0
            lanes[w + 2 * LANES + m] = (4.0 - 3.0 * q * q * (2.0 - q)) / 6.0
            lanes[s + m], lanes[s + 3 * LANES + m] = -0.5 * q * q, 0.5 * t * t
            lanes[s + LANES + m], lanes[s + 2 * LANES + m] = 0.5 * t * (3.0 * t - 4.0), -0.5 * q * (3.0 * q - 4.0)


@njit(cache=True, nogil=True, inline="always")
def _sum(n, lanes, taps, value):  # type: ignore[no-untyped-def]
    """Sums over the coefficients: along each row, then over the rows."""
    for m in range(n):
        lanes[value + m] = lanes[value + LANES + m] = lanes[value + 2 * LANES + m] = 0.0
    for k in range(4):
        tap = 4 * k * LANES
        for m in range(n):
            c0, c1, c2, c3 = (
                taps[tap + m],
                taps[tap + LANES + m],
                taps[tap + 2 * LANES + m],
                taps[tap + 3 * LANES + m],
            )
            w0, w1 = lanes[WEIGHTS + m], lanes[WEIGHTS + LANES + m]
            w2, w3 = lanes[WEIGHTS + 2 * LANES + m], lanes[WEIGHTS + 3 * LANES + m]
            across = w0 * c0 + w1 * c1 + w2 * c2 + w3 * c3
            w0, w1 = lanes[SLOPES + m], lanes[SLOPES + LANES + m]
            w2, w3 = lanes[SLOPES + 2 * LANES + m], lanes[SLOPES + 3 * LANES + m]
            along = w0 * c0 + w1 * c1 + w2 * c2 + w3 * c3
            w, s = lanes[WEIGHTS + (4 + k) * LANES + m], lanes[SLOPES + (4 + k) * LANES + m]
            lanes[value + m] += w * across
            lanes[value + LANES + m] += w * along
            lanes[value + 2 * LANES + m] += s * across
