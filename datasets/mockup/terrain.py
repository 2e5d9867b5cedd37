"""A seeded lunar bed: relief, craters, rocks, albedo grain and the light that falls on it.

Lengths are metres of the bed (1:10). Arrays are [row, col], row 0 at the far end (greatest y). Every part draws from
its own stream of the seed, so that changing one leaves the others as they were.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rille.datasets.mockup.params import SceneParams
from rille.stages.core.arrays import Floats32

OCTAVES = (0.5, 0.25, 0.125, 0.0625, 0.03125, 0.015625, 0.0078125, 0.00390625)
"""Spacings of the relief's octaves, metres. Finer relief is drawn as grain: no camera resolves its shape."""

HURST = 0.85
"""Amplitude ~ wavelength^HURST: natural terrain is self-affine with 0.7-0.9 (e.g. Rosenburg 2011, LOLA)."""

SPLINE_RMS = 0.479
"""RMS of unit white noise after smoothing with the two-dimensional cubic B-spline."""

WIDEST_ROCK = 0.11
WIDEST_CRATER = 0.35
LEAST_COVER_ROCK, WIDEST_COVER_ROCK = 0.004, 0.15
"""Rocks of a stated cover, metres: what a camera resolves, and 1.5 m at full scale."""
FULL_SCALE = 10.0
"""Metres of Mars or Moon to a metre of the bed, for the law of the rocks' sizes."""
TRIES = 300
"""Places tried for one rock; at a cover of 0.3 one in a thousand finds none."""
EMISSION = 0.31
"""Cosine of the emission angle for which the exposure is set: ground seen 18 degrees below the horizon."""


def stream(seed: int, part: int) -> np.random.Generator:
    """Generator of one part of the bed."""
    # Parts in use: 1 to 40 here, 50 images, 60 to 62 motion and its sensors, 70 to 72 the rover. A new one takes a
    # free number: a shared one would correlate what should be independent.
    return np.random.default_rng([seed, part])


@njit(cache=True, nogil=True)
def _add_octave(out, grid, spacing, amplitude):  # type: ignore[no-untyped-def]
    """Add ``amplitude`` times the cubic B-spline with coefficients ``grid``, one every ``spacing`` nodes."""
    rows, cols = out.shape
    line = np.empty(grid.shape[1])
    w = np.empty((cols, 4))
    at = np.empty(cols, np.int64)
    for c in range(cols):
        at[c] = int(c / spacing)
        _spline_weights(c / spacing - at[c], w[c])
    wr = np.empty(4)
    for r in range(rows):
        i = int(r / spacing)
        _spline_weights(r / spacing - i, wr)
        for j in range(grid.shape[1]):
            line[j] = wr[0] * grid[i, j] + wr[1] * grid[i + 1, j] + wr[2] * grid[i + 2, j] + wr[3] * grid[i + 3, j]
        for c in range(cols):
            j = at[c]
            value = w[c, 0] * line[j] + w[c, 1] * line[j + 1] + w[c, 2] * line[j + 2] + w[c, 3] * line[j + 3]
            out[r, c] += amplitude * value


@njit(cache=True, nogil=True)
def _spline_weights(f, w):  # type: ignore[no-untyped-def]
    """Weights of the uniform cubic B-spline at fraction f."""
    g = 1.0 - f
    w[0] = g * g * g / 6.0
    w[1] = (3.0 * f * f * f - 6.0 * f * f + 4.0) / 6.0
    w[2] = (3.0 * g * g * g - 6.0 * g * g + 4.0) / 6.0
    w[3] = f * f * f / 6.0


def add_octave(out: Floats32, spacing: float, amplitude: float, rng: np.random.Generator) -> None:
    """Add smooth noise of RMS ``amplitude`` with one random value every ``spacing`` nodes."""
    shape = (int(out.shape[0] / spacing) + 5, int(out.shape[1] / spacing) + 5)
    grid = rng.standard_normal(shape, dtype=np.float32)
    _add_octave(out, grid, float(spacing), float(amplitude / SPLINE_RMS))


def relief(p: SceneParams, shape: tuple[int, int]) -> Floats32:
    """Fractal relief, float32 metres, mean zero."""
    out = np.zeros(shape, np.float32)
    for k, wave in enumerate(OCTAVES):
        amplitude = p.relief * (wave / OCTAVES[0]) ** HURST
        if wave >= 2.0 * p.cell:
            add_octave(out, wave / p.cell, amplitude, stream(p.seed, 10 + k))
    return out


