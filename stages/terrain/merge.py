"""Merge of the elevation models of several basic pairs in one world frame (paper, section 4.5).

All models lie on one lattice, so a cell of the result has one value a model. With sigma the elevation's standard
deviation and r its residual, a model's weight is

    w = 1 / (sigma^2 (1 + (r / r0)^2))        (sigma^-2 is (ds/dZ)^2 but for the disparity's error, equal for all)

Where three or more models meet, one re-weighting about their weighted median takes out the one that contradicts.

The standard deviation of the result has three parts. Each model's own, independent of the others'; what the models
have in common, since they saw the same light and the same shapes (``alike`` is the correlation of two models' errors);
and that of the poses. With s_i the shares of the weights, p_i what the covariance of model i's pose says of the height
there (dz = dC_z + dtheta_x (y - C_y) - dtheta_y (x - C_x)),

    sigma^2 = (1 - alike) sum (s_i sigma_i)^2 + alike (sum s_i sigma_i)^2 + (sum s_i p_i)^2

Poses of models that overlap have nearly all of their way in common, so that their errors neither average out over the
models nor over the cells of one. ``relief_std`` is the first part alone (alike = 0): that of a cell against the ground
around it, which is what slopes and steps are judged by.

A tile is merged in strips of lines, of each model only the strip is read: what is in memory at once is bounded by
:data:`STRIP_BYTES`, however many models meet and however large they are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.arrays import Bytes, Floats, Floats32
from rille.stages.core.declare import Bundle, Memory, Params, raster, stage
from rille.stages.core.errors import InputError
from rille.stages.facts.terrain import DemFacts, MergeFacts
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lattice import Lattice, Window
from rille.stages.geometry.pose_arrays import REFERENCE_PLANE
from rille.stages.numeric.holes import close_holes
from rille.stages.terrain.merge_kernel import CellMaps, Rule, Stack, merge_cells
from rille.stages.terrain.radiometry import LOG_GAIN_STEP

RESIDUAL_SCALE_PX = 0.1
"""Residual that halves a model's weight: the error of a good disparity."""
MIN_KNOWN_SHARE = 0.5
"""Of the ground around a cell, for it to be closed."""
ORTHO_WEIGHT_EXPONENT = 8  # exponent of the ortho image's weights: the best image, but without a visible seam
STRIP_BYTES = 1 << 26
"""Bytes of the models that are in memory at once: 64 MiB are all of a usual tile, and a part where dozens meet."""


class MergeParams(Params):
    """Parameters of the stage ``merge``."""

    # Chosen with the simulator's models at their true poses on 21 November 2026: with it 70 % of the merged errors are
    # below one standard deviation.
    alike: float = Field(
        0.8,
        ge=0,
        le=1,
        description="correlation of two models' errors at one cell, beyond those of their poses",
    )
    max_std_cells: float | None = Field(
        None, gt=0, description="largest standard deviation of a cell against those around [cells]; not set: no limit"
    )
    max_footprint: float | None = Field(
        None, gt=0, description="largest ground [m] that a pixel may cover along the range; not set: no limit"
    )
    max_hole: int = Field(0, ge=0, le=64, description="width of the widest hole [cells] that is closed and flagged")

    @property
    def hole_window(self) -> int:
        """Side of the window, cells, odd, that a hole's surroundings are judged by: a hole's width to either side."""
        return 2 * self.max_hole + 3

    @property
    def margin(self) -> int:
        """Cells around a tile that its closed holes depend on."""
        return self.hole_window // 2 + self.max_hole + 1 if self.max_hole else 0


@dataclass(frozen=True)
class Placed:
    """Error of a model's pose: ``centre`` (2,) x and y of its camera, m; ``covariance`` (3, 3) of the height of the
    camera, m, and of its rotations about x and y, rad, in the world frame.
    """

    centre: Floats
    covariance: Floats

    @staticmethod
    def of(meta: Mapping[str, Any]) -> Placed:
        """Read the covariance from the facts of a model; without one the pose counts as exact."""
        if meta.get("pose_covariance") is None:
            return EXACT
        full = np.array(meta["pose_covariance"], dtype=np.float64).reshape(6, 6)
        at = RigidTransform.from_matrix(meta["T_frame_left"]).translation
        return Placed(at[:2], full[2:5, 2:5])


EXACT = Placed(np.zeros(2), np.zeros((3, 3)))


