"""Robust adjustment of a rig to correspondences of one or several pairs, together with errors that no rig explains.

Besides the five parameters of the rig (:mod:`rille.stages.geometry.epipolar`) two errors determine the distances of
matches from their lines; no number of matches averages them out, and a fit without them claims too high a precision.
They are estimated with a prior and then dropped:

* ``principal``: the right principal point is off, and the calibration's rotation compensates it, so that the disparity
  at infinity is right. On a parallel rig its row errors look like toe-in, though the depth is right: without it a fit
  "repairs" the toe-in of a sound calibration. Only a convergent rig (or a wide angle) can tell the two apart;
* ``smooth``: the row error of lens model and rectification, a polynomial of low degree over the image.

Both are the same in all pairs. The noise of the matches is measured, pair by pair, with its correlation between
neighbours. Weights are Tukey's; their scale starts at the scatter about the given rig and only decreases.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Bundle
from rille.stages.geometry.epipolar import NAMES, distances, turn_axes
from rille.stages.geometry.geometry import Rig
from rille.stages.numeric.robust import TUKEY_BISQUARE, bisquare, mad_sigma

RIG = len(NAMES)
PRINCIPAL = 2
DEGREE = 3
TERMS = tuple((i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i))
"""Degrees of the column and the row of the smooth error's polynomials."""

SIZE = RIG + PRINCIPAL + len(TERMS)

PARTNERS = ((NAMES.index("yaw"), 0), (NAMES.index("pitch"), 1))
"""Each angle with the coordinate of the principal point that has a similar effect."""

MIN_MATCHES = 50
"""Fewest matches of an orientation: ten for each of its five angles and directions."""

BLOCKS = 6
"""Blocks along either side of the image; the scatter of their means shows how far errors of neighbours correlate."""
MIN_MATCHES_OF_BLOCK = 5
"""Fewest matches of a block whose mean, or median, is used."""


@dataclass(frozen=True)
class PointPairs:
    """Corresponding points (n, 2) of one pair: column and row in the left and in the right image, pixels."""

    pair: int
    left: Floats
    right: Floats

    @staticmethod
    def of(orientation: Bundle) -> PointPairs:
        """Those of a result of stage ``orientation``."""
        left, right = (np.asarray(orientation[side], dtype=np.float64) for side in ("left", "right"))
        return PointPairs(orientation.meta["pair"], left, right)


@dataclass(frozen=True)
class Priors:
    """Prior standard deviations of the errors of an intact calibration.

    Attributes
    ----------
    rotation : of each of the three angles between the cameras, radians.
    baseline : of the direction of the baseline, radians.
    principal : of the principal point, column and row, pixels.
    systematic : least RMS of the smooth error, pixels.
    """

    rotation: float
    baseline: float
    principal: tuple[float, float]
    systematic: float

    def held(self) -> Floats:
        """Deviations (5,) of the rig's parameters, radians."""
        return np.array([self.rotation] * 3 + [self.baseline] * 2)

    @property
    def term(self) -> float:
        """Deviation of each term of the smooth error, pixels."""
        return self.systematic / math.sqrt(len(TERMS))


@dataclass(frozen=True)
class OrientationFit:
    """Result of :func:`adjust`.

    ``x`` (SIZE,): the five corrections (radians), principal point (2, pixels), smooth error (pixels). ``normal`` and
    ``pull``: the data's part of the normal equations ``normal @ x = pull``, linear about ``x``. ``noise``:
    deviation of each pair's matches, pixels. ``weights``: (n,) a pair.
    """

    x: Floats
    normal: Floats
    pull: Floats
    noise: tuple[float, ...]
    weights: tuple[Floats, ...]


@dataclass(frozen=True)
class Linear:
    """Distances ``constant + design @ x`` (n,) of one pair, linear about ``about``; ``block`` (n,) of each match."""

    constant: Floats
    design: Floats
    about: Floats
    block: NDArray[np.int64]


def linearised(rig: Rig, pairs: Sequence[PointPairs], x: Floats | None = None) -> list[Linear]:
    """Epipolar distances of each pair with systematic errors, linearised about unknowns x (SIZE,), None: zeros."""
    return [_linear(rig, m, np.zeros(SIZE) if x is None else x) for m in pairs]


