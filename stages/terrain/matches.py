"""Disparities of one image and which of them may be used, as the terrain is computed from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rille.stages.core.arrays import Bools
from rille.stages.core.declare import Bundle
from rille.stages.core.validity import matched_back


@dataclass(frozen=True)
class Matches:
    """Disparity vectors (rows, cols) of one image, the other one minus it, pixels; which of them may be used.

    ``std``: standard deviation of the usable ones, pixels; None: not known.
    """

    column: ArrayLike
    row: ArrayLike
    usable: Bools
    std: ArrayLike | None = None

    @staticmethod
    def of(disparity: Bundle) -> Matches:
        """Disparities of a pair; those that are matched back may be used."""
        good = matched_back(np.asarray(disparity["validity"]), np.asarray(disparity["backmatch_error"]))
        maps = np.asarray(disparity["column_disparity"]), np.asarray(disparity["row_disparity"])
        return Matches(*maps, good, disparity.arrays.get("disparity_std"))
