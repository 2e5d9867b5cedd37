"""What navigation is held to: limits of time and accuracy, most of them relative to other methods of the same run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

STREET = "kitti06_51"
STREET_STEP = 0.0118
"""Metres: mean error of the motion between two frames on the street."""
DRIFT = 1.0
"""Per cent of the way on the street."""
OPENCV_TIME, COLMAP_TIME = 1.0, 0.1
OPENCV_STEP = 0.95


@dataclass(frozen=True)
class Line:
    """One limit; kept where the figure is at most so much (no figure: not kept)."""

    what: str
    figure: float
    limit: float

    @property
    def kept(self) -> bool:
        """Whether it is."""
        return self.figure <= self.limit


def lines(sequence: str, found: Sequence[Mapping[str, Any]]) -> list[Line]:
    """The limits of each of Rille's methods, by the figures (``judge``, ``times``) of all methods of one run."""
    by_method = {str(f["method"]): f for f in found}
    opencv, colmap = by_method.get("OpenCV odometry"), by_method.get("COLMAP")
    out = []
    for method, f in by_method.items():
        if not method.startswith("Rille "):
            continue
        out.append(Line(f"{method}: frames lost", f["lost"], 0.0))
        if STREET in sequence:
            out.append(Line(f"{method}: error of one frame, mm", 1e3 * f["one_frame"], 1e3 * STREET_STEP))
            out.append(Line(f"{method}: drift, %", f["drift"], DRIFT))
        if opencv is not None:
            step, time = f["one_frame"] / opencv["one_frame"], f["processor"] / opencv["processor"]
            out.append(Line(f"{method}: error of one frame against OpenCV's", step, OPENCV_STEP))
            out.append(Line(f"{method}: processor time against OpenCV's", time, OPENCV_TIME))
        if colmap is not None:
            first, time = f["rmse_first"] / colmap["rmse_first"], f["processor"] / colmap["processor"]
            out.append(Line(f"{method}: RMSE of the first frames against COLMAP's", first, 1.0))
            out.append(Line(f"{method}: processor time against COLMAP's", time, COLMAP_TIME))
    return out
