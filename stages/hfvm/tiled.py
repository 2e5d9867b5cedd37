"""The matcher as a composition of windows: of images in memory here, as tasks of the engine in
``rille.stages.hfvm.tile_stage``.

::

    coarse (levels down to plane_level, pre-alignment) -> level (each finer one, both ways; band between them)
      -> fine, back -> check -> refine -> patches, planes -> final

Tiles are matched in any order and of any size with the same result, bit for bit; whole images are one tile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from rille.stages.core.arrays import Floats
from rille.stages.core.validity import matched
from rille.stages.geometry.scale import other_size
from rille.stages.hfvm.coarse_to_fine import hierarchy, start
from rille.stages.hfvm.coarse_to_fine.hierarchy import Prepared, State
from rille.stages.hfvm.finish import refine
from rille.stages.hfvm.finish.finish import Finish
from rille.stages.hfvm.images import brightness, plane, resample, viewpoint
from rille.stages.hfvm.images.params import HfvmParams
from rille.stages.hfvm.images.views import Aligned, Plain, Seen, View
from rille.stages.hfvm.images.window import Raster, Results, Shape, Window, cut, gather, tiles, whole

Tell = Callable[[float, str], None]
"""Called with the share of the work done, 0..1, and what comes next in words."""

COARSE_SHARE, FINE_SHARE = 0.15, 0.65
"""Share of the time when the coarse levels are done, and when all whole-pixel maps are; a level costs four times the
one above."""

KEPT = 31 << 20
"""Bytes: glibc keeps freed memory up to twice the greatest piece it has seen freed, if that is below 32 MiB, and
hands it out again; else each array of a match comes as fresh pages, and those cost an eighth of the whole time."""

FEW = 0.45
"""Share of consistent pixels below which the images may be turned: chance alone makes up to .23 of them so, with preset
``accurate``, which smooths more, up to .40."""

MANY, AGAIN = 0.85, 2
"""Share of consistent pixels from which on no other brightness is tried, and how often matches correct it."""

Order = Callable[[list[Window]], list[Window]]


@dataclass(frozen=True)
class Found:
    """Arrays of :class:`rille.stages.hfvm.Disparity` by name, and the homography by which the right image was
    pre-aligned, or None."""

    arrays: Results
    alignment: plane.Matrix | None

    @property
    def aligned(self) -> bool:
        """Whether the right image was pre-aligned."""
        return self.alignment is not None


@dataclass(frozen=True)
class Coarse:
    """Result of the coarse levels: their maps; homography of a plane and aligned right image, or None; contrast; and
    coefficients of the brightness ratio that is corrected in the right image, or None."""

    state: State
    alignment: plane.Matrix | None
    aligned: Aligned | None
    contrast: float
    ratio: Floats | None = None


def is_whole(params: HfvmParams) -> bool:
    """Whether a preset reaches over whole images: propagation along paths and the relief do."""
    return params.path_rounds > 0 or params.variational_steps > 0


def halves(left: View, right: View, params: HfvmParams) -> bool:
    """Whether images are matched at half their resolution."""
    return params.finest > 0 and min(len(left.shapes), len(right.shapes)) > params.finest


def halved_params(params: HfvmParams) -> HfvmParams:
    """Parameters of a match at half the resolution."""
    return params.model_copy(
        # At half the side an area has a quarter of the pixels.
        update={"finest": 0, "speckle": max(params.speckle // 4, 1), "fill_reach": params.fill_reach // 2}
    )


def prepare(left: View, right: View, params: HfvmParams, side: int | None) -> Prepared:
    """The matcher of two views; features of whole levels are held where the images are matched whole."""
    np.empty(KEPT, np.uint8)  # freed at once, and never touched
    seen = [Seen(view, params, {} if side is None else None) for view in (left, right)]
    return Prepared(seen[0], seen[1], hierarchy.solver(params), params, side)


def coarse(left: View, right: View, params: HfvmParams, side: int | None, prior: start.Prior | None = None) -> Coarse:
    """Match down to ``plane_level``; where a plane explains what is found, align the right image and match anew.

    Where little is found, keypoints may tell how the images are turned or scaled; what then matches more is kept.
    Where brightness differs smoothly, that is undone first.
    """
    pair, state, ratio = _levelled(left, right, params, side)
    right = brightness.levelled(right, ratio)
    state = start.impose(pair, state, prior)
    found = Coarse(state, None, None, contrast(pair, state), ratio)
    if params.preset == "paper":
        return found
    s = hierarchy.sample(pair, state)
    h = plane.find(s.x, s.y, s.u, s.v, state.level, left.shapes, params)
    if h is not None:
        found = replace(_along(left, right, params, side, h, state.near_sign, prior), ratio=ratio)
    if not params.turned or prior is not None:
        return found
    # A plane may also be fitted to the few matches that chance makes.
    if share(found.state) > FEW and (h is not None or not other_size(left.shapes[0], right.shapes[0])):
        return found
    h = viewpoint.find(left, right)
    if h is None:
        return found
    turned = _along(left, right, params, side, h)
    return replace(turned, ratio=ratio) if share(turned.state) > share(found.state) else found


def _levelled(left: View, right: View, params: HfvmParams, side: int | None) -> tuple[Prepared, State, Floats | None]:
    """Coarse levels, and the ratio of brightness that is undone in them; None: none is."""
    pair = prepare(left, right, params, side)
    # Two levels above, where trying another brightness costs about a sixteenth.
    top = hierarchy.run(pair, params, params.plane_level + 2)
    ratio: Floats | None = None
    if params.preset == "paper":
        return pair, hierarchy.run(pair, params, params.plane_level, top), None
    if share(top) < MANY:
        guess = brightness.guess(left, right, top.level)
        if brightness.greatest(guess) > brightness.NOTABLE:
            other = prepare(left, brightness.levelled(right, guess), params, side)
            found = hierarchy.run(other, params, params.plane_level + 2)
            if share(found) > share(top):
                pair, top, ratio = other, found, guess
    state = hierarchy.run(pair, params, params.plane_level, top)
    for _ in range(AGAIN):
        told = brightness.matched(left, right, state.level, state.left.u, state.left.v, state.left_ok)
        if told is None or brightness.greatest(told - (0.0 if ratio is None else ratio)) <= brightness.NOTABLE:
            break
        other = prepare(left, brightness.levelled(right, told), params, side)
        found = hierarchy.run(other, params, params.plane_level)
        if share(found) < share(state):
            break
        pair, state, ratio = other, found, told
    return pair, state, ratio


def _along(
    left: View,
    right: View,
    params: HfvmParams,
    side: int | None,
    h: plane.Matrix,
    near_sign: float = 0.0,
    prior: start.Prior | None = None,
) -> Coarse:
    """Coarse levels of the right image aligned by a homography."""
    aligned = Aligned.of(right, h, left, 0 if side is None else params.plane_level, side)
    pair = prepare(left, aligned, params, side)
    again = hierarchy.run(pair, params, params.plane_level, near_sign=near_sign)
    state = start.impose(pair, again, start.align(prior, h))
    return Coarse(state, h, aligned, contrast(pair, state))


def share(state: State) -> float:
    """Share of the left image's pixels that are consistent."""
    return float(np.mean(np.asarray(state.left_ok)))