def _sizes(rng: np.random.Generator, count: float, least: float, most: float) -> NDArray[np.float64]:
    """Diameters of a population with N(>D) ~ D^-2 between ``least`` and ``most``, in the order of placing."""
    n = int(rng.poisson(count))
    u = rng.random(n)
    # The inverse of N(>D) ~ D^-2 cut off at both ends, so that uniform numbers give sizes.
    return np.asarray(1.0 / np.sqrt(least**-2 + u * (most**-2 - least**-2)), dtype=np.float64)


def _patch(
    shape: tuple[int, int], cell: float, x: float, y: float, reach: float
) -> tuple[tuple[slice, slice], NDArray[np.float64], NDArray[np.float64]] | None:
    """Window of the nodes within ``reach`` of (x, y) from the upper left node, and their offsets in metres."""
    c0, c1 = max(int((x - reach) / cell), 0), min(int((x + reach) / cell) + 2, shape[1])
    r0, r1 = max(int((y - reach) / cell), 0), min(int((y + reach) / cell) + 2, shape[0])
    if c0 >= c1 or r0 >= r1:
        return None
    dx = np.arange(c0, c1, dtype=np.float64) * cell - x
    dy = np.arange(r0, r1, dtype=np.float64) * cell - y
    return (slice(r0, r1), slice(c0, c1)), dx[None, :], dy[:, None]


def add_craters(height: Floats32, p: SceneParams) -> None:
    """Bowls with raised rims; the older a crater, the shallower. Ejecta fall off with distance^-3."""
    rng = stream(p.seed, 1)
    area = (height.shape[0] * p.cell) * (height.shape[1] * p.cell)
    least = 0.025
    # The parameter counts those above 0.1 m: by D^-2 the number above the least one is larger by this factor.
    for diameter in _sizes(rng, p.craters * area * (0.1 / least) ** 2, least, WIDEST_CRATER):
        x, y, age = rng.random(3)
        patch = _patch(height.shape, p.cell, x * height.shape[1] * p.cell, y * height.shape[0] * p.cell, 1.5 * diameter)
        if patch is None:
            continue
        window, dx, dy = patch
        # Age 0 is the oldest crater, which is the shallowest.
        depth = diameter * (0.05 + 0.13 * age)
        rim = 0.22 * depth
        q = np.sqrt(dx**2 + dy**2) / (0.5 * diameter)
        inside = rim - (depth + rim) * (1.0 - q**2)
        # Shifted and stretched to reach 0 at three radii, where the patch ends: a cut-off tail would leave a step.
        outside = rim * (1.0 / np.maximum(q, 1.0) ** 3 - 1.0 / 27.0) / (1.0 - 1.0 / 27.0)
        # a soft minimum of both rounds the rim over a tenth of the radius
        bowl = 0.5 * (inside + outside - np.sqrt((inside - outside) ** 2 + (0.1 * rim) ** 2))
        height[window] += np.where(q < 3.0, bowl, 0.0).astype(np.float32)


def add_rocks(height: Floats32, p: SceneParams) -> Floats32:
    """Put rocks of profile 1 - q^4 (bounded slopes) on the ground; returns their tint, the albedo relative to it."""
    if p.rock_cover is not None:
        return _add_rock_cover(height, p, p.rock_cover)
    rng = stream(p.seed, 2)
    area = (height.shape[0] * p.cell) * (height.shape[1] * p.cell)
    least = 0.004
    stones, rough = np.zeros_like(height), _rough_faces(height, p)
    tint = np.ones_like(height)
    for diameter in _sizes(rng, p.rocks * area * (0.03 / least) ** 2, least, WIDEST_ROCK):
        x, y, a, b, c, e, g, s = rng.random(8)
        patch = _patch(height.shape, p.cell, x * height.shape[1] * p.cell, y * height.shape[0] * p.cell, 0.8 * diameter)
        if patch is None:
            continue
        window, dx, dy = patch
        stone = _stone(dx, dy, diameter, 0.65 + 0.35 * b, (a, c, e, g, s), rough[window])
        over = stone > stones[window]
        tint[window] = np.where(over, np.float32(0.75 + 0.6 * e), tint[window])
        stones[window] = np.maximum(stones[window], stone)
    height += stones
    return tint


