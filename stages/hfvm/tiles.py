"""Large pairs: the finest level and what follows in tiles, each with a halo; the coarser levels whole.

::

    coarse (down to level 1) -> fine (each tile) -> ending (lines and planes of the whole) -> final (each tile)

All but a thousandth of the pixels are within .01 px of the result of the pair matched whole: tiles do not see patches
and propagation that reach beyond the halo.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import AnyArray
from rille.stages.hfvm import brightness, epipolar, finest, matcher, plane, start
from rille.stages.hfvm.finest import Ending, Work
from rille.stages.hfvm.image import Image
from rille.stages.hfvm.level import Band, Map, State, Views, descend, hand_down, match_level
from rille.stages.hfvm.matcher import Recipe
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.windows import Shape, Window

HALO = 64
"""Pixels around a tile: 48 that a displacement depends on (rounds, edges, features, sums, refinement), and room for
patches of 40 pixels."""

MARGIN = 40
"""Pixels around the places in the right image that the predictions of a tile lead to: search, rounds, features."""

NEAR = 16
"""Pixels around a window that its filling and standard deviations depend on, besides the reach along rows."""


@dataclass(frozen=True)
class Coarse:
    """The coarse levels: state of level 1, ratio of brightness and homography of the right image, or None."""

    state: State
    ratio: Floats | None
    alignment: plane.Matrix | None


def tileable(params: HfvmParams) -> bool:
    """Whether a preset looks at its surroundings alone: paths and the relief reach over whole images."""
    steps = matcher.recipe_of(params)
    whole = {"paths", "smooth"}
    return params.preset not in matcher.WHOLE and not whole & {
        step.__name__ for step in (*steps.steps.every, *steps.refinement)
    }


def coarse(left: Image, right: Image, params: HfvmParams, recipe: Recipe, prior: start.Prior | None = None) -> Coarse:
    """Match whole images down to level 1, which has a quarter of the pixels."""
    begun = matcher.begin(left, right, params, recipe, prior)
    return Coarse(descend(begun.views, 1, begun.state), begun.ratio, begun.alignment)


@dataclass(frozen=True)
class Pair:
    """Both images as a tile reads them; ``right``: in the left one's brightness, ``matched``: and aligned, if it is."""

    left: Image
    right: Image
    matched: Image
    coarse: Coarse
    params: HfvmParams
    recipe: Recipe

    @staticmethod
    def of(left: Image, right: Image, found: Coarse, params: HfvmParams, recipe: Recipe) -> Pair:
        """Images of whole levels, of which windows are read."""
        right = brightness.levelled(right, found.ratio)
        matched = right if found.alignment is None else plane.aligned(right, found.alignment, left)
        return Pair(left, right, matched, found, params, recipe)

    def fine(self, window: Window) -> dict[str, AnyArray]:
        """Arrays of :class:`~rille.stages.hfvm.finest.Fine` of a window of the left image; displacements to the whole
        matched image."""
        outer = window.grow(HALO, HALO, self.left.shapes[0])
        state, target = self._around(outer)
        a, b = self.left.cut(outer), self.matched.cut(target)
        views = Views(a, b, self.params, self.recipe.steps)
        found = match_level(views, 0, state)
        work = Work(
            a.layers[0],
            b.layers[0],
            b.layers[0],
            found.left,
            found.right,
            self.params,
            self.coarse.alignment,
            (self.left.noise, self.right.noise),
            self.left.shapes[0],
        )
        if self.coarse.alignment is not None:
            work = replace(work, right=self.right.layers[0].cut(self._landing(work)))
        fine = finest.subpixel(work)
        for step in self.recipe.refinement:
            fine = step(work, fine)
        arrays = asdict(fine)
        arrays["u"] = arrays["u"] + np.float32(target.x0 - outer.x0)
        arrays["v"] = arrays["v"] + np.float32(target.y0 - outer.y0)
        return {name: np.ascontiguousarray(a[window.inside(outer)]) for name, a in arrays.items()}

    def _around(self, outer: Window) -> tuple[State, Window]:
        """State of level 1 around a window of level 0, in pixels of it, and the window of the matched image."""
        state, above = self.coarse.state, outer.parent()
        left, right = (hand_down(s, self.params) for s in (state, state.reverse()))
        own = Map(left.u[above.slices], left.v[above.slices])
        y0, y1 = (at + 2 * int(f(own.v)) for at, f in ((outer.y0, np.min), (outer.y1, np.max)))
        x0, x1 = (at + 2 * int(f(own.u)) for at, f in ((outer.x0, np.min), (outer.x1, np.max)))
        target = _bounded(Window(y0, y1, x0, x1), self.matched.shapes[0], MARGIN)
        there = target.parent()
        du, dv = (outer.x0 - target.x0) // 2, (outer.y0 - target.y0) // 2
        other = Map(right.u[there.slices], right.v[there.slices])
        maps = Map(*_shifted(own, du, dv)), Map(*_shifted(other, -du, -dv))
        f = epipolar.moved(state.band.f, (outer.x0, outer.y0), (target.x0, target.y0))
        left_ok, right_ok = (np.ones(m.u.shape, bool) for m in maps)
        return State(1, *maps, left_ok, right_ok, Band(f, state.band.mu), state.near_sign), target

    def _landing(self, work: Work) -> Window:
        """Window of the right image, as it is, that the matches of a window lead to."""
        a = work.a.window
        u, v = work.to_right(work.left.u.astype(np.float32), work.left.v.astype(np.float32))
        y, x = np.arange(a.y0, a.y1)[:, None] + v, np.arange(a.x0, a.x1) + u
        # Relative to the window that stands there until this one is known.
        x, y = x - a.x0 + work.right.window.x0, y - a.y0 + work.right.window.y0
        ends = Window(*(int(n) for n in (np.nanmin(y), np.nanmax(y) + 1, np.nanmin(x), np.nanmax(x) + 1)))
        return _bounded(ends, self.right.shapes[0], MARGIN)

    def ending(self, found: Mapping[str, AnyArray]) -> Ending:
        """What the matches of the whole image tell its tiles."""
        views = Views(self.left, self.matched, self.params, self.recipe.steps)
        state = self.coarse.state
        begun = matcher.Begun(views, state, self.right, alignment=self.coarse.alignment)
        return matcher.end(begun, found, self.recipe, state.near_sign)

    def around(self, window: Window) -> Window:
        """Window that :meth:`final` needs the arrays of."""
        return window.grow(NEAR, NEAR + self.params.fill_reach, self.left.shapes[0])

    def final(self, window: Window, found: Mapping[str, AnyArray], ending: Ending) -> dict[str, AnyArray]:
        """Arrays of the disparities of a window, from those of :meth:`fine` of the window around it."""
        outer = self.around(window)
        arrays = finest.complete(found, self.left.layers[0].cut(outer).valid, outer, self.params, ending)
        return {name: np.ascontiguousarray(a[window.inside(outer)]) for name, a in arrays.items()}


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
