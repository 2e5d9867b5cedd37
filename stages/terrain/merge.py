"""Merge of the elevation models of several basic pairs in one world frame (paper, section 4.5).

All models lie on one lattice, so a cell of the result has one value a model. A model's weight is 1 / sigma^2, sigma
being the elevation's standard deviation.

Where three or more models meet, one re-weighting about their weighted median takes out the one that contradicts.

The standard deviation of the result has four parts. Each model's own, independent of the others'; what the models have
in common, since they saw the same light and the same shapes (``alike`` is the correlation of two models' errors); that
of the poses; and that of a rig that was repaired. With s_i the shares of the weights, p_i the standard deviation of the
height there by the covariance of model i's pose (dz = dC_z + dtheta_x (y - C_y) - dtheta_y (x - C_x)), r the standard
deviation of the error that all inverse depths share, h_i and d_i the height of camera i above the cell and the cell's
depth,

    sigma^2 = (1 - alike) sum (s_i sigma_i)^2 + alike (sum s_i sigma_i)^2 + (sum s_i p_i)^2 + (sum s_i h_i d_i r)^2

(a point moves along its ray by d r of its distance). Poses of models that overlap have nearly all of their way in
common, so that their errors, as the rig's, neither average out over the models nor over the cells of one.
``relief_std`` is the first part alone (alike = 0): that of a cell against the ground around it, which is what slopes
and steps are judged by.

Sums run over the models in the order of their pairs, in double precision, so equal input gives equal bits wherever a
tile or a strip begins. A tile is merged in strips of lines, and of each model only the strip is read, so that
:data:`STRIP_BYTES` bounds the memory, however many and large the models are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.core.declare import Bundle, Memory, Params, raster, stage
from rille.stages.facts.terrain import DemFacts, MergeFacts
from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.lattice import Lattice, Window
from rille.stages.geometry.pose_arrays import REFERENCE_PLANE
from rille.stages.numeric.robust import MAD_TO_SIGMA, TUKEY_BISQUARE, bisquare
from rille.stages.terrain.radiometry import LOG_GAIN_STEP


class Merged(NamedTuple):
    """Maps (rows, cols) of merged cells.

    ``elevation``, ``elevation_std`` and ``relief_std`` (of the weighted mean, see
    :mod:`rille.stages.terrain.merge`), ``spread`` (standard deviation of the models about it; 0 for one model) in
    metres, NaN undefined; ``count`` of models; ``source`` pair of the greatest weight, -1 none; ``ortho`` grey value.
    """

    elevation: Floats32
    elevation_std: Floats32
    spread: Floats32
    count: NDArray[np.uint16]  # type: ignore[assignment]  # in place of a tuple's own count
    source: NDArray[np.int32]
    ortho: Floats32
    relief_std: Floats32


NOTHING: Mapping[str, Any] = dict.fromkeys(Merged._fields, np.float32(np.nan)) | {
    "count": np.uint16(0),
    "source": np.int32(-1),
}
"""Values of a cell that no model gives."""


def merge_cells(
    maps: Floats32, layers: Sequence[ModelLayer], strip: Lattice, errors: SharedErrors, worst: float
) -> dict[str, Any]:
    """Maps (rows, cols) of :class:`Merged` by name; weights and equations are those of the module.

    Parameters
    ----------
    maps : (3, n, rows, cols) elevations, their standard deviations and grey values of n models, NaN undefined, on the
        cells of ``strip``.
    layers : (n,) those models.
    errors : that the models share.
    worst : greatest standard deviation without the poses' part, m.
    """
    z, sigma, ortho = maps.astype(np.float64)
    with np.errstate(divide="ignore", over="ignore"):
        weight = 1.0 / (sigma * sigma)
    known = np.isfinite(z) & (sigma > 0.0) & (weight > 0.0) & np.isfinite(weight)
    z, sigma, weight = (np.where(known, a, 0.0) for a in (z, sigma, weight))
    # Of two models that contradict each other none is the outlier.
    several = np.count_nonzero(known, axis=0) >= 3
    if several.any():
        centre = _median(z, weight)
        typical = MAD_TO_SIGMA * _median(np.abs(z - centre), known.astype(np.float64))
        # At least its own standard deviation: models that agree by chance must not shut out a third.
        bound = TUKEY_BISQUARE * np.where(known, np.maximum(typical, sigma), 1.0)
        weight = np.where(several, weight * bisquare((z - centre) / bound), weight)
    top = weight.max(axis=0)
    share = weight / np.where(top > 0.0, _total(weight), 1.0)
    mean, together = _total(share * z), _total(share * sigma)
    apart = _total((share * sigma) ** 2)
    # Unrelated errors (alike = 0) average out; errors of one cause (alike = 1) add up as if there were one model.
    variance = apart + errors.alike * (together * together - apart)
    # Poses drift together, so that their errors do not average out; nor do those of one rig.
    swing, stretch = _by_pose_and_rig(layers, strip, z)
    placed, ranged = _total(share * swing), _total(share * stretch) * errors.inverse_depth_std
    grey = np.minimum(np.array([layer.gain for layer in layers])[:, None, None] * ortho, 255.0)
    # The eighth power: the best image, but without a visible seam.
    sharp = np.where(np.isfinite(grey), (weight / np.where(top > 0.0, top, 1.0)) ** 8, 0.0)
    greys = _total(sharp)
    merged = {
        "elevation": mean,
        "elevation_std": np.sqrt(variance + placed * placed + ranged * ranged),
        "spread": np.sqrt(_total(share * (z - mean) ** 2)),
        "count": np.count_nonzero(weight, axis=0),
        "source": np.array([layer.pair for layer in layers])[weight.argmax(axis=0)],
        "ortho": np.divide(_total(sharp * np.nan_to_num(grey)), greys, out=np.full(top.shape, np.nan), where=greys > 0),
        "relief_std": np.sqrt(apart),
    }
    # The limit is on the models' own errors, without the poses' and the rig's part.
    good = (top > 0.0) & (np.sqrt(variance) <= worst)
    return {name: np.where(good, a.astype(NOTHING[name].dtype), NOTHING[name]) for name, a in merged.items()}


def _total(values: Floats) -> Floats:
    """Sum over the models, one after the other: NumPy's own order depends on the shape of a strip."""
    return np.asarray(reduce(np.add, values))


