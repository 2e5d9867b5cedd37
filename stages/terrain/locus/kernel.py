"""Kernel of Locus reconstruction (paper, section 4.4): cells straight from the disparity.

For a cell at (x, y) of the plane z = 0, the reference surface, let P(Z) = (x, y, Z), p_l and p_r its projections and d
the disparity vector. The paper minimises |g(Z)|, g = p_l(Z) + d(p_l(Z)) - p_r(Z). Here the *sign change* of
s(Z) = g(Z) . e is solved, e being the direction at p_r in which a point moves when it recedes along the left camera's
ray (the local epipolar line): the same solution with a tenth of the evaluations, and more exact, because a minimum is
flat and a sign change is not.

s > 0: the surface that the left camera sees behind P is farther than P, so P is in free space; s < 0: P is behind the
surface. A terrain surface is a change from free (above) to behind (below) along z. Where the change happens
across a depth jump between two pixels nothing was seen: the cell is occluded there.

**Which change, where there are several.** The search begins at the top of the cell's interval. If the point there is
free, it goes down to the first change; if it is behind the surface, it first goes up to the nearest change above the
start. A change *stands* if its slope and the jump of the disparities around it are within the limits; after one that
does not, the search goes on, downwards from the start in the end. So the result is the highest change
that stands at or below the start, or the nearest one above it. A cell whose interval, handed down from its coarse
neighbours, lies wholly on another surface may so miss one that a search of the whole range would find.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.core.kernel import inlined, kernel

MIN_DEPTH_M = 1e-9  # metres, projective depth: excludes the camera's own plane
MARGIN_STEPS = 1.0  # that the interval handed down from the coarse level is widened by
SOLVED_PX = 1e-3  # |s| of a solution: a two-hundredth of the disparity's usual noise


class PairCameras(NamedTuple):
    """``left``, ``right`` (3, 4) projections from the frame of the lattice to pixels; ``epipole`` (3,) homogeneous
    projection of the left camera's centre into the right image; ``sizes`` (4,) width and height of the left, then of
    the right image."""

    left: Floats
    right: Floats
    epipole: Floats
    sizes: Floats


class Observed(NamedTuple):
    """What is read at a pixel of the left image (rows, cols).

    ``disparity`` (rows, cols, 2) right minus left, column and row, pixels, NaN where it must not be used; ``std``
    (rows, cols) its standard deviation, pixels; ``image`` (rows, cols) grey values; ``max_jump`` of the disparities in
    the bilinear cell of a solution, pixels; ``axes`` (2, 2) where a column and a row of the left image lead in the
    right one, see :func:`rille.stages.geometry.scale.axes`.
    """

    disparity: Floats32
    std: Floats32
    image: Floats32
    max_jump: float
    axes: Floats


class Dem(NamedTuple):
    """Elevation model on a lattice, arrays (rows, cols) float32, NaN undefined.

    ``elevation`` and its standard deviation ``elevation_std`` in metres, ``ortho`` the grey value of the left image.
    """

    elevation: Floats32
    elevation_std: Floats32
    ortho: Floats32


class Cells(NamedTuple):
    """Cells at ``x`` (cols,) and ``y`` (rows,), metres.

    ``low``, ``high`` (rows, cols) interval of Z in which the search starts, metres, NaN: the cell is left out. The
    search may leave it: upwards while the point is behind the surface, downwards while it is free.
    """

    x: Floats
    y: Floats
    low: Floats32
    high: Floats32


class Line(NamedTuple):
    """Line of a cell in one image: its points (x, y, Z) have the homogeneous projections a + Z b."""

    a0: float
    a1: float
    a2: float
    b0: float
    b1: float
    b2: float


class PairLines(NamedTuple):
    """Lines of a cell in both images."""

    left: Line
    right: Line


class Mismatch(NamedTuple):
    """Mismatch g . e at a point, ``s``, and ``power`` |e|^2, pixels^2. NaN where disparity is undefined or the point
    outside an image. ``x``, ``y``: the point in the left image.

    The search needs the sign of s alone, so neither a root nor a division is spent on a step.
    """

    s: float
    power: float
    x: float
    y: float


class SearchSteps(NamedTuple):
    """Points of a line that are tried: Z = bottom + k dz, k <= ``most``, ``dz`` a pixel at most.

    The search begins at k = ``first``; it goes below ``last`` only through free space.
    """

    bottom: float
    dz: float
    most: int
    first: int
    last: float


class Bracket(NamedTuple):
    """Elevations of a step, m, at whose upper end s >= 0 (free), and at whose lower end s < 0 (behind)."""

    upper: float
    s_upper: float
    lower: float
    s_lower: float


class Solution(NamedTuple):
    """Elevation and its standard deviation, m, and grey value; NaN: the change does not stand."""

    elevation: float
    std: float
    grey: float


@kernel
def search(cells, z_range, cameras, seen, out):  # type: ignore[no-untyped-def]
    """Solve every cell of :class:`Cells` from what is :class:`Observed`.

    ``z_range``: limits of Z, metres; ``out``: the :class:`Dem` of the cells, to be filled with NaN before.
    """
    # Arrays are taken out of their tuples before the loops: each time costs an atomic count of references.
    xs, ys, low, high = cells.x, cells.y, cells.low, cells.high
    elevation, std, ortho = out.elevation, out.elevation_std, out.ortho
    left, right, sizes, direction = cameras.left, cameras.right, cameras.sizes, cameras.epipole
    for r in range(len(ys)):
        for c in range(len(xs)):
            if math.isnan(low[r, c]):
                continue
            lines = PairLines(line_of(left, xs[c], ys[r]), line_of(right, xs[c], ys[r]))
            start = low[r, c], high[r, c]
            cell = solve_cell(lines, visible(lines, sizes, z_range), start, direction, seen)
            elevation[r, c], std[r, c], ortho[r, c] = cell


@kernel
def line_of(P, x, y):  # type: ignore[no-untyped-def]
    """Line of a cell at x, y in an image by its projection (3, 4)."""
    return Line(
        P[0, 0] * x + P[0, 1] * y + P[0, 3],
        P[1, 0] * x + P[1, 1] * y + P[1, 3],
        P[2, 0] * x + P[2, 1] * y + P[2, 3],
        P[0, 2],
        P[1, 2],
        P[2, 2],
    )


@kernel
def visible(lines, sizes, z_range):  # type: ignore[no-untyped-def]
    """Part (low, high) of ``z_range`` that projects into both images; empty (low > high) where there is none."""
    low, high = z_range
    for k in range(2):
        line = lines.left if k == 0 else lines.right
        w, h = sizes[2 * k] - 1.0, sizes[2 * k + 1] - 1.0
        # In front of the camera x = X / W has W > 0, and 0 <= x <= w is X >= 0 and w W - X >= 0.
        for p, q in (
            (line.a0, line.b0),
            (w * line.a2 - line.a0, w * line.b2 - line.b0),
            (line.a1, line.b1),
            (h * line.a2 - line.a1, h * line.b2 - line.b1),
            (line.a2 - MIN_DEPTH_M, line.b2),
        ):
            if q > 0.0:
                low = max(low, -p / q)
            elif q < 0.0:
                high = min(high, -p / q)
            elif p < 0.0:
                high = -np.inf
    return low, high


@kernel
def fastest(line, span):  # type: ignore[no-untyped-def]
    """Square of the greatest image speed |d p / d Z| of a line on a span, pixels per metre.

    d p / d Z = (b - p b_2) / w with w linear in Z, so it is greatest at one of the ends.
    """
    speed = 0.0
    for z in span:
        part = 1.0 / max(line.a2 + z * line.b2, MIN_DEPTH_M)
        x, y = (line.a0 + z * line.b0) * part, (line.a1 + z * line.b1) * part
        dx, dy = (line.b0 - x * line.b2) * part, (line.b1 - y * line.b2) * part
        speed = max(speed, dx * dx + dy * dy)
    return speed


@kernel
def steps_of(lines, span, start):  # type: ignore[no-untyped-def]
    """:class:`SearchSteps` of a cell on the visible ``span`` of Z, from the interval ``start``, both (low, high)."""
    bottom, top = span
    speed = math.sqrt(max(fastest(lines.left, span), fastest(lines.right, span)))
    # Steps of a pixel: disparity is bilinear between pixels, so nothing hides in shorter ones. 4096 are more than the
    # diagonal of a 12 megapixel image.
    count = max(1.0, min(np.ceil(speed * (top - bottom)), 4096.0))
    dz = (top - bottom) / count
    first = max(0.0, min(count, np.ceil((start[1] - bottom) / dz) + MARGIN_STEPS))
    return SearchSteps(bottom, dz, int(count), int(first), np.floor((start[0] - bottom) / dz) - MARGIN_STEPS)


@inlined
def mismatch(lines, z, epipole, disparity):  # type: ignore[no-untyped-def]
    """:class:`Mismatch` of a cell's point at elevation z."""
    left, right = lines.left, lines.right
    w, w_right = left.a2 + z * left.b2, right.a2 + z * right.b2
    part, part_right = 1.0 / w, 1.0 / w_right
    x, y = (left.a0 + z * left.b0) * part, (left.a1 + z * left.b1) * part
    rows, cols = disparity.shape[:2]
    if not (
        w >= MIN_DEPTH_M and w_right >= MIN_DEPTH_M and x >= 0.0 and y >= 0.0 and x < cols - 1.0 and y < rows - 1.0
    ):
        return Mismatch(np.nan, np.nan, np.nan, np.nan)
    c, r = np.uint32(x), np.uint32(y)  # unsigned: not counted from the end, so no check at each use
    fx, fy, d = x - c, y - r, disparity
    w00, w01, w10, w11 = (1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy
    u = w00 * d[r, c, 0] + w01 * d[r, c + 1, 0] + w10 * d[r + 1, c, 0] + w11 * d[r + 1, c + 1, 0]
    v = w00 * d[r, c, 1] + w01 * d[r, c + 1, 1] + w10 * d[r + 1, c, 1] + w11 * d[r + 1, c + 1, 1]
    # g = p_l + d(p_l) - p_r
    x_right, y_right = (right.a0 + z * right.b0) * part_right, (right.a1 + z * right.b1) * part_right
    gx, gy = x + u - x_right, y + v - y_right
    # On the ray of p_l, p_r(t) = (epipole + t q) / w for a fixed q: d p_r / d t is parallel to
    # p_r * epipole_2 - epipole_01.
    ex, ey = x_right * epipole[2] - epipole[0], y_right * epipole[2] - epipole[1]
    power = ex * ex + ey * ey
    # At the epipole itself no direction is that of the line.
    s = gx * ex + gy * ey if power > 0.0 else np.nan
    return Mismatch(s, power, x, y)


@inlined
def solve_cell(lines, span, start, epipole, seen):  # type: ignore[no-untyped-def]
    """:class:`Solution` of one cell on the visible ``span`` of Z, searched from the interval ``start``."""
    solution = Solution(np.nan, np.nan, np.nan)
    if not span[1] > span[0]:
        return solution
    disparity = seen.disparity
    bottom, dz, most, first, last = steps_of(lines, span, start)
    s_first = s = mismatch(lines, bottom + first * dz, epipole, disparity).s
    # Upwards while behind.
    k, below = first, s
    while s < 0.0 and k < most:
        k, below = k + 1, s
        s = mismatch(lines, bottom + k * dz, epipole, disparity).s
    if k > first and s >= 0.0:
        z = bottom + k * dz
        solution = _judged(lines, Bracket(z, s, z - dz, below), dz, epipole, seen)
    # Downwards from free to behind; beyond the last step only while free.
    k, above = first - 1, s_first
    while k >= 0 and math.isnan(solution.elevation):
        z = bottom + k * dz
        s = mismatch(lines, z, epipole, disparity).s
        if above >= 0.0 and s < 0.0:
            solution = _judged(lines, Bracket(z + dz, above, z, s), dz, epipole, seen)
        if k <= last and not s >= 0.0:
            break
        k, above = k - 1, s
    return solution


@inlined
def root(lines, bracket, epipole, disparity):  # type: ignore[no-untyped-def]
    """Elevation in a bracket at which s is 0, by regula falsi (Illinois), and the :class:`Mismatch` there; NaN where
    disparity is undefined."""
    z0, s0, z1, s1 = bracket
    side = 0
    z = (z0 * s1 - z1 * s0) / (s1 - s0)
    at = mismatch(lines, z, epipole, disparity)
    for _ in range(16):  # turns of regula falsi at most
        # Negated, so that NaN ends it as well.
        if not at.s * at.s >= SOLVED_PX * SOLVED_PX * at.power:
            break
        # Illinois: an end that stays twice counts half, else the chord would creep towards the root from one side.
        if at.s > 0.0:
            z0, s0, s1, side = z, at.s, (0.5 * s1 if side > 0 else s1), 1
        else:
            z1, s1, s0, side = z, at.s, (0.5 * s0 if side < 0 else s0), -1
        z = (z0 * s1 - z1 * s0) / (s1 - s0)
        at = mismatch(lines, z, epipole, disparity)
    return z, at


@inlined
def _judged(lines, bracket, dz, epipole, seen):  # type: ignore[no-untyped-def]
    """:class:`Solution` in a bracket, ``dz`` high; NaN where it does not stand."""
    nothing = Solution(np.nan, np.nan, np.nan)
    disparity, image = seen.disparity, seen.image
    z, at = root(lines, bracket, epipole, disparity)
    c, r = np.uint32(at.x), np.uint32(at.y)
    if math.isnan(at.s) or is_jump(disparity, seen, r, c):
        return nothing
    # The lesser slope: beside a jump the other side is steep, and would make the elevation look certain.
    above, below = mismatch(lines, z + dz, epipole, disparity), mismatch(lines, z - dz, epipole, disparity)
    up, down = above.s / (math.sqrt(above.power) * dz), -below.s / (math.sqrt(below.power) * dz)
    slope = up if math.isnan(down) else (down if math.isnan(up) else min(up, down))
    if not slope > 0.0:
        return nothing
    fx, fy = at.x - c, at.y - r
    upper = image[r, c] * (1.0 - fx) + image[r, c + 1] * fx
    lower = image[r + 1, c] * (1.0 - fx) + image[r + 1, c + 1] * fx
    # sigma_Z = sigma_d / |ds/dZ|
    std = seen.std[np.uint32(np.rint(at.y)), np.uint32(np.rint(at.x))] / slope
    return Solution(z, std, upper * (1.0 - fy) + lower * fy)


@inlined
def is_jump(disparity, seen, r, c):  # type: ignore[no-untyped-def]
    """Whether the disparities of the bilinear cell at row r and column c differ by more than ``max_jump``.

    In pixels of the left image: what an unlike scale or a roll of the right one adds from pixel to pixel is no jump.
    """
    total, axes = 0.0, seen.axes
    for k in range(2):
        low, high = np.inf, -np.inf
        for i in range(2):
            for j in range(2):
                value = disparity[r + i, c + j, k] - (axes[k, 0] * j + axes[k, 1] * i - (i if k else j))
                low, high = min(low, value), max(high, value)
        total += (high - low) ** 2 / (axes[k, 0] ** 2 + axes[k, 1] ** 2)
    return total > seen.max_jump**2
