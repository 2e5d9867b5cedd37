"""Merge of the elevation models of several basic pairs in one world frame (paper, section 4.5).

All models lie on one lattice, so a cell of the result has one value a model. With sigma the elevation's standard
deviation and r its residual, a model's weight is

    w = 1 / (sigma^2 (1 + (r / r0)^2))        (sigma^-2 is (ds/dZ)^2 but for the disparity's error, equal for all)

Where three or more models meet, one re-weighting about their weighted median takes out the one that contradicts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from stages.declare import Array, Bundle, Inputs, Memory, Params, Stage
from stages.errors import InputError
from stages.lattice import Lattice

Floats = NDArray[np.float64]
Float32 = NDArray[np.float32]

BICUBIC = 4.685  # Tukey's constant: 95 % efficiency where the errors are normal
SHARPNESS = 8  # exponent of the ortho image's weights: the best image, but without a visible seam


class MergeParams(Params):
    """Parameters of the stage ``merge``."""

    residual_scale: float = Field(
        0.1, gt=0, description="pixels; residual that halves a model's weight: the disparity's error when it is good"
    )


@dataclass(frozen=True)
class Layer:
    """One pair's elevation model: arrays (rows, cols) on ``lattice``, NaN undefined, see :class:`stages.locus.Dem`."""

    pair: int
    lattice: Lattice
    elevation: Float32
    elevation_std: Float32
    residual: Float32
    ortho: Float32


@dataclass(frozen=True)
class Merged:
    """Result (rows, cols) on the tile.

    ``elevation``, ``elevation_std`` (of the weighted mean, as the models say), ``spread`` (standard deviation of the
    models about it; 0 for one model) in metres, NaN undefined; ``count`` of models; ``source`` pair of the greatest
    weight, -1 none; ``ortho`` grey value.
    """

    elevation: Float32
    elevation_std: Float32
    spread: Float32
    count: NDArray[np.uint16]
    source: NDArray[np.int16]
    ortho: Float32


def merge(layers: Sequence[Layer], tile: Lattice, params: MergeParams) -> Merged:
    """Merge elevation models on a tile of their common lattice.

    The result does not depend, in any bit, on the order of the layers.

    Raises
    ------
    InputError
        Two layers are of the same pair, or a layer's cell differs from the tile's.
    """
    ordered = sorted(layers, key=lambda layer: layer.pair)
    pairs = [layer.pair for layer in ordered]
    if len(set(pairs)) != len(pairs):
        raise InputError(f"two elevation models of one pair among {pairs}", remedy="merge each pair once")
    ordered = [layer for layer in ordered if tile.intersection(layer.lattice) is not None]
    if not ordered:
        return _empty(tile)
    stack = [_stacked(ordered, tile, name) for name in ("elevation", "elevation_std", "residual", "ortho")]
    z, sigma, residual, ortho = stack
    weight = 1.0 / (sigma**2 * (1.0 + (residual / params.residual_scale) ** 2))
    weight[~(np.isfinite(z) & np.isfinite(weight))] = 0.0
    weight *= _agreement(z, sigma, weight)
    total = weight.sum(axis=0)
    seen = total > 0
    share = weight / np.where(seen, total, 1.0)
    mean = _mean(share, z)
    variance = _mean(share**2, sigma**2)
    spread = np.sqrt(_mean(share, (z - mean) ** 2))
    sharp = share / np.where(seen, share.max(axis=0), 1.0)
    sharp **= SHARPNESS
    grey = _mean(sharp / np.where(seen, sharp.sum(axis=0), 1.0), ortho)
    best = np.array([layer.pair for layer in ordered])[np.argmax(weight, axis=0)]
    return Merged(
        elevation=_where(seen, mean),
        elevation_std=_where(seen, np.sqrt(variance)),
        spread=_where(seen, spread),
        count=(weight > 0).sum(axis=0).astype(np.uint16),
        source=np.where(seen, best, -1).astype(np.int16),
        ortho=_where(seen, grey),
    )


def _where(seen: NDArray[np.bool_], values: Floats) -> Float32:
    return np.where(seen, values, np.nan).astype(np.float32)