def _by_pose_and_rig(layers: Sequence[ModelLayer], strip: Lattice, z: Floats) -> tuple[Floats, Floats]:
    """Of the elevations z (n, rows, cols), m: standard deviations by the covariances of (height, rotation about x, y),
    m; and changes, m^2, by one error, 1/m, of all inverse depths."""
    centre, forward = (np.array([getattr(layer.pose, name) for layer in layers]) for name in ("centre", "forward"))
    dx, dy = (strip.xs() - centre[:, :1])[:, None, :], (strip.ys() - centre[:, 1:2])[:, :, None]
    covariance, dz = (a[..., None, None] for a in (np.array([layer.pose.covariance for layer in layers]), centre[:, 2]))
    tilt = dy * dy * covariance[:, 1, 1] + dx * dx * covariance[:, 2, 2] - 2.0 * dx * dy * covariance[:, 1, 2]
    both = covariance[:, 0, 0] + tilt + 2.0 * (dy * covariance[:, 0, 1] - dx * covariance[:, 0, 2])
    ax, ay, az = forward.T[..., None, None]
    above = z - dz
    return np.sqrt(np.maximum(0.0, both)), -above * (ax * dx + ay * dy + az * above)


def _median(values: Floats, weight: Floats) -> Floats:
    """Lower weighted medians over the first axis: the least value that half of the weight does not exceed."""
    order = np.argsort(values, axis=0, kind="stable")
    running = np.cumsum(np.take_along_axis(weight, order, axis=0), axis=0)
    middle = np.argmax(running >= 0.5 * running[-1], axis=0)
    return np.asarray(np.take_along_axis(values, np.take_along_axis(order, middle[None], axis=0), axis=0)[0])


STRIP_BYTES = 1 << 26
"""Bytes of the models that are in memory at once: 64 MiB are all of a usual tile, and a part where dozens meet."""


class MergeParams(Params):
    """Parameters of the stage ``merge``.

    Attributes
    ----------
    alike : correlation of two models' errors at one cell, beyond those of their poses.
    max_std_cells : largest standard deviation of a cell against those around [cells]; not set: no limit.
    max_footprint : largest ground [m] that a pixel may cover along the range; not set: no limit.
    """

    # Chosen with the simulator's models at their true poses on 21 November 2026: with it 70 % of the merged errors are
    # below one standard deviation.
    alike: float = Field(0.8, ge=0, le=1)
    max_std_cells: float | None = Field(None, gt=0)
    max_footprint: float | None = Field(None, gt=0)


@dataclass(frozen=True)
class Placed:
    """Camera of a model in the world frame: ``centre`` (3,), m; ``covariance`` (3, 3) of its height, m, and of its
    rotations about x and y, rad; ``forward`` (3,), its optical axis, without which its depths count as exact.
    """

    centre: Floats
    covariance: Floats
    forward: Floats = field(default_factory=lambda: np.zeros(3))

    @staticmethod
    def of(meta: Mapping[str, Any]) -> Placed:
        """Read the pose from the facts of a model; without a covariance it counts as exact."""
        if "T_frame_left" not in meta:
            return EXACT
        T = RigidTransform.from_matrix(meta["T_frame_left"])
        full = np.array(meta.get("pose_covariance", np.zeros(36)), dtype=np.float64).reshape(6, 6)
        return Placed(T.translation, full[2:5, 2:5], T.rotation[:, 2])


EXACT = Placed(np.zeros(3), np.zeros((3, 3)))


class SharedErrors(NamedTuple):
    """Errors that models share: ``alike``, correlation of two at one cell; ``inverse_depth_std``, 1/m, of a rig."""

    alike: float
    inverse_depth_std: float = 0.0


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