def contrast(pair: Prepared, state: State) -> float:
    """Factor for the right image, see :func:`rille.stages.hfvm.finish.refine.contrast`."""
    a, b = (seen.view.grey(state.level, whole(seen.view.shapes[state.level])) for seen in (pair.left, pair.right))
    return refine.contrast(a, b, state.left.u, state.left.v, state.left_ok)


def match(
    left: Plain,
    right: Plain,
    params: HfvmParams,
    prior: start.Prior | None,
    tell: Tell,
    side: int | None,
    order: Order = lambda windows: windows,
) -> Found:
    """All steps, one tile after the other in this process. ``order``: in which tiles are taken."""
    if is_whole(params):
        side = None
    if halves(left, right, params):
        return _enlarged(left, right, params, prior, tell, side, order)
    tell(0.0, "features")
    a, b = left.quiet(params), right.quiet(params)
    begun = coarse(a, b, params, side, prior)
    b = brightness.levelled(b, begun.ratio)
    pair = prepare(a, begun.aligned or b, params, side)
    state = begun.state
    for level in range(state.level - 1, -1, -1):
        tell(COARSE_SHARE + (FINE_SHARE - COARSE_SHARE) * 0.25 ** (level + 1), f"level {level}")
        state = hierarchy.run(pair, params, level, state)
    steps = Finish(pair, b, params, begun.alignment, state.near_sign, begun.contrast)
    return Found(_finish(steps, state, side, order, tell), begun.alignment)


