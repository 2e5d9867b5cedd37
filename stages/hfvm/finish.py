"""The finest level, step by step and window by window: sub-pixel, validity, refinement, isolated patches, filling.

Each step reads rasters of the step before in a window wider than its own by as much as it reaches, which is stated with
it. Steps of a preset that reach over the whole image (propagation along paths, relief) are done whole.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from stages.declare import AnyArray
from stages.hfvm import consistency, guided, hierarchy, plane, refine, relief, rowwise, uncertainty
from stages.hfvm.hierarchy import SUM_RADIUS, Map, Prepared
from stages.hfvm.params import HfvmParams
from stages.hfvm.views import View
from stages.hfvm.window import Raster, Results, Window, around, blocks, cut, strips, thinned, whole
from stages.validity import Validity, mark

Rasters = Mapping[str, Raster]


@dataclass(frozen=True)
class Finish:
    """What all steps know: the pair that was matched (its right image aligned or not), and the original right image."""

    pair: Prepared
    right: View
    params: HfvmParams
    alignment: plane.Matrix | None
    near_sign: float

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns of the left image."""
        return self.pair.shapes(0)[0]

    def fine(self, window: Window, a: Map, b: Map, backward: bool = False) -> Results:
        """Sub-pixel map ``u, v, distance`` of a window of the left (``backward``: right) image."""
        pair = self.pair.reverse() if backward else self.pair
        # Sub-pixel work pays only where the whole-pixel maps nearly agree.
        error = hierarchy.integer_error(pair, 0, a.cut(window), b, window)
        return hierarchy.fine_tile(pair, 0, a, window, error <= self.params.backmatch + 1.0)

    def check(self, window: Window, fine: Rasters, back: Rasters) -> Results:
        """Back-matching error, validity bits against each pixel, and mean displacements in the original right image.

        Reach: the local mean.
        """
        outer = window.grow(SUM_RADIUS, SUM_RADIUS, self.shape)
        u, v, distance = (cut(fine[name], outer) for name in ("u", "v", "distance"))
        error = self._backmatch(outer, u, v, back)
        bits = self._reasons(outer, distance, error)
        if self.alignment is not None:
            u, v = plane.compose(self.alignment, u, v, self.shape, outer.x0, outer.y0)
        if self.params.preset != "paper":
            mean_u, mean_v = np.empty_like(u), np.empty_like(v)
            rowwise.local_mean(u, v, bits == 0, SUM_RADIUS, mean_u, mean_v)
            u, v = mean_u, mean_v
        arrays = {"u": u, "v": v, "validity": bits, "error": error}
        return {name: np.ascontiguousarray(a[window.inside(outer)]) for name, a in arrays.items()}

    def _backmatch(self, window: Window, u: AnyArray, v: AnyArray, back: Rasters) -> AnyArray:
        error = np.full(window.shape, consistency.FAILED, np.float32)
        shape = self.pair.shapes(0)[1]
        y, x = self._ends(window, u, v)
        inside = (x >= 0) & (x <= shape[1] - 1) & (y >= 0) & (y <= shape[0] - 1)
        for block in blocks(back["u"], y, x, inside):
            outer = block.grow(1, 1, shape)
            args = cut(back["u"], outer), cut(back["v"], outer), self.pair.right.view.valid(0, outer)
            place = window.x0, window.y0, outer.x0, outer.y0, shape[0], shape[1]
            consistency.backmatch(u, v, *args, error, *place)
        return error

    def _ends(self, window: Window, u: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray]:
        """Row and column (int64) of the pixel above and left of where each displacement of a window leads."""
        y, x = np.indices(window.shape, np.float32)
        y, x = y + np.float32(window.y0) + v, x + np.float32(window.x0) + u
        return np.floor(y).astype(np.int64), np.floor(x).astype(np.int64)

    def _reasons(self, window: Window, distance: AnyArray, error: AnyArray) -> AnyArray:
        """Bits that speak against each pixel, none where it is consistent."""
        p, bits = self.params, np.zeros(window.shape, np.uint8)
        outside = (error >= consistency.FAILED) | (self.pair.left.view.valid(0, window) == 0)
        mark(bits, outside, Validity.OUT_OF_IMAGE)
        mark(bits, distance > p.threshold, Validity.OVER_THRESHOLD)
        mark(bits, self.pair.deviation(0, window) < p.texture, Validity.NO_TEXTURE)
        mark(bits, ~outside & (error > p.backmatch), Validity.BACKMATCH_FAILED)
        return bits

    def contrast(self, checked: Rasters) -> float | None:
        """Factor for the right image, see :func:`stages.hfvm.refine.contrast`."""
        if not self.params.refine:
            return None

        def usable(bits: AnyArray) -> AnyArray:
            keep = bits == 0
            keep[:, -refine.STRIDE :] = False
            return keep

        chosen = thinned(checked["validity"], refine.SAMPLES, usable, up=True)
        return refine.contrast(Level(self.pair.left.view), Level(self.right), checked["u"], checked["v"], chosen)

    def refine(self, window: Window, checked: Rasters, factor: float | None) -> Results:
        """Refined ``u, v``, ``validity`` and residual variance ``rest``. Reach: :func:`stages.hfvm.refine.reach`."""
        p, shape = self.params, self.right.shapes[0]
        reach = refine.reach(p) if p.refine else 0
        outer = window.grow(reach, reach, self.shape)
        u, v, bits = (cut(checked[name], outer) for name in ("u", "v", "validity"))
        bits = bits.copy()
        keep = bits == 0
        # The relief's windows are not bounded: it is given the whole image.
        target = whole(shape) if p.relief_steps else around(*self._ends(outer, u, v), shape, refine.drift(p), keep)
        place = outer.x0, outer.y0, target.x0, target.y0, shape[0], shape[1]
        left, valid = self.pair.left.view.grey(0, outer), self.right.valid(0, target)
        image = self.right.grey(0, target)
        if factor is not None:
            image = image * np.float32(factor)
        rest = np.full(outer.shape, np.inf, np.float32)
        if p.refine:
            u, v, rest = refine.refine(left, image, valid, u, v, keep, p, place)
            alike = refine.correlation(rest, self.pair.deviation(0, outer), keep)
            mark(bits, keep & (alike < p.correlation), Validity.OVER_THRESHOLD)
        if p.relief_steps:
            u, v = relief.fit(left, image, valid, u, v, bits == 0, p)
        keep, found = bits == 0, np.zeros(outer.shape, bool)
        consistency.lands(u, v, keep, valid, found, *place)
        mark(bits, keep & ~found, Validity.OUT_OF_IMAGE)
        arrays = {"u": u, "v": v, "validity": bits, "rest": rest}
        return {name: np.ascontiguousarray(a[window.inside(outer)]) for name, a in arrays.items()}

    def patches(self, fine: Rasters, refined: Rasters) -> AnyArray:
        """Isolated pixels, uint8 (row, col) of the whole image: how far a patch reaches nobody knows beforehand.

        14 bytes a pixel.
        """
        u, v = np.empty(self.shape, np.float32), np.empty(self.shape, np.float32)
        keep = np.empty(self.shape, bool)
        for w in strips(refined["validity"]):
            keep[w.slices] = cut(refined["validity"], w) == 0
            u[w.slices], v[w.slices] = cut(fine["u"], w), cut(fine["v"], w)
        return consistency.unsupported(u, v, keep, self.params.speckle).astype(np.uint8)

    def final(self, window: Window, fine: Rasters, checked: Rasters, refined: Rasters, gone: Raster) -> Results:
        """Everything that :class:`~stages.hfvm.Disparity` has.

        Reach: that of filling along rows, of the uncertainty and of what counts as lonely.
        """
        p, near = self.params, uncertainty.SURROUNDINGS // 2 + consistency.CROWD // 2
        extra = guided.RADIUS if p.guided_fill else 0
        outer = window.grow(near + extra, max(near, p.fill_reach) + extra, self.shape)
        u, v, rest = (cut(refined[name], outer).copy() for name in ("u", "v", "rest"))
        validity, removed = cut(refined["validity"], outer).copy(), cut(gone, outer) != 0
        left, valid = self.pair.left.view.grey(0, outer), self.pair.left.view.valid(0, outer)
        keep = validity == 0
        removed &= keep
        # Lonely matches are too uncertain to count as measured, but still the best guess where they are.
        lonely = consistency.lonely(keep & ~removed, p.crowd)
        mark(validity, removed | lonely, Validity.SPECKLE)
        interpolated = lonely.astype(np.uint8)
        consistency.fill_rows(u, v, keep & ~removed, p.fill_reach, self.near_sign or -1.0, interpolated)
        keep &= ~removed & ~lonely
        mark(validity, keep, Validity.MATCHED)
        std = uncertainty.standard_deviation(left, rest if p.refine else None, u, keep, p)
        interpolated[valid == 0] = 0
        if p.guided_fill:
            u, v = guided.median(u, v, keep, interpolated, left)
        validity |= interpolated * np.uint8(Validity.INTERPOLATED)
        nothing = ~(keep | (interpolated != 0))
        u[nothing] = v[nothing] = np.nan
        error, distance = cut(checked["error"], outer).copy(), cut(fine["distance"], outer)
        error[error >= consistency.FAILED] = np.nan
        distance = np.where(distance < 0, np.float32(np.nan), distance)
        arrays = {
            "column_disparity": u,
            "row_disparity": v,
            "validity": validity,
            "backmatch_error": error,
            "distance": distance,
            "disparity_std": std,
        }
        return {name: np.ascontiguousarray(a[window.inside(outer)]) for name, a in arrays.items()}


@dataclass(frozen=True)
class Level:
    """Grey values of a view's finest level as a raster."""

    view: View

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return self.view.shapes[0]

    def __getitem__(self, at: tuple[slice, slice]) -> AnyArray:
        """Values of two slices without steps."""
        rows, cols = at
        return self.view.grey(0, Window(rows.start, rows.stop, cols.start, cols.stop))
