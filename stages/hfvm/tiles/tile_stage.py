"""One step of matching a large pair, for one tile: the steps of :mod:`rille.stages.hfvm.finest` as tasks.

Steps ``coarse`` and ``ending`` are of the whole pair, ``fine`` and ``final`` of one tile.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from rille.stages.core.declare import AnyArray, Array, Bundle, stage
from rille.stages.core.errors import InputError
from rille.stages.facts.matching import TileFacts
from rille.stages.hfvm import coarse, finest, matcher, textureless
from rille.stages.hfvm.coarse import Coarse
from rille.stages.hfvm.finest import Ending
from rille.stages.hfvm.image import Window, as_matched, whole
from rille.stages.hfvm.image import tiles as cut
from rille.stages.hfvm.level import Band, PyramidPair, State
from rille.stages.hfvm.native.problem import Map
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.stage import OUTPUTS
from rille.stages.imaging.pyramid import Pyramid

FINE = ("u", "v", "validity", "error", "distance", "noise", "likeness")


def opened(bundle: Bundle) -> Pyramid:
    """Pyramid whose levels are read by windows."""
    names = range(int(bundle.meta["levels"]))
    images, masks = ([bundle.raster(f"{name}_{n}") for n in names] for name in ("level", "valid"))
    return Pyramid(images, masks, float(bundle.meta.get("noise", 0.0)))


def mosaic(parts: Sequence[Bundle], name: str, windows: Sequence[Window], window: Window) -> AnyArray:
    """An array of a window, put together from those of tiles.

    Raises
    ------
    InputError
        There are fewer tiles than the image asks for.
    """
    if len(parts) < len(windows):
        raise InputError(
            "RIL-351",
            f"image of {windows[-1].x1} x {windows[-1].y1} pixels does not have the size that its camera states",
            remedy="correct the camera's width and height",
        )
    out: AnyArray | None = None
    for part, own in zip(parts, windows, strict=False):
        overlap = Window(
            *(f(a, b) for f, a, b in ((max, own.y0, window.y0), (min, own.y1, window.y1))),
            *(f(a, b) for f, a, b in ((max, own.x0, window.x0), (min, own.x1, window.x1))),
        )
        if overlap.y0 < overlap.y1 and overlap.x0 < overlap.x1:
            values = np.asarray(part.raster(name)[overlap.inside(own)])
            out = np.empty(window.shape, values.dtype) if out is None else out
            out[overlap.inside(window)] = values
    assert out is not None
    return out


class TileInputs(NamedTuple):
    """Both pyramids, and results of the steps before."""

    left: Bundle
    right: Bundle
    coarse: Bundle[TileFacts] | None = None
    fine: Sequence[Bundle] = ()
    ending: Bundle[TileFacts] | None = None


@dataclass(frozen=True)
class Task:
    """The inputs of one task, opened. ``side``: pixels of a tile; ``tile``: its number in reading order."""

    params: HfvmParams
    given: TileInputs
    side: int
    tile: int = 0

    @cached_property
    def half(self) -> bool:
        """Whether the pair is matched at half its resolution."""
        return matcher.halves(self.params, *(int(pyramid.meta["levels"]) for pyramid in self.given[:2]))

    @cached_property
    def images(self) -> PyramidPair:
        """Both images at that resolution."""
        params, first = (matcher.halved(self.params), 1) if self.half else (self.params, 0)
        left, right = (as_matched(opened(bundle).above(first), params) for bundle in self.given[:2])
        return PyramidPair(left, right, params, matcher.RECIPES[params.preset])

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns of the left image at that resolution."""
        return self.images.left.shapes[0]

    @cached_property
    def windows(self) -> list[Window]:
        """Tiles of the left image."""
        return cut(self.shape, self.side)

    @property
    def window(self) -> Window:
        """The task's own tile; the last one for those beyond it."""
        return self.windows[min(self.tile, len(self.windows) - 1)]

    @cached_property
    def pair(self) -> Coarse:
        """The result of step ``coarse``."""
        bundle = self.given.coarse
        assert bundle is not None
        meta, (left, right) = bundle.meta, (bundle["left"], bundle["right"])
        oks, band = (left[2] != 0, right[2] != 0), Band(bundle["f"], meta["mu"])
        state = State(meta["level"], Map(*left[:2]), Map(*right[:2]), *oks, band, meta["near_sign"])
        ratio, alignment = (bundle.arrays.get(name) for name in ("ratio", "alignment"))
        blur = meta["blur"][0], meta["blur"][1]
        return Coarse(self.images, state, self.images.right, ratio, alignment, blur=blur).seen()

    def fine(self, window: Window, names: Sequence[str] = FINE) -> dict[str, AnyArray]:
        """Arrays of the tiles' fine results."""
        return {name: mosaic(self.given.fine, name, self.windows, window) for name in names}


