"""The finest level of a pair and what follows, window by window: of the whole image, or of tiles, each with a halo.

::

    coarse levels (whole) -> fine (each window) -> ending (lines and planes of the whole) -> final (each window)

All but a thousandth of the pixels are within .01 px of the result of the pair matched in one window: tiles do not see
patches and propagation that reach beyond the halo.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, replace

import numpy as np

from rille.stages.core.declare import AnyArray
from rille.stages.hfvm import epipolar, finest, textureless
from rille.stages.hfvm.coarse import Coarse
from rille.stages.hfvm.finest import Ending, FinestWork
from rille.stages.hfvm.level import Band, Map, State, hand_down, match_level
from rille.stages.hfvm.windows import Shape, Window, whole
from rille.stages.numeric.threads import side_by_side

Call = Callable[[], dict[str, AnyArray]]

HALO_PX = 64
"""Pixels around a tile: 48 that a displacement depends on (rounds, edges, features, sums, refinement), and room for
patches of 40 pixels."""

TARGET_MARGIN_PX = 40
"""Pixels around the places in the right image that the predictions of a tile lead to: search, rounds, features."""

FILL_MARGIN_PX = 16
"""Pixels around a window that its filling and standard deviations depend on, besides the reach along rows."""


def fine(pair: Coarse, refinement: tuple[finest.Step, ...], window: Window) -> dict[str, AnyArray]:
    """Arrays of :class:`~rille.stages.hfvm.finest.Fine` of a window of the left image; displacements to the whole
    matched image."""
    views, shape = pair.views, pair.views.left.shapes[0]
    outer = window.grow(HALO_PX, HALO_PX, shape)
    state, target = _around(pair, outer)
    a, b = views.left.cut(outer), views.right.cut(target)
    if state.level > 0:
        state = match_level(replace(views, left=a, right=b), 0, state)  # 4.3.4: search, propagate, check, band
    left, right, noise = a.layers[0], b.layers[0], (views.left.noise, views.right.noise)
    work = FinestWork(left, right, right, state.left, state.right, views.params, pair.alignment, noise, shape)
    if pair.alignment is not None:
        work = replace(work, right=pair.right.layers[0].cut(_landing(work, pair.right.shapes[0])))
    result = finest.subpixel(work)  # 4.3.2
    for step in refinement:  # 4.3.3 back-matching, refinement, validation
        result = step(work, result)
    arrays = asdict(result)
    arrays["u"] = arrays["u"] + np.float32(target.x0 - outer.x0)
    arrays["v"] = arrays["v"] + np.float32(target.y0 - outer.y0)
    return {name: np.ascontiguousarray(a[window.inside(outer)]) for name, a in arrays.items()}


def _around(pair: Coarse, outer: Window) -> tuple[State, Window]:
    """State of level 1 around a window of level 0, in pixels of it, and the window of the matched image."""
    state, shape = pair.state, pair.views.right.shapes[0]
    if outer == whole(pair.views.left.shapes[0]):
        return state, whole(shape)
    above = outer.parent()
    left, right = (hand_down(s, pair.views.params) for s in (state, state.reverse()))
    own = Map(left.u[above.slices], left.v[above.slices])
    y0, y1 = (at + 2 * int(f(own.v)) for at, f in ((outer.y0, np.min), (outer.y1, np.max)))
    x0, x1 = (at + 2 * int(f(own.u)) for at, f in ((outer.x0, np.min), (outer.x1, np.max)))
    target = _bounded(Window(y0, y1, x0, x1), shape, TARGET_MARGIN_PX)
    there = target.parent()
    du, dv = (outer.x0 - target.x0) // 2, (outer.y0 - target.y0) // 2
    other = Map(right.u[there.slices], right.v[there.slices])
    maps = Map(*_shifted(own, du, dv)), Map(*_shifted(other, -du, -dv))
    f = epipolar.moved(state.band.f, (outer.x0, outer.y0), (target.x0, target.y0))
    left_ok, right_ok = (np.ones(m.u.shape, bool) for m in maps)
    return State(1, *maps, left_ok, right_ok, Band(f, state.band.mu), state.near_sign), target


def _landing(work: FinestWork, shape: Shape) -> Window:
    """Window of the right image, as it is and of ``shape``, that the matches of a window lead to."""
    a = work.a.window
    u, v = work.to_right(work.left.u.astype(np.float32), work.left.v.astype(np.float32))
    y, x = np.arange(a.y0, a.y1)[:, None] + v, np.arange(a.x0, a.x1) + u
    # Relative to the window that stands there until this one is known.
    x, y = x - a.x0 + work.right.window.x0, y - a.y0 + work.right.window.y0
    ends = Window(*(int(n) for n in (np.nanmin(y), np.nanmax(y) + 1, np.nanmin(x), np.nanmax(x) + 1)))
    return _bounded(ends, shape, TARGET_MARGIN_PX)


def ending(pair: Coarse, arrays: Mapping[str, AnyArray], with_planes: bool) -> Ending:
    """What the matches of the whole image tell its windows: their epipolar lines, and planes without texture."""
    views, sign = pair.views, pair.state.near_sign
    # Without a band rows are free: they are not to be set by lines.
    free = views.params.band == 0 or views.levels <= textureless.REGION_LEVEL
    f = None if free else finest.lines(arrays, (views.left.shapes[0], views.right.shapes[0]))
    planes = finest.planes((views.left, views.right), arrays, f, sign) if f is not None and with_planes else None
    return Ending(sign, pair.alignment, f, planes, views.left.shapes[0])


def around(pair: Coarse, window: Window) -> Window:
    """Window that :func:`final` needs the arrays of."""
    return window.grow(FILL_MARGIN_PX, FILL_MARGIN_PX + pair.views.params.fill_reach, pair.views.left.shapes[0])


def final(pair: Coarse, window: Window, fine_arrays: Mapping[str, AnyArray], ending: Ending) -> dict[str, AnyArray]:
    """Arrays of the disparities of a window, from those of :func:`fine` of the window around it, or of the image."""
    outer, params = around(pair, window), pair.views.params
    if fine_arrays["u"].shape != outer.shape:
        fine_arrays = {name: array[outer.slices] for name, array in fine_arrays.items()}
    arrays = finest.complete(fine_arrays, pair.views.left.layers[0].cut(outer).valid, outer, params, ending)
    return {name: np.ascontiguousarray(a[window.inside(outer)]) for name, a in arrays.items()}


def put_together(calls: Mapping[Window, Call], shape: Shape, threads: int) -> dict[str, AnyArray]:
    """Arrays of an image of ``shape``, from those that calls make of its windows, ``threads`` at a time."""
    parts = side_by_side(list(calls.values()), threads)
    if len(parts) == 1:
        return parts[0]
    total: dict[str, AnyArray] = {}
    for window, arrays in zip(calls, parts, strict=True):
        for name, values in arrays.items():
            total.setdefault(name, np.empty(shape, values.dtype))[window.slices] = values
    return total


def _shifted(m: Map, du: int, dv: int) -> tuple[AnyArray, AnyArray]:
    return m.u + np.int16(du), m.v + np.int16(dv)


def _bounded(window: Window, shape: Shape, margin: int) -> Window:
    """The window, wider by ``margin`` on every side, within an image; two pixels at least, with even borders."""
    (y0, y1), (x0, x1) = (
        _bounds(low - margin, high + margin, size)
        for low, high, size in ((window.y0, window.y1, shape[0]), (window.x0, window.x1, shape[1]))
    )
    return Window(y0, y1, x0, x1)


def _bounds(low: int, high: int, size: int) -> tuple[int, int]:
    first = max(0, min(low, size - 2)) // 2 * 2
    last = (max(high, first + 2) + 1) // 2 * 2
    return first, min(last, size)
