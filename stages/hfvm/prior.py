"""Disparities known beforehand: those of another program, or of a map that is given.

They replace those of the coarse levels at the level on which pre-alignment is decided (2), so that they serve that
decision too, and are refined from there on like any other match. A search of one pixel at each level below corrects an
error of 3 px at full resolution, propagation from better neighbours a greater one. Where nothing is known beforehand,
the result of the coarse levels stays; it costs a tenth of the whole.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray
from rille.stages.core.errors import InputError
from rille.stages.hfvm.level import PyramidPair, State
from rille.stages.hfvm.native.problem import Map


@dataclass(frozen=True)
class PriorDisparities:
    """Column and row displacements (row, col) of level 0, float32 pixels, NaN unknown."""

    u: AnyArray
    v: AnyArray

    def halved(self) -> PriorDisparities:
        """The prior at half the resolution."""
        return PriorDisparities(0.5 * self.u[::2, ::2], 0.5 * self.v[::2, ::2])


def known_beforehand(prior: tuple[AnyArray, AnyArray] | None, shape: tuple[int, ...]) -> PriorDisparities | None:
    """Prior of two arrays; what is not finite or absurdly great counts as unknown.

    Raises
    ------
    InputError
        An array has not the left image's shape.
    """
    if prior is None:
        return None
    u, v = (np.asarray(a, dtype=np.float32) for a in prior)
    if u.shape != shape or v.shape != shape:
        raise InputError(
            "RIL-348",
            f"prior disparities {u.shape} and {v.shape} and the left image {shape} differ",
            remedy="give disparities of the left image, one a pixel",
        )
    return bounded(u, v)


def bounded(u: AnyArray, v: AnyArray) -> PriorDisparities:
    """The prior of these displacements; of those that no level can hold, none is known."""
    # Displacements of a level are 16-bit and doubled from level to level. NaN is not less, and so unknown as well.
    known = np.maximum(np.abs(u), np.abs(v)) < 16000
    return PriorDisparities(np.where(known, u, np.float32(np.nan)), np.where(known, v, np.float32(np.nan)))


def impose(images: PyramidPair, state: State, prior: PriorDisparities | None) -> State:
    """State of the same level with the prior's displacements in both directions where they are known.

    At level 0 (images too small for coarser ones) the whole range has been searched, and nothing is imposed.
    """
    if prior is None or state.level == 0:
        return state
    u, v, known = _coarse(prior, state.level, state.left.u.shape)
    left = _overlay(state.left, u, v, known)
    near = (state.near_sign or -1.0) * np.asarray(v if state.upright else u, np.float64)
    ru, rv, hit = _reverse(u, v, known, state.right.u.shape, near)
    right = _overlay(state.right, ru, rv, hit)
    masks = [image.layers[state.level].valid != 0 for image in (images.left, images.right)]
    left_ok, right_ok = (state.left_ok | known) & masks[0], (state.right_ok | hit) & masks[1]
    return replace(state, left=left, right=right, left_ok=left_ok, right_ok=right_ok)


def _coarse(
    prior: PriorDisparities, level: int, shape: tuple[int, ...]
) -> tuple[AnyArray, AnyArray, NDArray[np.bool_]]:
    """Displacements of a level: medians of the known ones of each block, whole pixels of that level."""
    side = 2**level
    maps = []
    for a in (prior.u, prior.v):
        padded = np.full((shape[0] * side, shape[1] * side), np.nan, np.float32)
        padded[: a.shape[0], : a.shape[1]] = a
        blocks = padded.reshape(shape[0], side, shape[1], side).swapaxes(1, 2).reshape(*shape, side * side)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # blocks without any are NaN, as they should be
            # No means: of a block across a depth edge they lie on neither surface.
            maps.append(np.nanmedian(blocks, axis=2) / side)
    known = np.isfinite(maps[0]) & np.isfinite(maps[1])
    u, v = (np.rint(np.where(known, a, 0.0)).astype(np.int16) for a in maps)
    return u, v, known


def _reverse(
    u: AnyArray, v: AnyArray, known: NDArray[np.bool_], shape: tuple[int, ...], near: AnyArray
) -> tuple[AnyArray, AnyArray, NDArray[np.bool_]]:
    """Displacements of the right image: each left one at its far end; of several the nearest thing's, by ``near``."""
    y, x = np.nonzero(known)
    # From far to near, since of several that meet at a pixel the last one stays: the one that hides the others.
    order = np.argsort(near[y, x], kind="stable")
    y, x = y[order], x[order]
    xr, yr = x + u[y, x].astype(np.intp), y + v[y, x].astype(np.intp)
    inside = (xr >= 0) & (xr < shape[1]) & (yr >= 0) & (yr < shape[0])
    y, x, yr, xr = y[inside], x[inside], yr[inside], xr[inside]
    ru, rv, hit = np.zeros(shape, np.int16), np.zeros(shape, np.int16), np.zeros(shape, bool)
    ru[yr, xr], rv[yr, xr], hit[yr, xr] = -u[y, x], -v[y, x], True
    return ru, rv, hit


def _overlay(m: Map, u: AnyArray, v: AnyArray, known: NDArray[np.bool_]) -> Map:
    return Map(np.where(known, u, m.u), np.where(known, v, m.v))