def footprint(elevation: Floats32, x: Floats, y: Floats, centre: Floats, angle: float) -> Floats:
    """Ground (row, col) that a pixel covers along the range, m; infinite above the camera, NaN where nothing is known.

    A pixel of ``angle`` (rad) at distance r covers ``r angle`` across the ray, and by r / h more on level ground that
    lies h below the camera.

    Parameters
    ----------
    elevation : (row, col) m, at ``x`` (col,), ``y`` (row,) m.
    centre : (3,) m, of the camera.
    """
    below = centre[2] - elevation.astype(np.float64)
    square = (x[None] - centre[0]) ** 2 + (y[:, None] - centre[1]) ** 2 + below**2
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(below <= 0, np.inf, angle * square / below))


@dataclass(frozen=True)
class ModelLayer:
    """One pair's model on ``lattice``, whose arrays (rows, cols) are read part by part: ``part(name, window)``.

    The arrays are those of :class:`rille.stages.terrain.locus.solve.Dem`, NaN undefined. ``gain``: factor of its grey
    values that levels its exposure with that of its neighbours; ``pose``: how exactly it is placed.
    """

    pair: int
    lattice: Lattice
    part: Callable[[str, Window], Any]
    gain: float = 1.0
    pose: Placed = EXACT


@dataclass(frozen=True)
class Merged:
    """Result (rows, cols) on the tile.

    ``elevation``, ``elevation_std`` and ``relief_std`` (of the weighted mean, see the module), ``spread`` (standard
    deviation of the models about it; 0 for one model) in metres, NaN undefined; ``count`` of models; ``source`` pair
    of the greatest weight, -1 none; ``ortho`` grey value; ``filled`` 1 where a small hole was closed (count 0, source
    -1).
    """

    elevation: Floats32
    elevation_std: Floats32
    spread: Floats32
    count: NDArray[np.uint16]
    source: NDArray[np.int32]
    ortho: Floats32
    filled: Bytes
    relief_std: Floats32