def _rough_faces(height: Floats32, p: SceneParams) -> Floats32:
    """Relief of the rocks' faces relative to their height."""
    rough = np.zeros_like(height)
    for k, wave in enumerate((0.016, 0.008, 0.004)):
        add_octave(rough, max(wave / p.cell, 1.0), 0.5**k, stream(p.seed, 20 + k))
    return rough


def _add_rock_cover(height: Floats32, p: SceneParams, cover: float) -> Floats32:
    """Rocks beside each other, the largest first, until they cover the stated share; returns their tint."""
    rng = stream(p.seed, 3)
    length, width = height.shape[0] * p.cell, height.shape[1] * p.cell
    stones, rough, tint = np.zeros_like(height), _rough_faces(height, p), np.ones_like(height)
    for diameter in cover_sizes(rng, cover, length * width):
        b, *draws = (float(v) for v in rng.random(6))
        aspect = 0.65 + 0.35 * b
        long_axis = diameter / np.sqrt(aspect)  # the ellipse has the area of a circle of that diameter
        for _ in range(TRIES):
            x, y = rng.random(2)
            patch = _patch(height.shape, p.cell, x * width, y * length, 0.6 * long_axis)
            if patch is None:
                continue
            window, dx, dy = patch
            stone = _stone(dx, dy, long_axis, aspect, tuple(draws), rough[window])
            if not (stones[window][stone > 0] > 0).any():
                stones[window] = np.maximum(stones[window], stone)
                tint[window] = np.where(stone > 0, np.float32(0.75 + 0.6 * draws[2]), tint[window])
                break
    height += stones
    return tint


def cover_sizes(rng: np.random.Generator, cover: float, area: float) -> NDArray[np.float64]:
    """Diameters, metres of the bed, falling, of rocks that together cover a share of an area (m2).

    The law is that of Golombek and Rapp (1997), doi:10.1029/96JE03319: the share under rocks wider than D metres falls
    with exp(-q D), q = 1.79 + 0.152 / cover, at full scale. Sizes are drawn one from each equal part of the numbers.
    """
    q = (1.79 + 0.152 / cover) * FULL_SCALE
    d = np.geomspace(LEAST_COVER_ROCK, WIDEST_COVER_ROCK, 2000)
    covered = np.exp(-q * d[0]) - np.exp(-q * d)
    middle = np.sqrt(d[1:] * d[:-1])
    number = np.concatenate([[0.0], np.cumsum(np.diff(covered) / (0.25 * np.pi * middle**2))])
    count = round(number[-1] * cover * area / covered[-1])
    u = (np.arange(count) + rng.random(count)) / max(count, 1)
    return np.asarray(np.interp(u * number[-1], number, d)[::-1], dtype=np.float64)


def _stone(
    dx: NDArray[np.float64],
    dy: NDArray[np.float64],
    diameter: float,
    aspect: float,
    draws: tuple[float, ...],
    rough: Floats32,
) -> Floats32:
    """Heights (row, col) of one rock at offsets (dx, dy) from its middle, metres; 0 beside it.

    ``diameter`` is that of the long axis, ``aspect`` short over long; ``draws`` (5,) in 0..1 turn and break it.
    """
    a, c, e, g, s = draws
    turn = 2.0 * np.pi * a
    u, v = np.cos(turn) * dx + np.sin(turn) * dy, -np.sin(turn) * dx + np.cos(turn) * dy
    v = v / aspect
    bearing = np.arctan2(v, u)
    outline = 1.0 + 0.10 * np.cos(3.0 * bearing + 6.3 * c) + 0.06 * np.cos(5.0 * bearing + 6.3 * e)
    q = np.sqrt(u**2 + v**2) / (0.5 * diameter * outline)
    # tilted faces cut the body, as broken stones are; the profile bounds the slopes of what remains
    shape = 1.0 - q**4
    for k in range(3):
        way = 6.3 * g + 2.1 * k + c
        shape = np.minimum(shape, 0.70 + 0.15 * k + (0.35 + 0.2 * k) * (np.cos(way) * u + np.sin(way) * v) / diameter)
    stone = min(diameter * (0.25 + 0.35 * s), 0.04) * (shape + 0.06 * rough * np.maximum(shape, 0.0))
    return np.asarray(np.where(q < 1.0, np.maximum(stone, 0.0), 0.0), dtype=np.float32)


