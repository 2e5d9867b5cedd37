"""Hierarchical feature vector matching: dense two-dimensional disparities of any two images (paper, 4.3).

Nothing is rectified and no calibration is used. ``match`` works on plain arrays; see
:class:`~rille.stages.hfvm.images.params.HfvmParams` for the presets. The rooms, in the order of the dataflow:

- ``tiled`` composes the matcher of windows: for images in memory here, as tasks in ``tile_stage`` and ``join_stage``.
- ``images`` holds the parameters, and gives each window its grey values, masks and features.
- ``coarse_to_fine`` goes down the pyramid; its solver of a level is the fast search, with preset ``accurate`` improved
  along paths, or that of preset ``paper``.
- ``level`` matches one level: features, search, propagation, the paper's version to the letter, consistency.
- ``finish`` treats the finest level: sub-pixel refinement, standard deviations, filling.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.declare import AnyArray, Array, Bundle, Inputs, Memory, Stage
from rille.stages.core.validity import Mask, counts, matched
from rille.stages.hfvm import tiled
from rille.stages.hfvm.coarse_to_fine import start
from rille.stages.hfvm.images.params import HfvmParams
from rille.stages.hfvm.images.views import Plain
from rille.stages.hfvm.tiled import Tell
from rille.stages.imaging import pyramid
from rille.stages.imaging.pyramid import Pyramid, PyramidParams

__all__ = ["OUTPUTS", "STAGE", "Disparity", "HfvmParams", "facts", "match", "match_pyramids"]

Map = NDArray[np.float32]


@dataclass(frozen=True)
class Disparity:
    """Disparity vectors of the left image, right minus left: ``x_right = x_left + column_disparity``.

    All arrays are (row, col) of the left image. ``column_disparity, row_disparity``: float32 pixels, NaN undefined;
    interpolated ones included. ``validity``: bits of :class:`~rille.stages.core.validity.Validity`.
    ``backmatch_error``: float32 pixels, NaN where the match leaves the right image, and on the planes of textureless
    regions (:mod:`~rille.stages.hfvm.finish.textureless`). ``distance``: float32 mean feature distance at the
    whole-pixel match (byte steps; preset ``paper``: Eq. 1, grey levels), NaN on such planes and where the match
    leaves the right image. ``disparity_std``: float32 pixels, standard deviation of the column disparity (see
    :mod:`~rille.stages.hfvm.finish.uncertainty`), NaN where not ``MATCHED``. ``aligned``: whether the right image was
    pre-aligned by a plane.
    """

    column_disparity: Map
    row_disparity: Map
    validity: Mask
    backmatch_error: Map
    distance: Map
    disparity_std: Map
    aligned: bool


def match(
    left: AnyArray,
    right: AnyArray,
    params: HfvmParams | None = None,
    *,
    valid: tuple[AnyArray | None, AnyArray | None] = (None, None),
    prior: tuple[AnyArray, AnyArray] | None = None,
    tell: Tell | None = None,
    side: int | None = None,
) -> Disparity:
    """Dense disparity vectors from ``left`` to ``right``, searched in two dimensions.

    Parameters
    ----------
    left, right : (row, col) grey images, uint8, uint16 or floating point 0..255; sizes may differ.
    params : matcher's parameters; None: preset ``default``.
    valid : of the left and the right image (row, col), not zero where usable; None: everywhere.
    prior : column and row disparities of the left image, pixels, NaN undefined, to start from (see
        :mod:`rille.stages.hfvm.coarse_to_fine.start`); None: nothing is known.
    tell : called with the progress.
    side : pixels of a tile; None: the whole image. The result does not depend on it, the memory needed does. Presets
        ``accurate`` and those with a relief are matched whole.

    Raises
    ------
    InputError
        An image is not grey or empty, or a mask or the prior has another shape.

    Notes
    -----
    Kolesnik, Paar, Bauer, Ulm (1999), section 4.3. Images without texture or overlap give no error: nothing is
    ``MATCHED``, and the other bits say why.
    """
    levels = PyramidParams()
    a, b = (pyramid.build(image, levels, usable) for image, usable in zip((left, right), valid, strict=True))
    return match_pyramids(a, b, params or HfvmParams(), start.check(prior, left.shape), tell, side)


def match_pyramids(
    left: Pyramid,
    right: Pyramid,
    params: HfvmParams,
    prior: start.Prior | None = None,
    tell: Tell | None = None,
    side: int | None = None,
) -> Disparity:
    """Match two image pyramids as :func:`match` does. ``side``: pixels of a tile; None: whole images."""
    found = tiled.match(Plain.of(left), Plain.of(right), params, prior, tell or (lambda share, step: None), side)
    arrays: dict[str, Any] = found.arrays
    return Disparity(**arrays, aligned=found.aligned)


def _run(params: HfvmParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    left, right = (Pyramid.from_bundle(inputs[port]) for port in ("left", "right"))
    found = tiled.match(Plain.of(left), Plain.of(right), params, None, lambda share, step: None, None)
    return Bundle(found.arrays, facts(found.arrays, params, found.aligned, int(np.count_nonzero(left.valid[0]))))


def facts(arrays: Mapping[str, AnyArray], params: HfvmParams, aligned: bool, usable: int) -> dict[str, Any]:
    """Metadata of disparities; ``usable``: how many pixels of the left image are."""
    bits, ok = counts(arrays["validity"]), matched(arrays["validity"])
    meta = {
        "preset": params.preset,
        "aligned": aligned,
        "usable": usable,
        "match_rate": bits["matched"] / usable if usable else None,
        "counts": bits,
    }
    for name in ("column_disparity", "row_disparity", "disparity_std"):
        meta[f"median_{name}"] = float(np.median(arrays[name][ok])) if ok.any() else None
    return meta


_GRID = ("row", "col")
OUTPUTS = (
    Array("column_disparity", _GRID, "float32", "px", "column in the right image minus column", "nan", "left image"),
    Array("row_disparity", _GRID, "float32", "px", "row in the right image minus row", "nan", "left image"),
    Array("validity", _GRID, "uint8", "1", "bit mask, see stages.core.validity", "", "left image"),
    Array("backmatch_error", _GRID, "float32", "px", "error of matching there and back", "nan", "left image"),
    Array("distance", _GRID, "float32", "1", "least feature distance", "nan", "left image"),
    Array("disparity_std", _GRID, "float32", "px", "standard deviation of the column disparity", "nan", "left image"),
)
STAGE = Stage(
    name="hfvm",
    version=2,
    summary="dense two-dimensional disparities of a stereo pair by hierarchical feature vector matching",
    params=HfvmParams,
    inputs=("left", "right"),
    outputs=OUTPUTS,
    run=_run,
    memory=Memory(fixed=30e6, factor=10.0, result=1.6, lower=("hfvm.preset", "hfvm.finest")),
)
