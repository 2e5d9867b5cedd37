"""Real optics: a camera with lens distortion, as calibration programs describe it.

Models and the order of their coefficients are OpenCV's:

* ``none``: no coefficients;
* ``radtan`` (Brown 1966, Conrady 1919): k1 k2 p1 p2 [k3];
* ``rational``: k1 k2 p1 p2 k3 k4 k5 k6 [s1 s2 s3 s4 [tx ty]] (s: thin prism, t: tilt of the sensor);
* ``fisheye`` (Kannala, Brandt 2006, doi:10.1109/TPAMI.2006.153): k1 k2 k3 k4; Kalibr calls it equidistant.

One more model is that of NASA's rovers, see :mod:`rille.stages.geometry.cahvore`:

* ``cahvore``: skew (pixels of row by a unit of x), optical axis O (3), R (3), linearity; for far points, so without E.

Raw pixels are those of the image as it was taken, ideal pixels those of a pinhole camera at the same place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike

from rille.stages.core.arrays import Floats, Floats32
from rille.stages.core.errors import InputError
from rille.stages.geometry.cahvore import Bending
from rille.stages.geometry.geometry import Camera

COUNTS: Mapping[str, tuple[int, ...]] = {
    "none": (0,),
    "radtan": (4, 5),
    "rational": (8, 12, 14),
    "fisheye": (4,),
    "cahvore": (8,),
}
"""Numbers of coefficients that each model may have."""

COEFFICIENTS: Mapping[str, tuple[str, ...]] = {
    "none": (),
    "radtan": ("k1", "k2", "p1", "p2", "k3"),
    "rational": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
"""Usual names of the coefficients of a model, in its order."""

CHUNK_POINTS = 65536
"""Points at a time: OpenCV's projection also writes its Jacobian, 30 numbers a point."""


