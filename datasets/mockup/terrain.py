"""A seeded lunar bed: relief, craters, rocks, albedo grain and light.

Lengths are metres of the bed (1:10). Arrays are [row, col], row 0 at the far end (greatest y). Every part draws from
its own stream of the seed, so that a change of one does not affect the others.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from rille.datasets.mockup.params import SceneParams
from rille.stages.core.arrays import Bytes, Floats, Floats32

OCTAVES = (0.5, 0.25, 0.125, 0.0625, 0.03125, 0.015625, 0.0078125, 0.00390625)
"""Spacings of the relief's octaves, metres. Finer relief, which no camera resolves, is drawn as grain."""

MIN_ROCK_M, MAX_ROCK_M = 0.004, 0.11
MIN_CRATER_M, MAX_CRATER_M = 0.025, 0.35
NO_CEILING_M = -1e9  # m: the ceiling of the shade where there is none


def stream(seed: int, part: int) -> np.random.Generator:
    """Generator of one part of the bed."""
    # Parts in use: 1 to 40 here, 50 images, 60 to 62 motion and its sensors, 70 to 72 the rover. A new part takes a
    # free number, so that its draws are independent.
    return np.random.default_rng([seed, part])


def add_octave(out: Floats32, spacing: float, amplitude: float, rng: np.random.Generator) -> None:
    """Add smooth noise of RMS ``amplitude`` to ``out``: a cubic B-spline, one random value each ``spacing`` nodes."""
    grid = rng.standard_normal([int(n / spacing) + 5 for n in out.shape], dtype=np.float32)
    # Sparse, four weights per node: without BLAS, so that the bits are the same everywhere.
    rows, cols = (
        scipy.interpolate.BSpline.design_matrix(np.arange(n) / spacing, np.arange(-3.0, coefficients + 1), 3)
        for n, coefficients in zip(out.shape, grid.shape, strict=True)
    )
    # RMS of unit white noise after smoothing with the two-dimensional cubic B-spline.
    scale = amplitude / 0.479
    for at in range(0, len(out), 256):  # some rows at a time: a bed's albedo is large
        part = slice(at, at + 256)
        out[part] += scale * (cols @ (rows[part] @ grid).T).T


def relief(p: SceneParams, shape: tuple[int, int]) -> Floats32:
    """Fractal relief, float32 metres, mean zero."""
    out = np.zeros(shape, np.float32)
    for k, wave in enumerate(OCTAVES):
        # Hurst's exponent: natural terrain is self-affine with 0.7-0.9 (e.g. Rosenburg 2011, LOLA).
        amplitude = p.relief * (wave / OCTAVES[0]) ** 0.85
        if wave >= 2.0 * p.cell:
            add_octave(out, wave / p.cell, amplitude, stream(p.seed, 10 + k))
    return out


def _sizes(rng: np.random.Generator, count: float, least: float, most: float) -> Floats:
    """Diameters of a population with N(>D) ~ D^-2 between ``least`` and ``most``, in order of their placement."""
    n = int(rng.poisson(count))
    u = rng.random(n)
    # The inverse of N(>D) ~ D^-2 cut off at both ends, so that uniform numbers give sizes.
    return np.asarray(1.0 / np.sqrt(least**-2 + u * (most**-2 - least**-2)), dtype=np.float64)


def _patch(
    height: Floats32, cell: float, place: Sequence[float] | Floats, reach: float
) -> tuple[tuple[slice, slice], Floats, Floats]:
    """Window of the nodes within ``reach`` metres of a place, and their offsets from it, metres.

    ``place``: x and y from the upper left node, as shares of the bed's width and length.
    """
    rows, cols = height.shape
    x, y = place[0] * cols * cell, place[1] * rows * cell
    c0, c1 = max(int((x - reach) / cell), 0), min(int((x + reach) / cell) + 2, cols)
    r0, r1 = max(int((y - reach) / cell), 0), min(int((y + reach) / cell) + 2, rows)
    dx = np.arange(c0, c1, dtype=np.float64) * cell - x
    dy = np.arange(r0, r1, dtype=np.float64) * cell - y
    return (slice(r0, r1), slice(c0, c1)), dx[None, :], dy[:, None]