def merge(layers: Sequence[ModelLayer], tile: Lattice, params: MergeParams) -> Merged:
    """Merge elevation models on a tile of their common lattice.

    The result does not depend, in any bit, on the order of the layers, nor on where tiles begin.

    Raises
    ------
    InputError
        Two layers are of the same pair, or a layer's cell differs from the tile's.
    """
    ordered = sorted(layers, key=lambda layer: layer.pair)
    pairs = [layer.pair for layer in ordered]
    if len(set(pairs)) != len(pairs):
        raise InputError("RIL-399", f"two elevation models of one pair among {pairs}", remedy="merge each pair once")
    m = params.margin
    grown = Lattice.at(tile.i0 - m, tile.j0 + m, tile.cell, tile.rows + 2 * m, tile.cols + 2 * m) if m else tile
    ordered = [layer for layer in ordered if grown.intersection(layer.lattice) is not None]
    out = _empty(grown)
    # Four maps of four bytes a cell and model.
    lines = max(1, STRIP_BYTES // (16 * max(len(ordered), 1) * grown.cols))
    for start in range(0, grown.rows if ordered else 0, lines):
        rows = slice(start, min(start + lines, grown.rows))
        strip = Lattice.at(grown.i0, grown.j0 - start, grown.cell, rows.stop - start, grown.cols)
        _merge_strip(ordered, strip, params, out, rows)
    if m:
        _close(out, params)
        inside = grown.window(tile)
        # Copies, for views would keep the margins in memory as long as the result.
        out = Merged(**{name: values[inside].copy() for name, values in vars(out).items()})
    return out


def _merge_strip(layers: Sequence[ModelLayer], strip: Lattice, params: MergeParams, out: Merged, rows: slice) -> None:
    """Merge the lines of one strip into ``out``."""
    present = [layer for layer in layers if strip.intersection(layer.lattice) is not None]
    if not present:
        return
    poses = [layer.pose for layer in present]
    stack = Stack(
        _stacked(present, strip, "elevation"),
        _stacked(present, strip, "elevation_std"),
        _stacked(present, strip, "residual"),
        _stacked(present, strip, "ortho"),
        np.array([layer.gain for layer in present]),
        np.array([pose.centre for pose in poses]),
        np.array([pose.covariance for pose in poses]),
    )
    worst = math.inf if params.max_std_cells is None else params.max_std_cells * strip.cell
    best = np.full(strip.shape, -1, dtype=np.int64)
    maps = CellMaps(
        out.elevation[rows],
        out.elevation_std[rows],
        out.spread[rows],
        out.ortho[rows],
        out.relief_std[rows],
        out.count[rows],
        best,
    )
    rule = Rule(RESIDUAL_SCALE_PX, ORTHO_WEIGHT_EXPONENT, params.alike, worst)
    merge_cells(stack, strip.xs(), strip.ys(), rule, maps)
    out.source[rows] = np.array([*(layer.pair for layer in present), -1])[best]


def _stacked(layers: Sequence[ModelLayer], strip: Lattice, name: str) -> Floats32:
    out = np.full((len(layers), *strip.shape), np.nan, dtype=np.float32)
    for target, layer in zip(out, layers, strict=True):
        common = strip.intersection(layer.lattice)
        assert common is not None
        target[strip.window(common)] = layer.part(name, layer.lattice.window(common))
    return out


def _close(merged: Merged, params: MergeParams) -> None:
    """Close the small holes in place; their grey value stays undefined."""
    gap, window = float(params.max_hole), params.hole_window
    stds = merged.elevation_std, merged.relief_std
    closed = [close_holes(merged.elevation, std, gap, window, MIN_KNOWN_SHARE, judged=True) for std in stds]
    for std, (z, sigma, filled) in zip(stds, closed, strict=True):
        merged.elevation[...], std[...], merged.filled[...] = z, sigma, filled


def _empty(tile: Lattice) -> Merged:
    nan = np.full(tile.shape, np.nan, np.float32)
    return Merged(
        elevation=nan,
        elevation_std=nan.copy(),
        spread=nan.copy(),
        count=np.zeros(tile.shape, np.uint16),
        source=np.full(tile.shape, -1, np.int32),
        ortho=nan.copy(),
        filled=np.zeros(tile.shape, np.uint8),
        relief_std=nan.copy(),
    )


def _fine(dem: Bundle, lattice: Lattice, most: float) -> Callable[[str, Window], Any]:
    """Parts of a model without the elevations of cells whose footprint is greater than ``most`` metres."""
    if "pixel_rad" not in dem.meta:  # no image: vouched for
        return dem.part
    centre = RigidTransform.from_matrix(dem.meta["T_frame_left"]).translation
    angle = float(dem.meta["pixel_rad"])

    def part(name: str, window: Window) -> Any:
        values = np.asarray(dem.part(name, window))
        if name != "elevation":
            return values
        covered = footprint(values, lattice.xs()[window[1]], lattice.ys()[window[0]], centre, angle)
        return np.where(covered <= most, values, np.float32(np.nan))

    return part


@stage(
    "merge",
    version=3,
    outputs=[
        raster("elevation", "m", "elevation of the cell centre", "float32", "nan", "world"),
        raster("elevation_std", "m", "standard deviation of the elevation, poses included", "float32", "nan", "world"),
        raster("spread", "m", "standard deviation of the merged models about the elevation", "float32", "nan", "world"),
        raster("count", "1", "number of merged models", "uint16", "0", "world"),
        raster("source", "1", "pair of the greatest weight", "int32", "-1", "world"),
        raster("ortho", "grey", "grey value, 0..255", "float32", "nan", "world"),
        raster("relief_std", "m", "standard deviation of the elevation against that around", "float32", "nan", "world"),
        raster("filled", "1", "1 where a small hole was closed by interpolation", "uint8", "", "world"),
    ],
    memory=Memory(lower=("locus.cell_size",)),
)
def merge_stage(
    params: MergeParams,
    dems: Sequence[Bundle[DemFacts]],
    *,
    lattice: Lattice,
    exposure: Mapping[str, int] | None = None,
) -> Bundle[MergeFacts]:
    """Merged elevation model and ortho image of one tile of the world."""
    steps = exposure or {}
    layers = []
    for dem in dems:
        pair, own = dem.meta["pair"], Lattice.from_dict(dem.meta["lattice"])
        gain = math.exp(LOG_GAIN_STEP * steps.get(str(pair), 0))
        part = dem.part if params.max_footprint is None else _fine(dem, own, params.max_footprint)
        layers.append(ModelLayer(pair, own, part, gain, Placed.of(dem.meta)))
    merged = merge(layers, lattice, params)
    meta: MergeFacts = {
        "lattice": lattice.to_dict(),
        "frame": "world",
        "pairs": sorted(layer.pair for layer in layers),
        "defined": float(np.mean(merged.count > 0)),
        "filled": int(merged.filled.sum()),
    }
    if any("reference" in dem.meta for dem in dems):
        meta["reference"] = REFERENCE_PLANE
    return Bundle(vars(merged), meta)
