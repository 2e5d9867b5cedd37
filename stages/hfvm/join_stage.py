"""The disparities of a large pair, put together from those of its tiles: the same artifact as that of stage ``hfvm``.

One array at a time is put together, when it is asked for.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rille.stages.core.declare import AnyArray, Bundle, Inputs, Stage
from rille.stages.hfvm import tiled
from rille.stages.hfvm.images.params import HfvmParams
from rille.stages.hfvm.images.window import Mosaic, Shape, cut, strips, tiles, whole
from rille.stages.hfvm.stage import OUTPUTS, facts
from rille.stages.hfvm.tile_stage import mosaic, views


@dataclass(frozen=True)
class Joined(Mapping[str, AnyArray]):
    """Arrays by name, each put together whenever it is asked for."""

    parts: Sequence[Bundle]
    shape: Shape
    coarse: Shape
    side: int

    def __getitem__(self, name: str) -> AnyArray:
        if name not in set(self):
            raise KeyError(name)
        window = whole(self.shape)
        if self.coarse == self.shape:
            return cut(mosaic(self.parts, name, self.shape, self.side), window)
        windows = [w.child(self.shape) for w in tiles(self.coarse, self.side)]
        return cut(Mosaic(self.shape, windows, [part.raster(name) for part in self.parts]), window)

    def __iter__(self) -> Iterator[str]:
        return iter(array.name for array in OUTPUTS)

    def __len__(self) -> int:
        return len(OUTPUTS)


def _run(params: HfvmParams, args: Mapping[str, Any], inputs: Inputs) -> Bundle:
    left, _, half = views(inputs, params)
    mask = inputs["left"].raster("valid_0")
    shape, coarse = tuple(mask.shape), tuple(left.shapes[0])
    arrays = Joined(inputs["tiles"], shape, coarse if half else shape, args["side"])
    usable = sum(int(np.count_nonzero(cut(mask, w))) for w in strips(mask))
    given = tiled.halved_params(params) if half else params
    return Bundle(arrays, facts(arrays, given, inputs["coarse"].meta["aligned"], usable))


STAGE = Stage(
    name="hfvm_join",
    version=1,
    summary="dense disparities of a large stereo pair, put together from its tiles",
    params=HfvmParams,
    inputs=("left", "right", "coarse", "tiles*"),
    outputs=OUTPUTS,
    run=_run,
)