def add_craters(height: Floats32, p: SceneParams) -> None:
    """Add bowls with raised rims; older craters are shallower. Ejecta decrease with distance^-3."""
    rng = stream(p.seed, 1)
    area = (height.shape[0] * p.cell) * (height.shape[1] * p.cell)
    # The parameter counts craters above 0.1 m; by D^-2 the number above the least size is larger by this factor.
    count = p.craters * area * (0.1 / MIN_CRATER_M) ** 2
    for diameter in _sizes(rng, count, MIN_CRATER_M, MAX_CRATER_M):
        *place, age = rng.random(3)
        window, dx, dy = _patch(height, p.cell, place, 1.5 * diameter)
        # Age 0 is the oldest crater, which is the shallowest.
        depth = diameter * (0.05 + 0.13 * age)
        rim = 0.22 * depth
        q = np.sqrt(dx**2 + dy**2) / (0.5 * diameter)
        inside = rim - (depth + rim) * (1.0 - q**2)
        # Shifted and stretched to reach 0 without a step at three radii, where the patch ends.
        outside = rim * (1.0 / np.maximum(q, 1.0) ** 3 - 1.0 / 27.0) / (1.0 - 1.0 / 27.0)
        # A soft minimum of both rounds the rim over a tenth of the radius.
        bowl = 0.5 * (inside + outside - np.sqrt((inside - outside) ** 2 + (0.1 * rim) ** 2))
        height[window] += np.where(q < 3.0, bowl, 0.0).astype(np.float32)


class _Rock(NamedTuple):
    """``diameter`` m of the long axis; ``aspect``, short over long; ``draws`` (5,) in 0..1 for turn, broken faces and
    tint; ``places``: shares of the bed's width and length, tried one after the other."""

    diameter: float
    aspect: float
    draws: Floats
    places: Iterable[Floats]


def add_rocks(height: Floats32, p: SceneParams) -> Floats32:
    """Put rocks of profile 1 - q^4 (bounded slopes) on the ground; return their tint, the albedo relative to it."""
    area = (height.shape[0] * p.cell) * (height.shape[1] * p.cell)
    rough = np.zeros_like(height)  # relief of the rocks' faces relative to their height
    for k, wave in enumerate((0.016, 0.008, 0.004)):
        add_octave(rough, max(wave / p.cell, 1.0), 0.5**k, stream(p.seed, 20 + k))
    stones, tint = np.zeros_like(height), np.ones_like(height)
    for rock in _scattered(p, area) if p.rock_cover is None else _beside_each_other(p, p.rock_cover, area):
        for place in rock.places:
            window, dx, dy = _patch(height, p.cell, place, 0.8 * rock.diameter)
            stone = _stone(dx, dy, rock, rough[window])
            if p.rock_cover is not None and (stones[window][stone > 0] > 0).any():
                continue
            brightness = np.float32(0.75 + 0.6 * rock.draws[2])
            tint[window] = np.where(stone > stones[window], brightness, tint[window])
            stones[window] = np.maximum(stones[window], stone)
            break
    height += stones
    return tint


def _scattered(p: SceneParams, area: float) -> Iterator[_Rock]:
    """Rocks at random positions, by number per square metre; they may overlap."""
    rng = stream(p.seed, 2)
    # The parameter counts rocks above 30 mm.
    for diameter in _sizes(rng, p.rocks * area * (0.03 / MIN_ROCK_M) ** 2, MIN_ROCK_M, MAX_ROCK_M):
        x, y, turn, b, *others = rng.random(8)
        yield _Rock(diameter, 0.65 + 0.35 * b, np.array([turn, *others]), [np.array([x, y])])