def adjust(
    rig: Rig,
    pairs: Sequence[PointPairs],
    free: Sequence[bool],
    priors: Priors,
    *,
    rival: bool,
) -> OrientationFit:
    """Adjust a rig to point pairs, together with the errors that no rig explains: Gauss-Newton, weights by the scatter.

    Parameters
    ----------
    free : which of the five parameters of the rig have no prior. The others have the prior of an intact calibration
        (``priors``), so that their part of the residuals does not pass into the free ones.
    rival : see :func:`precision`.
    """
    prior = precision(free, priors, rival=rival)
    x, scales, linear = np.zeros(SIZE), [np.inf] * len(pairs), linearised(rig, pairs)
    for _ in range(30):
        # All pairs are linearised about the same x. Within a milliradian the derivatives neglect less than .001 pixels.
        if np.abs(x - linear[0].about)[:RIG].max() > 1e-3:
            linear = linearised(rig, pairs, x)
        parts = [_pair(one, scale, x) for one, scale in zip(linear, scales, strict=True)]
        scales = [p.noise for p in parts]
        normal = np.sum([p.normal for p in parts], axis=0)
        pull = np.sum([p.pull for p in parts], axis=0)
        covariance, last = np.linalg.inv(normal + prior), x
        x = covariance @ pull
        # Converged: the steps are below a hundredth of the standard deviations.
        if bool(np.all(np.abs(x - last)[:RIG] < 1e-2 * np.sqrt(np.diag(covariance)[:RIG]))):
            break
    return OrientationFit(x, normal, pull, tuple(scales), tuple(p.weights for p in parts))


def settle(rig: Rig, pairs: Sequence[PointPairs], free: Sequence[bool], priors: Priors) -> OrientationFit:
    """Fit the free parameters so that the residuals of the resulting rig are smallest.

    The other parameters are fixed at their given values, and the smooth error at zero, because the resulting rig
    corrects neither.
    """
    # 1e-7: standard deviation [rad] that holds a parameter; 3e-3 [px]: one that practically holds the smooth error.
    none = replace(priors, rotation=1e-7, baseline=1e-7, systematic=3e-3)
    return adjust(rig, pairs, free, none, rival=False)


def consider_covariance(fit: OrientationFit, free: Sequence[bool], priors: Priors, held: Floats) -> Floats:
    """Return the covariance (5, 5), radians^2, of the free parameters of a fit by :func:`settle`; zero for the others.

    It is a consider covariance (Bierman 1977, chapter 8): parameters that the fit did not estimate contribute their
    uncertainty. These are the held parameters, with standard deviations ``held`` (5,), radians, and the smooth error
    with that of its prior (:class:`Priors`).
    """
    prior = precision(free, priors, rival=False)
    for i in np.flatnonzero(~np.asarray(free)):
        # Their standard deviations as known by now, not the priors of the fit.
        prior[i, i] = held[i] ** -2.0
    solved = np.array([*free, *[True] * PRINCIPAL, *[False] * len(TERMS)])
    inverse = np.linalg.inv(fit.normal[np.ix_(solved, solved)] + prior[np.ix_(solved, solved)])
    # Gain of the consider covariance: change of the estimate with each parameter that was not estimated.
    gain = -inverse @ fit.normal[np.ix_(solved, ~solved)]
    covariance = np.zeros((SIZE, SIZE))
    covariance[np.ix_(solved, solved)] = inverse + gain @ np.diag(1.0 / np.diag(prior)[~solved]) @ gain.T
    return np.asarray(covariance[:RIG, :RIG], dtype=np.float64)


def precision(free: Sequence[bool], priors: Priors, *, rival: bool) -> Floats:
    """The priors' part (SIZE, SIZE) of the normal matrix.

    ``rival``: a wrong principal point may explain the residuals instead of a free angle, as it always may instead of a
    held one. With it the errors say what is knowable; without it the angle explains all (when a mount turns, lenses
    stay on their cameras).
    """
    sigma = np.concatenate([priors.held(), priors.principal, np.full(len(TERMS), priors.term)], dtype=np.float64)
    # Free: a prior of one radian, which keeps the matrix regular where a scene does not determine the parameter.
    sigma[:RIG] = np.where(np.asarray(free), 1.0, sigma[:RIG])
    for angle, coordinate in PARTNERS:
        if free[angle] and not rival:
            # Practically held.
            sigma[RIG + coordinate] = 1e-3
    return np.diag(sigma**-2.0)