def _finish(steps: Finish, state: State, side: int | None, order: Order, tell: Tell) -> Results:
    shape, other = steps.pair.shapes(0)

    def over(shape: Shape, done: float, words: str, step: Callable[[Window], Results]) -> Results:
        tell(FINE_SHARE + (1.0 - FINE_SHARE) * done, words)
        return gather(shape, ((w, step(w)) for w in order(tiles(shape, side))))

    fine = over(shape, 0.0, "sub-pixel", lambda w: steps.fine(w, state.left))
    back = over(other, 0.35, "sub-pixel", lambda w: steps.back(w, state.right))
    checked = over(shape, 0.45, "refinement", lambda w: steps.check(w, fine, back))
    refined = over(shape, 0.5, "refinement", lambda w: steps.refine(w, checked))
    tell(FINE_SHARE + (1.0 - FINE_SHARE) * 0.85, "filling")
    gone = steps.patches(state.left, refined)
    planes = steps.planes(refined, gone)
    return over(shape, 0.9, "filling", lambda w: steps.final(w, fine, checked, refined, gone, planes))


def _enlarged(
    left: Plain,
    right: Plain,
    params: HfvmParams,
    prior: start.Prior | None,
    tell: Tell,
    side: int | None,
    order: Order,
) -> Found:
    half = left.halved(), right.halved()
    coarser = None if prior is None else start.Prior(0.5 * prior.u[::2, ::2], 0.5 * prior.v[::2, ::2])
    found = match(half[0], half[1], halved_params(params), coarser, tell, side, order)
    shapes = left.shapes[0], right.shapes[0]

    def parts() -> Iterator[tuple[Window, Results]]:
        for w in tiles(half[0].shapes[0], side):
            window = w.child(shapes[0])
            arrays = {k: cut(a, w) for k, a in found.arrays.items()}
            yield window, enlarged(arrays, found.alignment, left.masks[0], window, shapes[1])

    return Found(gather(shapes[0], parts()), found.alignment)


def enlarged(
    found: Results, alignment: plane.Matrix | None, mask: Raster, window: Window, right_shape: Shape
) -> Results:
    """Results at half the resolution as those of a window of full resolution; displacements, twice as great, stand for
    2 x 2 pixels each. ``alignment``: homography of the right image, in pixels of half the resolution, or None.
    ``mask``: of the left image, at full resolution."""
    names = "column_disparity", "row_disparity", "validity", "backmatch_error", "distance"
    out: Results = {name: np.empty(window.shape, np.uint8 if name == "validity" else np.float32) for name in names}
    maps, larger = (tuple(given[name] for name in names) for given in (found, out))
    size = right_shape[0], right_shape[1]
    h = np.zeros((0, 3, 3)) if alignment is None else plane.to_level_0(alignment, 1)[None]
    resample.enlarge(maps, cut(mask, window), size, (h, np.linalg.inv(h)), larger, window.x0, window.y0)
    std = (2.0 * found["disparity_std"]).repeat(2, axis=0)[: window.shape[0]].repeat(2, axis=1)[:, : window.shape[1]]
    std = np.where(matched(out["validity"]), std, np.float32(np.nan)).astype(np.float32)
    return {**out, "disparity_std": std}
