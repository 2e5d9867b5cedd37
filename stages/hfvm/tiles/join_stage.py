"""The disparities of a large pair, put together from those of its tiles: the same artifact as that of stage ``hfvm``.

One array at a time is put together, when it is asked for.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rille.stages.core.declare import AnyArray, Bundle, stage
from rille.stages.facts.matching import DisparityFacts, TileFacts
from rille.stages.hfvm.coarse import ImageDifference
from rille.stages.hfvm.image import Window, whole
from rille.stages.hfvm.params import HfvmParams
from rille.stages.hfvm.stage import OUTPUTS, facts
from rille.stages.hfvm.tiles.tile_stage import Task, TileInputs, mosaic


@dataclass(frozen=True)
class Joined(Mapping[str, AnyArray]):
    """Arrays by name, each put together whenever it is asked for; ``windows``: of the tiles, at full resolution."""

    parts: Sequence[Bundle]
    windows: Sequence[Window]
    shape: tuple[int, ...]

    def __getitem__(self, name: str) -> AnyArray:
        if name not in set(self):
            raise KeyError(name)
        return mosaic(self.parts, name, self.windows, whole(self.shape))

    def __iter__(self) -> Iterator[str]:
        return iter(array.name for array in OUTPUTS)

    def __len__(self) -> int:
        return len(OUTPUTS)


@stage("hfvm_join", outputs=OUTPUTS)
def hfvm_join_stage(
    params: HfvmParams, left: Bundle, right: Bundle, coarse: Bundle[TileFacts], tiles: Sequence[Bundle], *, side: int
) -> Bundle[DisparityFacts]:
    """Dense disparities of a large stereo pair, put together from its tiles."""
    task, mask = Task(params, TileInputs(left, right, coarse), side), left.raster("valid_0")
    shape = tuple(mask.shape)
    windows = [w.child(shape) for w in task.windows] if task.half else task.windows
    arrays = Joined(tiles, windows, shape)
    usable = int(np.count_nonzero(mask[whole(shape).slices]))
    unlike = ImageDifference(*coarse.meta["unlike"])
    return Bundle(arrays, facts(arrays, params, unlike.doubled() if task.half else unlike, usable))