def _beside_each_other(p: SceneParams, cover: float, area: float) -> Iterator[_Rock]:
    """Rocks, the largest first, that cover a share of the bed."""
    rng = stream(p.seed, 3)
    for diameter in cover_sizes(rng, cover, area):
        b, *draws = rng.random(6)
        aspect = 0.65 + 0.35 * b
        # The ellipse has the area of a circle of that diameter.
        # At a cover of 0.3 one rock in a thousand finds no place.
        places = (rng.random(2) for _ in range(300))
        yield _Rock(diameter / np.sqrt(aspect), aspect, np.array(draws), places)


def cover_sizes(rng: np.random.Generator, cover: float, area: float) -> Floats:
    """Diameters, metres of the bed, decreasing, of rocks that together cover a share of an area (m2).

    The law is that of Golombek and Rapp (1997), doi:10.1029/96JE03319: the share under rocks wider than D metres falls
    with exp(-q D), q = 1.79 + 0.152 / cover, at full scale. Sizes are drawn one from each equal part of the numbers.
    """
    # Ten metres of Mars or Moon are one of the bed.
    q = (1.79 + 0.152 / cover) * 10.0
    # The widest rock has 1.5 m at full scale.
    d = np.geomspace(MIN_ROCK_M, 0.15, 2000)
    covered = np.exp(-q * d[0]) - np.exp(-q * d)
    middle = np.sqrt(d[1:] * d[:-1])
    number = np.concatenate([[0.0], np.cumsum(np.diff(covered) / (0.25 * np.pi * middle**2))])
    count = round(number[-1] * cover * area / covered[-1])
    u = (np.arange(count) + rng.random(count)) / max(count, 1)
    return np.asarray(np.interp(u * number[-1], number, d)[::-1], dtype=np.float64)


def _stone(dx: Floats, dy: Floats, rock: _Rock, rough: Floats32) -> Floats32:
    """Heights (row, col) of one rock at offsets (dx, dy) from its middle, metres; 0 beside it."""
    a, c, e, g, s = rock.draws
    diameter = rock.diameter
    turn = 2.0 * np.pi * a
    u, v = np.cos(turn) * dx + np.sin(turn) * dy, -np.sin(turn) * dx + np.cos(turn) * dy
    v = v / rock.aspect
    bearing = np.arctan2(v, u)
    outline = 1.0 + 0.10 * np.cos(3.0 * bearing + 6.3 * c) + 0.06 * np.cos(5.0 * bearing + 6.3 * e)
    q = np.sqrt(u**2 + v**2) / (0.5 * diameter * outline)
    # Tilted faces cut the body, as of broken stones; the profile bounds the other slopes.
    shape = 1.0 - q**4
    for k in range(3):
        way = 6.3 * g + 2.1 * k + c
        shape = np.minimum(shape, 0.70 + 0.15 * k + (0.35 + 0.2 * k) * (np.cos(way) * u + np.sin(way) * v) / diameter)
    stone = min(diameter * (0.25 + 0.35 * s), 0.04) * (shape + 0.06 * rough * np.maximum(shape, 0.0))
    return np.asarray(np.where(q < 1.0, np.maximum(stone, 0.0), 0.0), dtype=np.float32)


def albedo(p: SceneParams, nodes: tuple[int, int]) -> Bytes:
    """Relative albedo, 128 = mean, uint8, on a grid of half the cell size (2 rows - 1, 2 cols - 1).

    Grain in octaves from 33 mm down to a texel, 30-1000 cycles/m. Grain finer than 8 mm also represents the shading of
    relief that no camera resolves, and has twice the contrast.
    """
    shape = (2 * nodes[0] - 1, 2 * nodes[1] - 1)
    texel = 0.5 * p.cell
    log = np.zeros(shape, np.float32)
    for k, wave in enumerate((0.128, 0.032, 0.016, 0.008, 0.004, 0.002, 0.001)):
        if wave >= 2.0 * texel:
            add_octave(log, wave / texel, p.grain * (2.0 if wave < 0.008 else 1.0), stream(p.seed, 30 + k))
    log += np.float32(2.0 * p.grain) * stream(p.seed, 40).standard_normal(shape, dtype=np.float32)
    # Log-normal: contrasts of the octaves multiply, and albedos are positive.
    return np.clip(128.0 * np.exp(log) + np.float32(0.5), 1, 255).astype(np.uint8)