def solution(fit: OrientationFit, free: Sequence[bool], priors: Priors, *, rival: bool) -> tuple[Floats, Floats, float]:
    """Values (SIZE,), covariance and gain (half the drop of chi-square) of a fit's normal equations with other free
    parameters."""
    total = fit.normal + precision(free, priors, rival=rival)
    covariance = np.asarray(np.linalg.inv(total), dtype=np.float64)
    x = covariance @ fit.pull
    return x, covariance, 0.5 * float(np.sum(fit.pull * x))


def estimate(rig: Rig, pairs: Sequence[PointPairs], free: Sequence[bool], priors: Priors) -> tuple[Floats, Floats]:
    """Values and standard deviations (5,), radians, of the corrections of a rig by some pairs, cameras as given."""
    x, covariance, _ = solution(adjust(rig, pairs, free, priors, rival=False), free, priors, rival=False)
    return x[:RIG], np.sqrt(np.diag(covariance))[:RIG]


@dataclass(frozen=True)
class _Part:
    normal: Floats
    pull: Floats
    noise: float
    weights: Floats


def _linear(rig: Rig, matches: PointPairs, x: Floats) -> Linear:
    """Distances of a corrected rig with systematic errors about ``x``."""
    distance, slopes = distances(rig, x[:RIG], matches.left, matches.right)
    by_rig, by_point = slopes[:, :RIG], slopes[:, RIG:]
    # A principal point further right (down) by a pixel, compensated by yaw (pitch); then along the axes of the turns.
    axes = turn_axes(rig)[:2, :2]
    compensation = (by_rig[:, :2] @ axes.T)[:, [1, 0]] * [-1.0 / rig.right.fx, 1.0 / rig.right.fy]
    shifts = (compensation - by_point) @ axes
    design = np.column_stack([by_rig, shifts, _smooth_terms(rig, matches)])
    column, row = np.minimum(matches.left.T * BLOCKS / [[rig.left.width], [rig.left.height]], BLOCKS - 1).astype(int)
    return Linear(distance - by_rig @ x[:RIG], design, x, row * BLOCKS + column)


def _pair(linear: Linear, last: float, x: Floats) -> _Part:
    """One pair's part of the normal equations, with weights from its own scatter (at most ``last``, pixels)."""
    rest = linear.constant + linear.design @ x
    # At most the last scale, so that the fit cannot alternate between two sets of inliers.
    noise = max(0.02, min(last, mad_sigma(rest, 0.0)))
    weights = np.asarray(bisquare(rest / (TUKEY_BISQUARE * noise)), dtype=np.float64)
    # Errors of neighbours correlate: means of blocks scatter more than those of independent errors would.
    number = np.bincount(linear.block, weights, BLOCKS**2)
    sums = np.bincount(linear.block, weights * rest, BLOCKS**2)
    used = number >= MIN_MATCHES_OF_BLOCK
    inflation = float(np.mean(sums[used] ** 2 / number[used])) / noise**2 if used.any() else 1.0
    weighted = linear.design.T * (weights / (noise**2 * max(1.0, inflation)))
    return _Part(weighted @ linear.design, -weighted @ linear.constant, noise, weights)


def _smooth_terms(rig: Rig, matches: PointPairs) -> Floats:
    """Normalised Legendre polynomials (n, terms) of the left pixel: RMS 1 over the image."""
    u = 2.0 * matches.left[:, 0] / max(rig.left.width - 1, 1) - 1.0
    v = 2.0 * matches.left[:, 1] / max(rig.left.height - 1, 1) - 1.0
    across, down = (np.polynomial.legendre.legvander(a, DEGREE) for a in (u, v))
    return np.column_stack([math.sqrt((2 * i + 1) * (2 * j + 1)) * across[:, i] * down[:, j] for i, j in TERMS])


def rms(distance: Floats, weights: Floats) -> float:
    """RMS of the distances without outliers, pixels; NaN if all are outliers."""
    used = weights > 0
    return float(np.sqrt(np.mean(distance[used] ** 2))) if used.any() else float("nan")
