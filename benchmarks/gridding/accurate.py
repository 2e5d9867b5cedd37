"""Matching and Locus of a scene as ``terrain.preset=accurate`` does them: both directions, to be timed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rille.pipeline.flow import config
from rille.stages.core.validity import matched_back
from rille.stages.hfvm.stage import match
from rille.stages.terrain.locus.stage import MatchedPair, reconstruct
from rille.stages.terrain.matches import Matches

from .scenes import Scene

MATCHING, LOCUS = "matching, accurate", "Locus, accurate"


def jobs(scene: Scene) -> dict[str, Callable[[], Any]]:
    """Both steps by name, the matching first; Locus takes what the matching gave last."""
    chosen: Any = config.build({"terrain": {"preset": "accurate"}, "locus": {"max_sigma": scene.max_sigma}})
    sides = ((scene.left, scene.valid[0]), (scene.right, scene.valid[1]))
    found: list[Matches] = []

    def matching() -> None:
        found.clear()
        for (image, valid), (other, also) in (sides, sides[::-1]):
            d = match(image, other, chosen.hfvm, valid=(valid, also))
            good = matched_back(d.validity, d.backmatch_error)
            found.append(Matches(d.column_disparity, d.row_disparity, good, d.disparity_std))

    def locus() -> Any:
        forth, back = found
        pair = MatchedPair(np.asarray(scene.left, np.float32), forth, scene.right, back)
        return reconstruct(pair, scene.rig, scene.T_local_left, scene.lattice, scene.z_range, chosen.locus)

    return {MATCHING: matching, LOCUS: locus}