def _stacked(layers: Sequence[Layer], tile: Lattice, name: str) -> Floats:
    out = np.full((len(layers), *tile.shape), np.nan)
    for target, layer in zip(out, layers, strict=True):
        common = tile.intersection(layer.lattice)
        if common is not None:
            target[tile.window(common)] = getattr(layer, name)[layer.lattice.window(common)]
    return out


def _mean(share: Floats, values: Floats) -> Floats:
    """Sum of share * value over the models, those without a share left out (their values may be NaN)."""
    return np.asarray((share * np.where(share > 0, values, 0.0)).sum(axis=0), dtype=np.float64)


def _agreement(z: Floats, sigma: Floats, weight: Floats) -> Floats:
    """Tukey's biweight about the weighted median (n, rows, cols); 1 where fewer than three models meet.

    The scale is the greater of a model's own sigma and the models' median deviation: errors of pose are not in sigma.
    """
    centre = _weighted_median(z, weight)
    deviation = np.where(weight > 0, np.abs(z - centre), np.nan)
    scale = np.fmax(1.4826 * _weighted_median(deviation, (weight > 0).astype(np.float64)), sigma)
    factor = np.maximum(0.0, 1.0 - (np.nan_to_num(deviation) / (BICUBIC * np.where(weight > 0, scale, 1.0))) ** 2) ** 2
    return np.where((weight > 0).sum(axis=0) >= 3, factor, 1.0)


def _weighted_median(values: Floats, weight: Floats) -> Floats:
    """Lower weighted median over the first axis: the least value that half of the weight does not exceed."""
    order = np.argsort(np.where(weight > 0, values, np.inf), axis=0, kind="stable")
    running = np.cumsum(np.take_along_axis(weight, order, axis=0), axis=0)
    middle = np.argmax(running >= 0.5 * running[-1], axis=0)
    picked = np.take_along_axis(order, middle[None], axis=0)
    return np.asarray(np.take_along_axis(values, picked, axis=0)[0], dtype=np.float64)


def _empty(tile: Lattice) -> Merged:
    nan = np.full(tile.shape, np.nan, np.float32)
    return Merged(
        elevation=nan,
        elevation_std=nan.copy(),
        spread=nan.copy(),
        count=np.zeros(tile.shape, np.uint16),
        source=np.full(tile.shape, -1, np.int16),
        ortho=nan.copy(),
    )


def _run(params: MergeParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    tile = Lattice.from_dict(args["lattice"])
    layers = []
    for dem in inputs["dems"]:
        lattice = Lattice.from_dict(dem.meta["lattice"])
        common = tile.intersection(lattice)
        if common is None:
            continue
        window = lattice.window(common)
        parts = (np.asarray(dem[name][window]) for name in ("elevation", "elevation_std", "residual", "ortho"))
        layers.append(Layer(int(dem.meta["pair"]), common, *parts))
    merged = merge(layers, tile, params)
    meta = {
        "lattice": tile.to_dict(),
        "frame": "world",
        "pairs": sorted(layer.pair for layer in layers),
        "defined": float(np.mean(merged.count > 0)),
    }
    return Bundle(vars(merged), meta)


def _array(name: str, dtype: str, unit: str, long_name: str, nodata: str) -> Array:
    return Array(name, ("row", "col"), dtype, unit, long_name, nodata, "world")


STAGE = Stage(
    name="merge",
    version=1,
    summary="merged elevation model and ortho image of one tile of the world",
    params=MergeParams,
    inputs=("dems*",),
    outputs=(
        _array("elevation", "float32", "m", "elevation of the cell centre", "nan"),
        _array("elevation_std", "float32", "m", "standard deviation of the elevation, from the models' own", "nan"),
        _array("spread", "float32", "m", "standard deviation of the merged models about the elevation", "nan"),
        _array("count", "uint16", "1", "number of merged models", "0"),
        _array("source", "int16", "1", "pair of the greatest weight", "-1"),
        _array("ortho", "float32", "grey", "grey value, 0..255", "nan"),
    ),
    requires=("numpy",),
    run=_run,
    memory=Memory(lower=("locus.cell_size",)),
)