@dataclass(frozen=True)
class Lens:
    """A camera with distortion: ``camera`` is its pinhole part (pixels of the raw image)."""

    camera: Camera
    model: str = "none"
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.model not in COUNTS:
            raise InputError(
                "RIL-369", f"distortion model {self.model!r} is unknown", remedy=f"one of {', '.join(COUNTS)}"
            )
        wanted = COUNTS[self.model]
        if len(self.coefficients) not in wanted:
            counts = " or ".join(str(n) for n in wanted)
            raise InputError(
                "RIL-370",
                f"distortion {self.model} has {len(self.coefficients)} coefficients, it takes {counts}",
                remedy="check the model's name, or the list of its coefficients",
            )
        if not all(math.isfinite(v) for v in self.coefficients):
            raise InputError("RIL-371", "a distortion coefficient is not finite", remedy="correct the calibration")

    @property
    def ideal(self) -> bool:
        """Whether the lens is free of distortion."""
        return not any(self.coefficients) if self.model != "fisheye" else False

    def ideal_camera(self) -> Camera:
        """The pinhole camera of the undistorted image: same size and principal point as the raw one.

        It has the raw focal length, so that the centre keeps its resolution, except for a fisheye: there the edges of
        that image would lie far inside the raw one, and the focal length is reduced until the middle of each raw edge
        is seen, at most to .7, which keeps half of the pixels at the centre. The rest (more than 60 degrees off the
        axis) is lost.
        """
        c = self.camera
        if self.model != "fisheye" and not (self.model == "cahvore" and self._bending.linearity < 1):
            return c
        w, h = c.width - 1.0, c.height - 1.0
        edges = np.array([[0.0, c.cy], [w, c.cy], [c.cx, 0.0], [c.cx, h]])
        far = np.hypot(*((self.undistort(edges, c) - [c.cx, c.cy]).T))
        room = np.array([c.cx, w - c.cx, c.cy, h - c.cy])
        # An edge without ideal position is 90 degrees off the axis or more.
        ratio = np.where(np.isfinite(far), room / np.maximum(far, 1e-9), 0.0)
        factor = float(np.clip(ratio.min(), 0.7, 1.0))
        return replace(c, fx=factor * c.fx, fy=factor * c.fy)

    @cached_property
    def reach(self) -> float:
        """Tangent of the angle off the axis up to which the radial model is monotonic; beyond, it folds back."""
        k = self.coefficients
        if self.model in ("none", "cahvore"):  # cahvore has its own limit
            return math.inf
        if self.model == "fisheye":
            angle = _first_root(Polynomial([1.0, *((2 * n + 3) * v for n, v in enumerate(k))]))
            return math.tan(angle) if angle < math.pi / 2 else math.inf
        above = Polynomial([1.0, k[0], k[1], k[4] if len(k) > 4 else 0.0])
        below = Polynomial([1.0, *k[5:8]])
        s = Polynomial([0.0, 1.0])
        growth = (above + 2 * s * above.deriv()) * below - 2 * s * above * below.deriv()
        return min(_first_root(growth), _first_root(below))

    @cached_property
    def _bending(self) -> Bending:
        _, ox, oy, oz, r0, r1, r2, linearity = self.coefficients
        return Bending((ox, oy, oz), (r0, r1, r2), linearity=linearity)

    def distort(self, points: ArrayLike, ideal: Camera | None = None) -> Floats:
        """Raw pixels of ideal pixels.

        Parameters
        ----------
        points : (n, 2) column, row in the image of ``ideal``.
        ideal : the pinhole camera of those points; None: :meth:`ideal_camera`.

        Returns
        -------
        (n, 2) column, row in the raw image, perhaps outside; NaN where the model folds back (:attr:`reach`).
        """
        rays = (ideal or self.ideal_camera()).rays(_points(points))
        raw = self._project(rays)
        raw[~(np.hypot(rays[:, 0], rays[:, 1]) < self.reach)] = np.nan
        return raw

    def undistort(self, points: ArrayLike, ideal: Camera | None = None) -> Floats:
        """Ideal pixels of raw ones: the inverse of :meth:`distort`.

        By OpenCV's fixed-point iteration, which stalls under strong distortion, then Newton steps.

        Returns
        -------
        (n, 2) column, row in the image of ``ideal``; NaN where no ideal pixel has the raw position as its image.
        """
        raw = _points(points)
        ideal = ideal or self.ideal_camera()
        if self.model == "none" or not len(raw):
            return ideal.project(self.camera.rays(raw))
        if self.model == "cahvore":
            bent = self.camera.rays(raw)
            bent[:, 1] -= self.coefficients[0] / self.camera.fy * bent[:, 0]
            return ideal.project(self._bending.straighten(bent))
        rays = np.column_stack([self._start(raw), np.ones(len(raw))])
        with np.errstate(all="ignore"):
            todo = np.arange(len(raw))
            for _ in range(10):  # each step doubles the right digits; the start is good to a pixel
                here = self._project(rays[todo])
                # A millionth of a pixel: far below what any match resolves.
                unsolved = ~(np.hypot(*(here - raw[todo]).T) < 1e-6)
                todo, here = todo[unsolved], here[unsolved]
                if not todo.size:
                    break
                rays[todo, :2] -= self._step(rays[todo], here, raw[todo])
            rays[todo] = np.nan
            rays[~(np.hypot(rays[:, 0], rays[:, 1]) < self.reach)] = np.nan
        return ideal.project(rays)

    def maps(self, ideal: Camera) -> tuple[Floats32, Floats32]:
        """Raw column and row, (row, col) of ``ideal``'s image, of every ideal pixel; NaN where the model folds back."""
        size = (ideal.width, ideal.height)
        if self.model == "cahvore":
            raw = self.distort(np.stack(np.meshgrid(*map(np.arange, size)), axis=-1).reshape(-1, 2), ideal)
            column, row = raw.astype(np.float32).T.reshape(2, ideal.height, ideal.width)
            return column, row
        k, d = self.camera.matrix, np.array(self.coefficients)
        if self.model == "fisheye":
            x, y = cv2.fisheye.initUndistortRectifyMap(k, d, np.eye(3), ideal.matrix, size, cv2.CV_32FC1)
        else:
            x, y = cv2.initUndistortRectifyMap(k, d, None, ideal.matrix, size, cv2.CV_32FC1)
        if math.isfinite(self.reach):
            column = (np.arange(ideal.width) - ideal.cx) / ideal.fx
            row = (np.arange(ideal.height) - ideal.cy) / ideal.fy
            beyond = ~(np.hypot(column[None, :], row[:, None]) < self.reach)
            x[beyond] = y[beyond] = np.nan
        return x, y

    def _project(self, rays: Floats) -> Floats:
        k, d = self.camera.matrix, np.array(self.coefficients)
        raw = np.empty((len(rays), 2))
        for at in range(0, len(rays), CHUNK_POINTS):
            part = np.ascontiguousarray(rays[at : at + CHUNK_POINTS])
            if self.model == "cahvore":
                bent = self._bending.bend(part)
                raw[at : at + CHUNK_POINTS] = self.camera.project(bent)
                raw[at : at + CHUNK_POINTS, 1] += self.coefficients[0] * bent[:, 0] / bent[:, 2]
                continue
            if self.model == "fisheye":
                out = cv2.fisheye.distortPoints(part[None, :, :2].copy(), k, d)
            else:
                out = cv2.projectPoints(part, np.zeros(3), np.zeros(3), k, d)[0]
            raw[at : at + CHUNK_POINTS] = out.reshape(-1, 2)
        return raw

    def _start(self, raw: Floats) -> Floats:
        k, d = self.camera.matrix, np.array(self.coefficients)
        if self.model == "fisheye":
            return np.asarray(cv2.fisheye.undistortPoints(raw[None], k, d), dtype=np.float64).reshape(-1, 2)
        return np.asarray(cv2.undistortPoints(raw[None], k, d), dtype=np.float64).reshape(-1, 2)

    def _step(self, rays: Floats, here: Floats, raw: Floats) -> Floats:
        """Newton step (n, 2) in ray coordinates, with the derivative by central differences."""
        h = 1e-6
        across, down = (np.array([h, 0.0, 0.0]), np.array([0.0, h, 0.0]))
        a = (self._project(rays + across) - self._project(rays - across)) / (2 * h)
        b = (self._project(rays + down) - self._project(rays - down)) / (2 * h)
        miss = here - raw
        det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
        u = (miss[:, 0] * b[:, 1] - miss[:, 1] * b[:, 0]) / det
        v = (a[:, 0] * miss[:, 1] - a[:, 1] * miss[:, 0]) / det
        return np.stack([u, v], axis=1)

    def to_dict(self) -> dict[str, Any]:
        """JSON form."""
        return {"camera": self.camera.to_dict(), "model": self.model, "coefficients": list(self.coefficients)}

    @staticmethod
    def from_dict(d: Mapping[str, Any]) -> Lens:
        """Inverse of :meth:`to_dict`."""
        return Lens(Camera.from_dict(d["camera"]), str(d["model"]), tuple(float(v) for v in d["coefficients"]))


def _points(points: ArrayLike) -> Floats:
    return np.asarray(points, dtype=np.float64).reshape(-1, 2)


def _first_root(in_square: Polynomial) -> float:
    """Least zero r > 0 of a polynomial in r squared; infinite if there is none."""
    # 1e-12: smaller coefficients move no point of an image, and their roots lie outside of it.
    roots = in_square.trim(1e-12).roots()
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(1.0, np.abs(roots))) & (roots.real > 0)]
    return math.sqrt(float(real.min())) if real.size else math.inf
