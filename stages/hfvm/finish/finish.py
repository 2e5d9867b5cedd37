"""The finest level, step by step and window by window: sub-pixel, validity, refinement, isolated patches, filling.

Each step reads rasters of the step before in a window wider than its own by as much as it reaches, which is stated with
it. Steps of a preset that reach over the whole image (propagation along paths, relief) are done whole.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from rille.stages.core.declare import AnyArray
from rille.stages.core.validity import Validity, mark
from rille.stages.geometry import spline
from rille.stages.geometry.scale import effective
from rille.stages.hfvm.coarse_to_fine import hierarchy
from rille.stages.hfvm.coarse_to_fine.hierarchy import Map, Prepared
from rille.stages.hfvm.finish import guided, refine, textureless, uncertainty, variational_refinement
from rille.stages.hfvm.images import denoise, plane
from rille.stages.hfvm.images.params import HfvmParams
from rille.stages.hfvm.images.views import View
from rille.stages.hfvm.images.window import (
    Raster,
    Results,
    Window,
    around,
    blocks,
    cut,
    pick,
    strips,
    thinned,
    whole,
)
from rille.stages.hfvm.level import consistency, epipolar, rowwise
from rille.stages.hfvm.level.window_pair import WindowPair
from rille.stages.hfvm.native.reference import SUM_RADIUS

Rasters = Mapping[str, Raster]


@dataclass(frozen=True)
class Finish:
    """Inputs of all steps: the matched pair (its right image aligned or not), the original right image, parameters."""

    pair: Prepared
    right: View
    params: HfvmParams
    alignment: plane.Matrix | None
    near_sign: float
    contrast: float = 1.0

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns of the left image."""
        return self.pair.shapes(0)[0]

    @property
    def refining(self) -> HfvmParams:
        """Parameters of the refinement: an image that a plane has aligned is sheared, and takes a step more."""
        p = self.params
        return p if self.alignment is None else p.model_copy(update={"refine_steps": p.refine_steps + 1})

    @property
    def scale(self) -> float:
        """Pixels of the right image that one of the left image stands for; 1 where they are alike."""
        return 1.0 if self.alignment is None else effective(plane.scale(self.alignment, self.shape))

    def fine(self, window: Window, a: Map) -> Results:
        """Map of a window of the left image with fractions of a pixel, means of like neighbours; feature distances.

        Reach: those of the sub-pixel search and of the mean.
        """
        outer = window.grow(SUM_RADIUS, SUM_RADIUS, self.shape) if self.params.preset != "paper" else window
        found, inner = hierarchy.fine_tile(self.pair, 0, a, outer, None), window.inside(outer)
        u, v = (found.u, found.v) if self.params.preset == "paper" else _mean(found.u, found.v)
        return {name: np.ascontiguousarray(p[inner]) for name, p in (("u", u), ("v", v), ("distance", found.distance))}

    def back(self, window: Window, b: Map) -> Results:
        """Map of a window of the right image, for the back-matching check alone: whole displacements suffice."""
        if self.params.preset == "paper":
            found = hierarchy.fine_tile(self.pair.reverse(), 0, b, window, None)
            return {"u": found.u, "v": found.v}
        outer = window.grow(SUM_RADIUS, SUM_RADIUS, self.pair.shapes(0)[1])
        own = b.cut(outer)
        u, v = _mean(own.u.astype(np.float32), own.v.astype(np.float32))
        return {name: np.ascontiguousarray(p[window.inside(outer)]) for name, p in (("u", u), ("v", v))}

    def check(self, window: Window, fine: Rasters, back: Rasters) -> Results:
        """Displacements, back-matching error, and validity bits against each pixel."""
        u, v, distance = (cut(fine[name], window) for name in ("u", "v", "distance"))
        error = self._backmatch(window, u, v, back)
        bits = self._reasons(window, distance, error)
        return {"u": u, "v": v, "validity": bits, "error": error}

    def _to_right(self, u: AnyArray, v: AnyArray, window: Window) -> tuple[AnyArray, AnyArray]:
        """Displacements of a window in the original right image."""
        if self.alignment is None:
            return u, v
        return plane.compose(self.alignment, u, v, self.shape, window.x0, window.y0)

    def _backmatch(self, window: Window, u: AnyArray, v: AnyArray, back: Rasters) -> AnyArray:
        error = np.full(window.shape, consistency.FAILED, np.float32)
        shape = self.pair.shapes(0)[1]
        pieces: Iterable[Window] = [whole(shape)]
        if not isinstance(back["u"], np.ndarray):
            y, x = self._ends(window, u, v, 0.5)
            inside = (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])
            pieces = blocks(back["u"], y, x, inside)
        for block in pieces:
            right, valid = (cut(back["u"], block), cut(back["v"], block)), self.pair.right.view.valid(0, block)
            place = WindowPair(window.x0, window.y0, block.x0, block.y0, shape[0], shape[1])
            consistency.backmatch((u, v), right, valid, error, place)
        return error

    def _ends(self, window: Window, u: AnyArray, v: AnyArray, ahead: float = 0.0) -> tuple[AnyArray, AnyArray]:
        """Row and column (int64) of where each displacement of a window leads, rounded down after adding ``ahead``."""
        y, x = np.indices(window.shape, np.float32)
        y, x = y + np.float32(window.y0) + v + np.float32(ahead), x + np.float32(window.x0) + u + np.float32(ahead)
        return np.floor(y).astype(np.int64), np.floor(x).astype(np.int64)

    def _reasons(self, window: Window, distance: AnyArray, error: AnyArray) -> AnyArray:
        """Bits that speak against each pixel, none where it is consistent."""
        p, bits = self.params, np.empty(window.shape, np.uint8)
        deviation, valid = self.pair.deviation(0, window), self.pair.left.view.valid(0, window)
        limits = np.float32(p.threshold), np.float32(p.texture), np.float32(p.backmatch)
        consistency.reasons(distance, deviation, valid, error, limits, bits)
        return bits

    def refine(self, window: Window, checked: Rasters) -> Results:
        """Refined ``u, v``, ``validity``, and the variance ``noise`` that the grey values' noise makes.

        Reach: :func:`rille.stages.hfvm.finish.refine.reach`.
        """
        p, shape = self.refining, self.right.shapes[0]
        reach = refine.reach(p)
        outer = window.grow(reach, reach, self.shape)
        u, v, bits = (cut(checked[name], outer) for name in ("u", "v", "validity"))
        # What is cut may be the raster itself.
        bits = bits.copy()
        keep = bits == 0
        target = whole(shape) if outer == whole(self.shape) else self._read(outer, u, v, keep)
        place = WindowPair(outer.x0, outer.y0, target.x0, target.y0, shape[0], shape[1])
        left, valid = self.pair.left.view.grey(0, outer), self.right.valid(0, target)
        image = self._spline(target)
        to_right = partial(self._to_right, window=outer)
        u, v, rest, noise = refine.refine(left, rowwise.Right(image, valid, place), to_right, u, v, keep, p)
        removed = self.pair.left.view.removed_noise**2, (self.contrast * self.pair.right.view.removed_noise) ** 2
        alike, variance = refine.surroundings(rest, self.pair.deviation(0, outer), keep, removed)
        if p.refine:
            mark(bits, keep & (alike < p.correlation), Validity.OVER_THRESHOLD)
        # Denoising divides the residuals' variance by as many pixels, but a match is placed no better for it.
        noise *= variance * np.float32(denoise.PIXELS) if any(removed) else variance
        there = to_right(u, v)
        if p.variational_steps:
            there = variational_refinement.fit(left, image, valid, *there, bits == 0, p)
            u, v = there if self.alignment is None else plane.decompose(self.alignment, *there)
        keep, found = bits == 0, np.zeros(outer.shape, bool)
        consistency.lands(*there, keep, valid, found, place)
        mark(bits, keep & ~found, Validity.OUT_OF_IMAGE)
        arrays = {"u": u, "v": v, "validity": bits, "noise": noise}
        return {name: np.ascontiguousarray(a[window.inside(outer)]) for name, a in arrays.items()}

    def _spline(self, window: Window) -> AnyArray:
        """Coefficients of the spline through a window of the right image, which is given the left one's contrast."""
        wide = window.grow(spline.RADIUS, spline.RADIUS, self.right.shapes[0])
        image = self.right.grey(0, wide)
        if self.contrast != 1.0:
            image = image * np.float32(self.contrast)
        return np.ascontiguousarray(spline.coefficients(image)[window.inside(wide)])

    def _read(self, window: Window, u: AnyArray, v: AnyArray, keep: AnyArray) -> Window:
        """What refinement may read of the right image: ends of displacements that drift to any side."""
        drift = np.float32(refine.drift(self.refining))
        drifts = [(x, y) for x in (-drift, drift) for y in (-drift, drift)]
        ends = [self._ends(window, *self._to_right(u + x, v + y, window)) for x, y in drifts]
        y, x = (np.stack(part) for part in zip(*ends, strict=True))
        return around(y, x, self.right.shapes[0], 2, np.broadcast_to(keep, y.shape))

    def patches(self, a: Map, refined: Rasters) -> AnyArray:
        """Isolated pixels, uint8 (row, col) of the whole image: how far a patch reaches nobody knows beforehand.

        Room: 11 bytes a pixel.
        """
        u, v = np.empty(self.shape, np.int16), np.empty(self.shape, np.int16)
        keep = np.empty(self.shape, bool)
        for w in strips(refined["validity"]):
            keep[w.slices] = cut(refined["validity"], w) == 0
            u[w.slices], v[w.slices] = cut(a.u, w), cut(a.v, w)
        return consistency.unsupported(u, v, keep, self.params.speckle).view(np.uint8)

    def planes(self, refined: Rasters, gone: Raster) -> textureless.Planes | None:
        """Epipolar lines of the matches, and the planes of textureless regions; None: the matches follow no lines.

        Room: 2 bytes a pixel, and for the features of the next level 4; 16 a pixel of the window of the region at hand,
        and 6 for the other image's features and claims.
        """
        p, shape = self.params, self.shape
        # Without a band rows are free: they are not to be set by lines.
        if p.preset == "paper" or p.band == 0 or self.pair.levels <= textureless.LEVEL:
            return None
        above = self.pair.shapes(textureless.LEVEL)[0]
        unmatched = np.ones((2 * above[0], 2 * above[1]), bool)
        for w in strips(refined["validity"]):
            unmatched[w.slices] = (cut(refined["validity"], w) != 0) | (cut(gone, w) != 0)
        y, x = np.divmod(thinned(unmatched, hierarchy.FIT_SAMPLES, np.logical_not), unmatched.shape[1])
        u, v = (pick(refined[name], y, x) for name in ("u", "v"))
        found = epipolar.fit_points(x, y, u, v, shape, self.pair.shapes(0)[1])
        # Negated, so that NaN is refused as well.
        if found is None or not found[1] <= epipolar.SHARP:
            return None
        f = epipolar.oriented(found[0], shape)
        if not p.textureless:
            return textureless.Planes(np.zeros(above, np.int8), [], f)
        none = (unmatched[::2, ::2] & unmatched[::2, 1::2]) & (unmatched[1::2, ::2] & unmatched[1::2, 1::2])
        along = epipolar.along_line(epipolar.lines_at(f, x, y), u, v)
        return textureless.find(self.pair, f, none, along, -self.near_sign)

    def final(
        self,
        window: Window,
        fine: Rasters,
        checked: Rasters,
        refined: Rasters,
        gone: Raster,
        planes: textureless.Planes | None,
    ) -> Results:
        """Everything that :class:`~rille.stages.hfvm.Disparity` has.

        The result of a window depends on pixels around it: those within reach of the filling along rows, of the
        standard deviation, and of the neighbours that must agree with a match (``lonely``, ``supported``).
        """
        p = self.params
        near = uncertainty.SURROUNDINGS // 2 + consistency.CROWD // 2 + consistency.SUPPORT // 2
        extra = guided.RADIUS if p.guided_fill else 0
        # Filling reaches along rows alone; whether the match that it ends at is borne out, its surroundings say.
        outer = window.grow(near + extra, max(near, p.fill_reach + consistency.SUPPORT // 2) + extra, self.shape)
        u, v = (cut(refined[name], outer).copy() for name in ("u", "v"))
        validity, removed = cut(refined["validity"], outer).copy(), cut(gone, outer) != 0
        left, valid = self.pair.left.view.grey(0, outer), self.pair.left.view.valid(0, outer)
        error, distance = cut(checked["error"], outer).copy(), cut(fine["distance"], outer).copy()
        keep = validity == 0
        removed &= keep
        blank = consistency.supported(validity == Validity.NO_TEXTURE, keep & ~removed)
        keep |= blank
        region, plane_std = np.zeros(keep.shape, np.int8), np.zeros(keep.shape, np.float32)
        if planes is not None and planes.terms:
            region, plane_u, plane_v, plane_std = planes.cut(outer)
            # A pixel of the level above is usable if most of its four are.
            region[(valid == 0) | (keep & ~removed)] = 0
            u, v = np.where(region != 0, plane_u, u), np.where(region != 0, plane_v, v)
        on_plane, beside = region > 0, region < 0
        # What was found about another displacement does not apply.
        error[on_plane], distance[on_plane] = consistency.FAILED, -1.0
        keep, removed = keep | on_plane, removed & ~on_plane
        validity[blank | on_plane] = 0
        # Matches with too few agreeing neighbours are too uncertain to count as measured, but remain the best guess.
        lonely = consistency.lonely(keep & ~removed, p.min_support)
        mark(validity, removed | lonely, Validity.SPECKLE)
        interpolated = (lonely | beside).astype(np.uint8)
        consistency.fill_rows(u, v, (keep & ~removed) | beside, p.fill_reach, self.near_sign or -1.0, interpolated)
        keep &= ~removed & ~lonely
        noise = cut(refined["noise"], outer)
        # For the deviation of their neighbours all without texture count as unmatched.
        std = uncertainty.standard_deviation(noise, u, keep & ~blank & ~on_plane, p)
        if blank.any():
            std[blank] = np.hypot(uncertainty.standard_deviation(noise, u, keep, p)[blank], uncertainty.BLANK)
        on_plane &= keep
        std[on_plane] = plane_std[on_plane]
        # A masked pixel is no part of the image, so it is not filled either.
        interpolated[valid == 0] = 0
        if p.guided_fill:
            u, v = guided.median(u, v, keep, interpolated, left)
        if planes is not None:
            # A filled pixel has its neighbour's depth, not its row: between turned cameras rows change along a row.
            epipolar.settle_rows(planes.f, u, v, interpolated, outer.x0, outer.y0)
        u, v = self._to_right(u, v, outer)
        consistency.conclude(validity, keep, interpolated, u, v, error, distance)
        arrays = {
            "column_disparity": u,
            "row_disparity": v,
            "validity": validity,
            "backmatch_error": error,
            "distance": distance,
            # Found in pixels of the aligned image, as displacements were.
            "disparity_std": std * np.float32(self.scale),
        }
        return {name: np.ascontiguousarray(a[window.inside(outer)]) for name, a in arrays.items()}


def _mean(u: AnyArray, v: AnyArray) -> tuple[AnyArray, AnyArray]:
    """Means of like neighbours."""
    mean_u, mean_v = np.empty_like(u), np.empty_like(v)
    rowwise.local_mean(u, v, np.ones(u.shape, bool), SUM_RADIUS, 2, mean_u, mean_v)
    return mean_u, mean_v