def _coarse(task: Task) -> Bundle[TileFacts]:
    pair = coarse.match_coarse_levels(task.images)
    s = pair.state
    arrays = {"left": np.stack([*s.left, s.left_ok]), "right": np.stack([*s.right, s.right_ok]), "f": s.band.f}
    arrays |= {name: a for name, a in (("ratio", pair.ratio), ("alignment", pair.alignment)) if a is not None}
    meta: TileFacts = {
        "level": s.level,
        "unlike": pair.unlike,
        "mu": float(s.band.mu),
        "near_sign": float(s.near_sign),
        "blur": list(pair.blur),
    }
    return Bundle(arrays, meta)


def _fine(task: Task) -> Bundle[TileFacts]:
    return Bundle(finest.match_finest_level(task.pair, task.window), {})


def _ending(task: Task) -> Bundle[TileFacts]:
    ending = finest.fit_lines_and_planes(task.pair, task.fine(whole(task.shape), ("u", "v", "validity")))
    arrays = {} if ending.f is None else {"f": ending.f}
    planes = {} if ending.planes is None else {"region": ending.planes.region}
    return Bundle(arrays | planes, {"terms": [] if ending.planes is None else ending.planes.terms})


def _final(task: Task) -> Bundle[TileFacts]:
    bundle, shape = task.given.ending, task.shape
    assert bundle is not None
    f, terms, planes = bundle.arrays.get("f"), bundle.meta["terms"], None
    if f is not None and terms:
        planes = textureless.Planes(bundle["region"], terms, f)
    ending = Ending(shape, task.pair.state.near_sign, task.pair.alignment, f, planes, task.pair.state.upright)
    # At half the resolution with the neighbours that slopes are taken from.
    window = task.window.grow(1, 1, shape) if task.half else task.window
    arrays = finest.interpolate_undefined(task.pair, window, task.fine(finest.around(task.pair, window)), ending)
    if task.half:
        left, right = (tuple(one.raster("level_0").shape) for one in task.given[:2])
        outer, inner = window.child(left), task.window.child(left)
        valid = np.ascontiguousarray(task.given.left.raster("valid_0")[outer.slices])
        arrays = matcher.doubled(arrays, valid, right, (outer.x0, outer.y0))
        arrays = {name: np.ascontiguousarray(a[inner.inside(outer)]) for name, a in arrays.items()}
    return Bundle(arrays, {})


STEPS: Mapping[str, Callable[[Task], Bundle[TileFacts]]] = {
    "coarse": _coarse,
    "fine": _fine,
    "ending": _ending,
    "final": _final,
}


_GRID = ("row", "col")
_optional = partial(Array, optional=True)
_MATRIX = ("line", "column")
_PARTS = (
    _optional("left", ("plane", *_GRID), "int16", "px", "columns, rows of displacement at level 1; 1 = consistent"),
    _optional("right", ("plane", *_GRID), "int16", "px", "the same of the right image"),
    _optional("f", _MATRIX, "float64", "1", "fundamental matrix, of level 0 or of the band at it"),
    _optional("ratio", ("term",), "float64", "1", "logarithm of the ratio of brightness, see hfvm.brightness"),
    _optional("alignment", _MATRIX, "float64", "1", "homography that the right image is aligned by"),
    _optional("u", _GRID, "float32", "px", "columns of displacement"),
    _optional("v", _GRID, "float32", "px", "rows of displacement"),
    _optional("error", _GRID, "float32", "px", "error of matching there and back"),
    _optional("distance", _GRID, "float32", "1", "least feature distance"),
    _optional("validity", _GRID, "uint8", "1", "bits that speak against a pixel"),
    _optional("noise", _GRID, "float32", "px", "variance by noise, squared pixels"),
    _optional("likeness", _GRID, "float32", "1", "correlation of the residuals of neighbours"),
    _optional("region", _GRID, "int8", "1", "number of the textureless region, at half the resolution"),
)
_RESULTS = tuple(replace(a, optional=True) for a in OUTPUTS if a.name not in ("distance", "validity"))


@stage("hfvm_tile", outputs=(*_PARTS, *_RESULTS))
def hfvm_tile_stage(params: HfvmParams, given: TileInputs, *, step: str, side: int, tile: int = 0) -> Bundle[TileFacts]:
    """One step of matching a large stereo pair, for one tile."""
    return STEPS[step](Task(params, given, side, tile))