def albedo(p: SceneParams, nodes: tuple[int, int]) -> NDArray[np.uint8]:
    """Relative albedo, 128 = mean, uint8, on a grid of half the cell size (2 rows - 1, 2 cols - 1).

    Grain in octaves from 33 mm down to a texel, 30-1000 cycles/m. What is finer than 8 mm stands for the shading of
    relief that no camera resolves as well, and has twice the contrast.
    """
    shape = (2 * nodes[0] - 1, 2 * nodes[1] - 1)
    texel = 0.5 * p.cell
    log = np.zeros(shape, np.float32)
    for k, wave in enumerate((0.128, 0.032, 0.016, 0.008, 0.004, 0.002, 0.001)):
        if wave >= 2.0 * texel:
            add_octave(log, wave / texel, p.grain * (2.0 if wave < 0.008 else 1.0), stream(p.seed, 30 + k))
    log += np.float32(2.0 * p.grain) * stream(p.seed, 40).standard_normal(shape, dtype=np.float32)
    # Log-normal: contrasts of the octaves multiply, and no albedo is negative.
    return np.clip(128.0 * np.exp(log) + np.float32(0.5), 1, 255).astype(np.uint8)


def halve(a: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Next level of a texture: rounded means of 2 x 2, odd sizes edge-replicated."""
    a = np.pad(a, ((0, a.shape[0] % 2), (0, a.shape[1] % 2)), mode="edge")
    # Four bytes add up to 1020.
    total = a[::2, ::2].astype(np.uint16) + a[::2, 1::2] + a[1::2, ::2] + a[1::2, 1::2]
    return ((total + 2) >> 2).astype(np.uint8)


@njit(cache=True, nogil=True)
def _lit(height, out, step_r, step_c, phase, drop):  # type: ignore[no-untyped-def]
    """Add one to ``out`` where light arrives that travels by (step_r, step_c) nodes and falls by ``drop`` metres.

    One of the steps is +-1. The ceiling of the shade is swept along it, S(p) = max(h(q), S(q)) - drop at the node's
    predecessor q; along the other axis the line is rounded to nodes, since interpolation would wear narrow shadows off.
    """
    rows, cols = height.shape
    by_row = abs(step_r) == 1.0
    lines, width = (rows, cols) if by_row else (cols, rows)
    main, side = (step_r, step_c) if by_row else (step_c, step_r)
    shade = np.full(width, -1e9)
    before = np.empty(width)
    for k in range(lines):
        line = k if main > 0 else lines - 1 - k
        shift = int(np.floor(k * side + phase)) - int(np.floor((k - 1) * side + phase))
        for j in range(width):
            before[j] = shade[j]
        for j in range(width):
            value = before[j - shift] - drop if 0 <= j - shift < width else -1e9
            h = height[line, j] if by_row else height[j, line]
            if h >= value:
                if by_row:
                    out[line, j] += 1
                else:
                    out[j, line] += 1
                value = h
            shade[j] = value


def sunlit(height: Floats32, p: SceneParams) -> NDArray[np.uint8]:
    """Share of the sun's disc that each node sees, 0..255 (cast shadows only, not the slope's own).

    Sixteen points of the disc each cast a sharp shadow; together their edges are the wider the farther they fall.
    """
    points = 16
    count = np.zeros(height.shape, np.uint8)
    for k in range(points):
        # Square roots and the golden angle (Vogel's spiral) spread the points evenly over the disc.
        radius, angle = 0.5 * p.sun_diameter_deg * np.sqrt((k + 0.5) / points), k * 2.39996323
        # Off the horizon and the zenith: there tan() is 0, or has no end.
        elevation = np.deg2rad(np.clip(p.sun_elevation_deg + radius * np.sin(angle), 0.5, 89.5))
        # An angle on the sky spans more azimuth the higher it stands.
        azimuth = np.deg2rad(p.sun_azimuth_deg) + np.deg2rad(radius * np.cos(angle)) / np.cos(elevation)
        # travel of the light in nodes: away from the sun; rows grow towards the viewer
        step_c, step_r = -np.sin(azimuth), np.cos(azimuth)
        longer = max(abs(step_c), abs(step_r))
        step_c, step_r = step_c / longer, step_r / longer
        drop = float(np.hypot(step_c, step_r)) * p.cell * float(np.tan(elevation))
        _lit(height, count, float(step_r), float(step_c), (k + 0.5) / points, drop)
    return np.asarray(count.astype(np.uint16) * 255 // points, dtype=np.uint8)
