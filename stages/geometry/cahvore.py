"""Camera models CAHV, CAHVOR and CAHVORE of NASA's rovers: point to pixel, and pixel to ray.

Vectors are given in the reference frame: the camera's centre C (m), the unit normal A of the image plane, H and V that
give column and row (pixels), and the unit optical axis O. A point P, with p = P - C, is imaged at column p''.H / p''.A
and row p''.V / p''.A, pixel centres at integers (CAHV: p'' = p). With w = p.O along the optical axis and l = p - w O
across it:

* CAHVOR bends the ray: p'' = p + mu l, mu = R0 + R1 x^2 + R2 x^4, x = |l| / w.
* CAHVORE has, for a ray at the angle t to O, p'' = |l| / x O + (1 + mu) l with x = tan(L t) / L, sin(L t) / L or t for
  a linearity L above, below or equal to 0 (perspective lens 1, fisheye 0).

CAHVOR is CAHVORE with L = 1. CAHVORE's entrance pupil also moves along O, by some times E (millimetres). The pixel of a
point much farther than E depends only on its direction from C, so that E is left out here.

Sources: Yakimovsky, Cunningham (1978), doi:10.1016/0146-664X(78)90112-0; Gennery (2001), Least-squares camera
calibration including lens distortion and automatic editing of calibration points; Gennery (2006), Generalized camera
calibration including fish-eye lenses, doi:10.1007/s11263-006-5168-1; Di, Li (2004), doi:10.1029/2003JE002199.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rille.stages.core.arrays import Floats

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Bending:
    """Distortion of a lens: optical axis O (unit length), radial terms R, linearity L."""

    axis: Vector
    radial: Vector = (0.0, 0.0, 0.0)
    linearity: float = 1.0

    def bend(self, points: Floats) -> Floats:
        """Directions (n, 3) p'' of points (n, 3) relative to C; NaN for points outside the field of view."""
        o = np.asarray(self.axis)
        along = points @ o
        across = points - along[:, None] * o
        far = np.linalg.norm(across, axis=1)
        with np.errstate(all="ignore"):
            chi = self._chi(np.arctan2(far, along))
            # On the axis the direction across would be 0 / 0.
            central = far <= 1e-12 * np.abs(along)  # no direction across: the point itself
            scaled = np.where(central, along, far / np.where(central, 1.0, chi))
            factor = 1.0 + _even(self.radial, np.where(central, 0.0, chi))
        return np.asarray(scaled[:, None] * o + factor[:, None] * across)

    def straighten(self, directions: Floats) -> Floats:
        """Inverse of :meth:`bend`: unit rays (n, 3); NaN where there is none."""
        o = np.asarray(self.axis)
        along = directions @ o
        across = directions - along[:, None] * o
        far = np.linalg.norm(across, axis=1)
        with np.errstate(all="ignore"):
            angle = self._angle_of(self._unbent(np.where(along > 0, far / along, np.nan)))
            unit = np.where(far[:, None] > 0, across / far[:, None], 0.0)
        return np.asarray(np.cos(angle)[:, None] * o + np.sin(angle)[:, None] * unit)

    def reach(self) -> float:
        """Angle to O, radians, up to which pixels move outwards."""
        r = self.radial
        # Derivative of (1 + mu(x)) x in powers of x squared: where it vanishes, pixels turn back inwards.
        roots = np.roots([5.0 * r[2], 3.0 * r[1], 1.0 + r[0]]) if any(r) else np.empty(0)
        real = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)]
        # A tangent is infinite at a quarter turn, and a sine decreases beyond it.
        limit = math.pi if self.linearity == 0 else 0.5 * math.pi / abs(self.linearity)
        if not real.size:
            return limit
        angle = float(self._angle_of(np.array([math.sqrt(float(real.min()))]))[0])
        return limit if math.isnan(angle) else min(angle, limit)

    def _chi(self, angle: Floats) -> Floats:
        t = np.where(angle < self.reach(), angle, np.nan)
        if self.linearity == 0:
            return t
        turned = self.linearity * t
        return np.asarray((np.tan(turned) if self.linearity > 0 else np.sin(turned)) / self.linearity)

    def _angle_of(self, chi: Floats) -> Floats:
        if self.linearity == 0:
            return chi
        turned = self.linearity * chi
        return np.asarray((np.arctan(turned) if self.linearity > 0 else np.arcsin(turned)) / self.linearity)

    def _unbent(self, bent: Floats) -> Floats:
        """The x whose (1 + mu(x)) x is given, by Newton's method; NaN where there is none."""
        if not any(self.radial):
            return bent
        r0, r1, r2 = self.radial

        chi = bent / (1.0 + r0)
        # Each step doubles the right digits of a start that is good to some percent.
        for _ in range(30):
            square = chi * chi
            off = ((1.0 + _even(self.radial, chi)) * chi - bent) / (1 + r0 + 3 * r1 * square + 5 * r2 * square**2)
            chi = chi - off
            # Absolute below a radius of 1, relative above.
            if not (np.abs(off) > 1e-14 * np.maximum(1.0, np.abs(chi))).any():
                break
        solved = np.abs((1.0 + _even(self.radial, chi)) * chi - bent) < 1e-12 * np.maximum(1.0, bent)
        return np.where(solved & (chi >= 0), chi, np.nan)


def _even(terms: Vector, x: Floats) -> Floats:
    square = x * x
    return np.asarray(terms[0] + square * (terms[1] + square * terms[2]))
