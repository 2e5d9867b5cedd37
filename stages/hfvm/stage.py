"""Hierarchical feature vector matching: dense two-dimensional disparities of any two images (paper, 4.3).

Nothing is rectified and no calibration is used. ``match`` works on plain arrays; :mod:`~rille.stages.hfvm.matcher` has
the method on one page, in the order of the paper, and each preset as a list of steps (their parameters:
:class:`~rille.stages.hfvm.params.HfvmParams`).

- ``image``: grey values, masks and features of windows of an image; ``coarse``: the levels down to 1, with
  ``brightness``, alignment by a ``plane``, and focus.
- ``level``: one level: search, propagation, paths, depth edges, check, band (``epipolar``). ``native``: its loops.
- ``finest``: the finest level, window by window; ``refinement`` of displacements, and their standard deviations;
  ``textureless``: planes.
- ``tiles``: large pairs as tasks. ``paper``: section 4.3 to the letter. ``given``: whether to
  believe another program's disparities.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray, Array, Bundle, Memory, stage
from rille.stages.core.validity import Mask, matched
from rille.stages.facts.matching import DisparityFacts
from rille.stages.hfvm import matcher, paper
from rille.stages.hfvm.coarse import ImageDifference
from rille.stages.hfvm.matcher import WHOLE, MatchOptions
from rille.stages.hfvm.params import HfvmParams
from rille.stages.imaging import pyramid
from rille.stages.imaging.pyramid import Pyramid, PyramidParams

__all__ = ["OUTPUTS", "HfvmParams", "StereoMatches", "facts", "hfvm_stage", "match", "match_pyramids"]

Map = NDArray[np.float32]

DEFAULT_OPTIONS = MatchOptions()


@dataclass(frozen=True)
class StereoMatches:
    """Disparity vectors of the left image, right minus left: ``x_right = x_left + column_disparity``.

    All arrays are (row, col) of the left image. ``column_disparity, row_disparity``: float32 pixels, NaN undefined;
    interpolated ones included. ``validity``: bits of :class:`~rille.stages.core.validity.Validity`.
    ``backmatch_error``: float32 pixels, NaN where the match leaves the right image, and on the planes of textureless
    regions (:mod:`~rille.stages.hfvm.textureless`). ``distance``: float32 mean feature distance at the
    whole-pixel match (byte steps; preset ``paper``: Eq. 1, grey levels), NaN on such planes and where the match
    leaves the right image. ``disparity_std``: float32 pixels, standard deviation of the column disparity, or of the
    row's, where cameras stand one above the other (see
    :mod:`~rille.stages.hfvm.refinement`), NaN where not ``MATCHED``. ``unlike``: how the right image differs.
    """

    column_disparity: Map
    row_disparity: Map
    validity: Mask
    backmatch_error: Map
    distance: Map
    disparity_std: Map
    unlike: ImageDifference

    @property
    def arrays(self) -> dict[str, AnyArray]:
        """All arrays by name."""
        return {output.name: getattr(self, output.name) for output in OUTPUTS}


def match(
    left: AnyArray,
    right: AnyArray,
    params: HfvmParams | None = None,
    *,
    valid: tuple[AnyArray | None, AnyArray | None] = (None, None),
    options: MatchOptions = DEFAULT_OPTIONS,
) -> StereoMatches:
    """Dense disparity vectors from ``left`` to ``right``, searched in two dimensions.

    Parameters
    ----------
    left, right : (row, col) grey images, uint8, uint16 or floating point 0..255; sizes may differ.
    params : matcher's parameters; None: preset ``default``.
    valid : of the left and the right image (row, col), not zero where usable; None: everywhere.
    options : progress, tiles, threads. Tiles need less memory; all but a thousandth of the pixels are within .01 px.
        Presets ``accurate`` and ``paper`` are matched whole.

    Raises
    ------
    InputError
        An image is not grey or empty, or a mask has another shape.

    Notes
    -----
    Kolesnik, Paar, Bauer, Ulm (1999), section 4.3. Images without texture or overlap give no error: nothing is
    ``MATCHED``, and the other bits say why.
    """
    levels = PyramidParams()
    a, b = (pyramid.build(image, levels, usable) for image, usable in zip((left, right), valid, strict=True))
    return match_pyramids(a, b, params or HfvmParams(), options)


def match_pyramids(
    left: Pyramid, right: Pyramid, params: HfvmParams, options: MatchOptions = DEFAULT_OPTIONS
) -> StereoMatches:
    """Match two image pyramids as :func:`match` does."""
    if params.preset in WHOLE:
        arrays, unlike = paper.match(left, right, params, options.tell), ImageDifference()
    else:
        arrays, unlike = matcher.match(left, right, params, options)
    return StereoMatches(**arrays, unlike=unlike)


def facts(arrays: Mapping[str, AnyArray], params: HfvmParams, unlike: ImageDifference, usable: int) -> DisparityFacts:
    """Facts of disparities; ``usable``: how many pixels of the left image are."""
    found: DisparityFacts = {
        "preset": params.preset,
        "aligned": unlike.aligned,
        "usable": usable,
        "match_rate": int(matched(arrays["validity"]).sum()) / usable if usable else None,
    }
    if unlike.blur:
        found["blur"] = unlike.blur
    return found


_GRID = ("row", "col")
OUTPUTS = (
    Array("column_disparity", _GRID, "float32", "px", "column in the right image minus column", "nan", "left image"),
    Array("row_disparity", _GRID, "float32", "px", "row in the right image minus row", "nan", "left image"),
    Array("validity", _GRID, "uint8", "1", "bit mask, see stages.core.validity", "", "left image"),
    Array("backmatch_error", _GRID, "float32", "px", "error of matching there and back", "nan", "left image"),
    Array("distance", _GRID, "float32", "1", "least feature distance", "nan", "left image"),
    Array("disparity_std", _GRID, "float32", "px", "standard deviation along the epipolar line", "nan", "left image"),
)


@stage(
    "hfvm",
    outputs=OUTPUTS,
    memory=Memory(fixed=30e6, factor=10.0, result=1.6, lower=("hfvm.preset",)),
)
def hfvm_stage(params: HfvmParams, left: Bundle, right: Bundle) -> Bundle[DisparityFacts]:
    """Dense two-dimensional disparities of a stereo pair by hierarchical feature vector matching."""
    a, b = Pyramid.from_bundle(left), Pyramid.from_bundle(right)
    found = match_pyramids(a, b, params)
    return Bundle(found.arrays, facts(found.arrays, params, found.unlike, int(np.count_nonzero(a.valid[0]))))
