"""Nav2's map_server as its documentation states it (nav2_map_server, map_io): from image and YAML to occupancies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray


@dataclass(frozen=True)
class OccupancyGrid:
    """``data`` (row, col): -1 unknown, 0..100, the least y first; ``origin``: x, y of the lower left corner, m."""

    data: NDArray[np.int64]
    resolution: float
    origin: tuple[float, float]

    def at(self, x: float, y: float) -> int:
        """Occupancy at a place, m."""
        col, row = (int((v - o) / self.resolution) for v, o in zip((x, y), self.origin, strict=True))
        return int(self.data[row, col])


def load(path: Path) -> OccupancyGrid:
    """Read a map by its YAML file."""
    about = yaml.safe_load(path.read_text(encoding="utf-8"))
    image = cv2.imread(str(path.parent / about["image"]), cv2.IMREAD_UNCHANGED)
    assert (about["mode"], about["negate"]) == ("raw", 0)
    data = np.where(image <= 100, image.astype(np.int64), -1)
    x, y, turn = about["origin"]
    assert turn == 0.0
    return OccupancyGrid(data[::-1], about["resolution"], (x, y))
