"""Figures that several threads of a worker draw at a time are those that each draws alone."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import numpy as np

from rille.pipeline.report import figures, gallery
from rille.pipeline.report.canvas import Block, Figure


def draw(seed: int) -> Figure:
    elevation = np.random.default_rng(seed).normal(size=(40, 40)).cumsum(axis=0)

    def maker(_: Any) -> Block:
        return Block((figures.raster(elevation, "elevation, m", "", extent=(0.0, 1.0, 0.0, 1.0)),))

    return gallery.draw("Elevation", maker, SimpleNamespace())


def test_threads_share_no_sheet_at_a_time() -> None:
    alone = [draw(seed) for seed in range(8)]
    assert not [figure.why for figure in alone if figure.why]
    with ThreadPoolExecutor(8) as threads:
        assert list(threads.map(draw, range(8))) == alone