def merge(layers: Sequence[ModelLayer], tile: Lattice, params: MergeParams, inverse_depth_std: float = 0.0) -> Merged:
    """Merge elevation models, each of another pair, on a tile of their common lattice.

    The result does not depend, in any bit, on the order of the layers, nor on where tiles begin.

    Parameters
    ----------
    inverse_depth_std : of the error that all inverse depths share, 1/m.

    Raises
    ------
    InputError
        A layer's cell differs from the tile's.
    """
    ordered = sorted(layers, key=lambda layer: layer.pair)
    assert len({layer.pair for layer in ordered}) == len(ordered)
    ordered = [layer for layer in ordered if tile.intersection(layer.lattice) is not None]
    errors = SharedErrors(params.alike, inverse_depth_std)
    out = {name: np.full(tile.shape, none) for name, none in NOTHING.items()}
    worst = math.inf if params.max_std_cells is None else params.max_std_cells * tile.cell
    # Some sixteen numbers of eight bytes a cell and model.
    lines = max(1, STRIP_BYTES // (128 * max(len(ordered), 1) * tile.cols))
    for start in range(0, tile.rows, lines):
        strip = Lattice.at(tile.i0, tile.j0 - start, tile.cell, min(lines, tile.rows - start), tile.cols)
        present = [layer for layer in ordered if strip.intersection(layer.lattice) is not None]
        if present:
            part = merge_cells(_read(present, strip), present, strip, errors, worst)
            for name, values in part.items():
                out[name][start : start + strip.rows] = values
    return Merged(**out)


def _read(layers: Sequence[ModelLayer], strip: Lattice) -> Floats32:
    """Read a strip of the models: arrays (3, n, rows, cols), see :func:`merge_cells`."""
    maps = np.full((3, len(layers), *strip.shape), np.nan, dtype=np.float32)
    for k, layer in enumerate(layers):
        common = strip.intersection(layer.lattice)
        assert common is not None
        here, there = strip.window(common), layer.lattice.window(common)
        for target, name in zip(maps, ("elevation", "elevation_std", "ortho"), strict=True):
            target[k][here] = layer.part(name, there)
    return maps


def seen_finely(elevation: Floats32, x: Floats, y: Floats, facts: Mapping[str, Any], most: float | None) -> Floats32:
    """Elevations (row, col), m, but NaN where a pixel covers more than ``most`` metres, see :func:`footprint`.

    ``facts`` are those of the model; one without ``pixel_rad``, which is no image's, is kept whole.
    """
    if most is None or "pixel_rad" not in facts:
        return elevation
    centre = RigidTransform.from_matrix(facts["T_frame_left"]).translation
    covered = footprint(elevation, x, y, centre, facts["pixel_rad"])
    return np.where(covered <= most, elevation, np.float32(np.nan))


def _fine(dem: Bundle, lattice: Lattice, most: float | None) -> Callable[[str, Window], Any]:
    """Parts of a model, elevations by :func:`seen_finely`."""

    def part(name: str, window: Window) -> Any:
        values = np.asarray(dem.raster(name)[window])
        if name != "elevation":
            return values
        return seen_finely(values, lattice.xs()[window[1]], lattice.ys()[window[0]], dem.meta, most)

    return part


@stage(
    "merge",
    outputs=[
        raster("elevation", "m", "elevation of the cell centre", "float32", "nan", "world"),
        raster("elevation_std", "m", "standard deviation, its frame being right", "float32", "nan", "world"),
        raster("spread", "m", "standard deviation of the merged models about the elevation", "float32", "nan", "world"),
        raster("count", "1", "number of merged models", "uint16", "0", "world"),
        raster("source", "1", "pair of the greatest weight", "int32", "-1", "world"),
        raster("ortho", "grey", "grey value, 0..255", "float32", "nan", "world"),
        raster("relief_std", "m", "standard deviation of the elevation against that around", "float32", "nan", "world"),
    ],
    memory=Memory(lower=("locus.cell_size",)),
)
def merge_stage(
    params: MergeParams,
    dems: Sequence[Bundle[DemFacts]],
    *,
    lattice: Lattice,
    exposure: Mapping[str, int] | None = None,
    inverse_depth_std: float = 0.0,
) -> Bundle[MergeFacts]:
    """Merged elevation model and ortho image of one tile of the world."""
    steps = exposure or {}
    layers = []
    for dem in dems:
        pair, own = dem.meta["pair"], Lattice.from_dict(dem.meta["lattice"])
        gain = math.exp(LOG_GAIN_STEP * steps.get(str(pair), 0))
        layers.append(ModelLayer(pair, own, _fine(dem, own, params.max_footprint), gain, Placed.of(dem.meta)))
    merged = merge(layers, lattice, params, inverse_depth_std)
    meta: MergeFacts = {
        "lattice": lattice.to_dict(),
        "frame": "world",
        "pairs": sorted(layer.pair for layer in layers),
        "defined": float(np.mean(merged.count > 0)),
    }
    if any("reference" in dem.meta for dem in dems):
        meta["reference"] = REFERENCE_PLANE
    return Bundle(merged._asdict(), meta)