def halve(a: Bytes) -> Bytes:
    """Next level of a texture: rounded means of 2 x 2, odd sizes edge-replicated."""
    a = np.pad(a, ((0, a.shape[0] % 2), (0, a.shape[1] % 2)), mode="edge")
    # Four bytes add up to 1020.
    total = a[::2, ::2].astype(np.uint16) + a[::2, 1::2] + a[1::2, ::2] + a[1::2, 1::2]
    return ((total + 2) >> 2).astype(np.uint8)


def sunlit(height: Floats32, p: SceneParams) -> Bytes:
    """Share of the sun's disc that each node sees, 0..255 (cast shadows only, not the slope's own).

    Sixteen points of the disc each cast a sharp shadow; together these have edges that widen with distance.
    """
    points = 16
    count = np.zeros(height.shape, np.uint8)
    for k in range(points):
        # Square roots and the golden angle (Vogel's spiral) spread the points evenly over the disc, that of
        # a studio lamp, 1.5 degrees wide: shadows have soft edges.
        radius, angle = 0.75 * np.sqrt((k + 0.5) / points), k * 2.39996323
        # Off the horizon and the zenith: there tan() is 0, or has no end.
        elevation = np.deg2rad(np.clip(p.sun_elevation_deg + radius * np.sin(angle), 0.5, 89.5))
        # An angle on the sky spans more azimuth the higher it stands.
        azimuth = np.deg2rad(p.sun_azimuth_deg) + np.deg2rad(radius * np.cos(angle)) / np.cos(elevation)
        # Direction of the light in nodes: away from the sun; rows increase towards the viewer.
        step_r, step_c = np.cos(azimuth), -np.sin(azimuth)
        longer = max(abs(step_c), abs(step_r))
        step_r, step_c = step_r / longer, step_c / longer
        drop = float(np.hypot(step_c, step_r)) * p.cell * float(np.tan(elevation))
        # Views whose rows the light crosses one after the other.
        if abs(step_r) == 1.0:
            lines, lit, along, across = height, count, step_r, step_c
        else:
            lines, lit, along, across = height.T, count.T, step_c, step_r
        order = 1 if along > 0 else -1
        _count_lit(lines[::order], lit[::order], float(across), (k + 0.5) / points, drop)
    return np.asarray(count.astype(np.uint16) * 255 // points, dtype=np.uint8)


def _count_lit(height: Floats32, out: Bytes, across: float, phase: float, drop: float) -> None:
    """Add one to ``out`` where light arrives, which moves by (1, ``across``) nodes and descends by ``drop`` metres.

    The ceiling of the shade is swept along the rows, S(p) = max(h(q), S(q)) - drop at the node's predecessor q; along
    a row the line is rounded to nodes, since interpolation would erode narrow shadows.
    """
    width = height.shape[1]
    shade = np.full(width, NO_CEILING_M)
    for k, line in enumerate(height):
        shift = int(np.floor(k * across + phase)) - int(np.floor((k - 1) * across + phase))
        ceiling = np.full(width, NO_CEILING_M)
        ceiling[max(shift, 0) : width + min(shift, 0)] = shade[max(-shift, 0) : width + min(-shift, 0)] - drop
        arrives = line >= ceiling
        out[k] += arrives
        shade = np.where(arrives, line, ceiling)
