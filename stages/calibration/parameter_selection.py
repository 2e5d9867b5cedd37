"""Select the parameters of a rig that the images may change.

A low epipolar residual does not prove that the rig is right: toe-in of a parallel rig moves rows like a principal point
that is a few pixels off, and a fit that frees the toe-in lowers the residual at the price of wrong depth. So a
parameter is freed only if

1. it is *observed*: its uncertainty, with every other error estimated too
   (:mod:`rille.stages.calibration.relative_orientation`), changes depth little; or it departs by several standard
   deviations whatever the principal point; or matches beyond infinity show that depth is wrong, and the parameter
   explains them;
2. it is *contradicted*: it differs from the calibration by several of its standard deviations, and a wrong principal
   point is not the likelier cause, as it is if a single angle departs. If an angle departs, the camera was turned, and
   for the other angles one standard deviation is enough;
3. it is *worth it*: the change moves rows, or depth, by more than the usual error of a good calibration, or another
   angle departs and this one contradicts its calibration, too; and it exceeds twice its error, with that of what is
   held.

All other parameters stay exactly as given. Angles are tested before the direction of the baseline, because mounts turn
rather than shift.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from rille.stages.calibration.relative_orientation import (
    PARTNERS,
    RIG,
    OrientationFit,
    PointPairs,
    Priors,
    adjust,
    consider_covariance,
    settle,
    solution,
)
from rille.stages.core.arrays import Floats
from rille.stages.core.declare import Params
from rille.stages.geometry.epipolar import NAMES, beyond_infinity, corrected, depth_sensitivity, distances
from rille.stages.geometry.geometry import Rig

ANGLES = 3

BEYOND_SHARE = 0.1
"""Share of matches more than a pixel beyond infinity above which depth is wrong; a sky has fewer."""


SYSTEMATIC_PX = 0.1
"""Smooth row error [pixels RMS over the image] of lens model and rectification, which no rig explains and more matches
do not reduce."""

MAX_DEPTH_ERROR = 0.03
"""Largest relative depth error that the uncertainty of an observed parameter may cause; a wrong toe-in of a parallel
rig causes 0.1 and more, of a convergent rig 0.01 to 0.02."""

LEAST_SIGMAS = 2.0
"""Deviations, with that of what is held, by which a correction has to differ from none."""

MIN_DEPTH_CHANGE = 0.005
"""Relative change of depth from which on a correction is applied, as by ``least_rows``."""


class RelativeParams(Params):
    """When a parameter of the rig may depart from the calibration.

    Attributes
    ----------
    significance : standard deviations, systematic errors included, by which the images must contradict a calibrated
        value to change it; 1 for the other angles once one has changed.
    least_rows : change of row offsets [pixels RMS] from which on a correction is applied; KITTI's calibration is good
        to 0.4.
    prior_principal : standard deviation of the principal point over the focal length; 0.005 is usual for a calibration
        with a target; smaller values make more toe-in observable.
    """

    significance: float = Field(4.0, ge=1)
    least_rows: float = Field(0.4, ge=0)
    prior_principal: float = Field(0.005, gt=0)

    def priors(self, rig: Rig) -> Priors:
        """Prior standard deviations of a rig, in radians and pixels."""
        # Standard deviations of an intact calibration: of each rotation angle, and of the baseline's direction.
        return Priors(
            math.radians(0.05),
            math.radians(0.2),
            (self.prior_principal * rig.right.fx, self.prior_principal * rig.right.fy),
            SYSTEMATIC_PX,
        )


@dataclass(frozen=True)
class Parameter:
    """One parameter of the rig: its correction and sigma (radians), whether it was freed, and why or why not.

    ``value`` is the applied correction, 0 if held; ``asked`` the estimate from the images alone. ``sigma`` is the error
    of ``value`` if freed, else of ``asked``.
    """

    name: str
    value: float
    asked: float
    sigma: float
    observed: bool
    freed: bool
    why: str

    def to_dict(self) -> dict[str, Any]:
        """JSON form, in degrees."""
        degrees = {name: math.degrees(getattr(self, name)) for name in ("value", "asked", "sigma")}
        return asdict(self) | degrees | {"unit": "deg"}


@dataclass(frozen=True)
class Decision:
    """Correction of a rig, and the decision about each of its parameters.

    Attributes
    ----------
    correction : (5,) radians; 0 for held parameters.
    parameters : the parameters, in order of :data:`rille.stages.geometry.epipolar.NAMES`.
    fit : the fit behind the correction.
    """

    correction: Floats
    parameters: tuple[Parameter, ...]
    fit: OrientationFit

    @property
    def changed(self) -> bool:
        """Whether anything departs from the calibration."""
        return bool(np.any(self.correction))


def decide(rig: Rig, pairs: Sequence[PointPairs], params: RelativeParams) -> Decision:
    """Which parameters of a rig the pairs change, and by how much."""
    return _Chooser(rig, pairs, params).decision()


class _Estimate(NamedTuple):
    """A parameter as estimated from the images with the chosen ones, cameras as given.

    ``value``, ``sigma``: radians; ``rows``, ``depth``: its effect on rows, pixels RMS, and on depth, relative.
    """

    value: float
    sigma: float
    rows: float
    depth: float

    def __str__(self) -> str:
        return f"{math.degrees(self.value):+.3f} +- {math.degrees(self.sigma):.3f} degrees"


class _Chooser:
    """Chooses parameters by the normal equations of a fit with all of them free, then fits the chosen ones alone."""

    def __init__(self, rig: Rig, pairs: Sequence[PointPairs], params: RelativeParams) -> None:
        self.rig, self.pairs, self.params, self.priors = rig, pairs, params, params.priors(rig)
        self.all = adjust(rig, pairs, [True] * RIG, self.priors, rival=True)
        # Sensitivities at the fitted rig: with a wrong toe-in they would be those of wrong depths.
        near = corrected(rig, self.all.x[:RIG])
        self.depth = np.mean([depth_sensitivity(near, m.left, m.right) for m in pairs], axis=0)
        self.impossible = impossible_share(rig, pairs, self.all) > BEYOND_SHARE
        self.rows = row_sensitivity(rig, pairs)

    def decision(self) -> Decision:
        chosen: list[int] = []
        for _ in range(3):  # each choice may make others unnecessary, or possible
            before = sorted(chosen)
            self._add(chosen, range(ANGLES))
            self._add(chosen, range(ANGLES, RIG))
            for i in sorted(chosen):
                others = [k for k in chosen if k != i]
                if self._refusal(i, others) is not None:
                    chosen = others
            if sorted(chosen) == before:
                break
        fit, correction = self._settled(chosen)
        for remaining in (self._sure, self._enough):
            if (fewer := remaining(chosen, fit, correction)) != chosen:
                chosen = fewer
                fit, correction = self._settled(chosen)
        parameters = tuple(self._parameter(i, chosen, fit) for i in range(RIG))
        return Decision(correction, parameters, fit)

    def _sure(self, chosen: list[int], fit: OrientationFit, correction: Floats) -> list[int]:
        """Those of the chosen parameters whose correction exceeds its error."""
        return [i for i in chosen if abs(correction[i]) >= LEAST_SIGMAS * self._sigma(i, chosen, fit)]

    def _enough(self, chosen: list[int], fit: OrientationFit, correction: Floats) -> list[int]:
        """The chosen parameters if together they move rows or depth by more than the usual error of a good calibration:
        changes that are large singly may cancel each other."""
        rows, depth = self._moves(correction)
        worth = rows >= self.params.least_rows or depth >= MIN_DEPTH_CHANGE or self._explains(correction)
        return chosen if worth else []

    def _sigma(self, i: int, chosen: Sequence[int], fit: OrientationFit) -> float:
        """Standard deviation of a chosen parameter, radians, with that of what is held."""
        free = [k in chosen for k in range(RIG)]
        return math.sqrt(float(consider_covariance(fit, free, self.priors, self._held(list(chosen)))[i, i]))

    def _settled(self, chosen: Sequence[int]) -> tuple[OrientationFit, Floats]:
        """The fit with the chosen parameters free, and their correction (5,)."""
        free = [i in chosen for i in range(RIG)]
        fit = settle(self.rig, self.pairs, free, self.priors)
        return fit, np.where(free, fit.x[:RIG], 0.0)

    def _moves(self, correction: Floats) -> tuple[float, float]:
        """Effect of a correction (5,), radians, on rows, pixels RMS, and on depth, relative."""
        rows, depth = (math.sqrt(float(correction @ form @ correction)) for form in (self.rows, self.depth))
        return rows, depth

    def _explains(self, correction: Floats) -> bool:
        """Whether many matches lie beyond infinity, so that depth is surely wrong, and a correction (5,) explains them.

        Chance matches in a sky lie there with every correction.
        """
        # 0.03: largest share of matches beyond infinity that may remain after a correction that explains the others.
        return self.impossible and impossible_share(corrected(self.rig, correction), self.pairs, self.all) < 0.03

    def _add(self, chosen: list[int], group: Sequence[int]) -> None:
        """Choose the parameters that are not refused, one after the other, each the one of most gain."""
        while True:
            able = [i for i in group if i not in chosen and self._refusal(i, chosen) is None]
            if not able:
                return
            gains = [self._solve([*chosen, i], rival=False)[2] for i in able]
            chosen.append(able[int(np.argmax(gains))])

    def _solve(self, chosen: Sequence[int], *, rival: bool) -> tuple[Floats, Floats, float]:
        return solution(self.all, [i in chosen for i in range(RIG)], self.priors, rival=rival)

    def _depth_error(self, i: int, chosen: list[int]) -> float:
        """Relative depth error by a parameter's uncertainty, with the principal point unknown."""
        covariance = self._solve([*chosen, i], rival=True)[1]
        return math.sqrt(float(self.depth[i, i] * covariance[i, i]))

    def _departs(self, i: int, chosen: list[int]) -> float:
        """Standard deviations by which a parameter departs, with the principal point unknown."""
        x, covariance, _ = self._solve([*chosen, i], rival=True)
        return abs(float(x[i])) / math.sqrt(float(covariance[i, i]))

    def _surely_off(self, i: int, chosen: list[int]) -> bool:
        """Whether a parameter is wrong by more than what hides it explains."""
        if self.impossible:  # what lies beyond infinity says more than rows
            return self._infinity(i, chosen)
        # Twice: on a street rows ask for half a degree too much.
        return self._departs(i, chosen) >= 2.0 * self.params.significance

    def _turned(self, i: int, chosen: list[int]) -> bool:
        """Whether another angle of the rig has changed."""
        return any(k != i for k in chosen if k < ANGLES)

    def _infinity(self, i: int, chosen: list[int]) -> bool:
        """Whether many matches lie beyond infinity, and this parameter explains them, and half of it does not.

        Rows that hardly show a toe-in may ask for several times as much as brings all matches before infinity.
        """
        x, _, _ = self._solve([*chosen, i], rival=False)
        whole = np.where(np.isin(np.arange(RIG), [*chosen, i]), x[:RIG], 0.0)
        half = np.where(np.arange(RIG) == i, 0.5, 1.0) * whole
        return self._explains(whole) and not self._explains(half)

    def _asked(self, i: int, chosen: list[int]) -> _Estimate:
        x, covariance, _ = self._solve([*chosen, i], rival=False)
        value = float(x[i])
        return _Estimate(value, math.sqrt(float(covariance[i, i])), *self._moves(value * np.eye(RIG)[i]))

    def _refusal(self, i: int, chosen: list[int]) -> str | None:
        """Why a parameter is held; None where it is to be freed."""
        asked, error = self._asked(i, chosen), self._depth_error(i, chosen)
        if error > MAX_DEPTH_ERROR and not self._surely_off(i, chosen):
            off = self.priors.principal[dict(PARTNERS).get(i, 0)]
            return (
                f"not observed: a principal point that is {off:.1f} px off looks like it, so that "
                f"{100 * error:.1f} % of depth would stay unknown; taken alone the images ask for {asked}, "
                f"which is {100 * asked.depth:.1f} % of depth"
            )
        # A turned camera hardly keeps its other angles.
        turned = i < ANGLES and self._turned(i, chosen)
        contradicted = abs(asked.value) >= self.params.significance * asked.sigma
        if not contradicted and not (turned and abs(asked.value) >= asked.sigma):
            return f"not contradicted: the images say {asked}"
        # Else the camera was turned: another angle changed, too, or no principal point explains the difference.
        if not (self.impossible or self._turned(i, chosen) or self._departs(i, chosen) >= 2.0):
            return (
                f"likelier a principal point that is off, with the right depth, for no other angle departs: the images "
                f"say {asked}, which is {100 * asked.depth:.1f} % of depth"
            )
        # A small but certain turn, if held, would pass into the other angles.
        small = asked.rows < self.params.least_rows and asked.depth < MIN_DEPTH_CHANGE
        if small and not (turned and contradicted):
            moves = f"rows by {asked.rows:.2f} px, depth by {asked.depth:.2%}"
            return f"not worth it: the images say {asked}, which moves {moves}"
        return None

    def _held(self, chosen: list[int]) -> Floats:
        """Standard deviations (5,) of the held parameters, radians: their prior, or less if the images show less."""
        # Root of value squared and sigma squared: how far it may be off by the images, their error included.
        shown = [self._asked(i, chosen) for i in range(RIG)]
        return np.minimum(self.priors.held(), [math.hypot(one.value, one.sigma) for one in shown])

    def _parameter(self, i: int, chosen: list[int], fit: OrientationFit) -> Parameter:
        others = [k for k in chosen if k != i]
        asked, observed = self._asked(i, others), self._depth_error(i, others) <= MAX_DEPTH_ERROR or i in chosen
        if i not in chosen:
            little = "with the others it moves rows and depth by too little, or by less than what is held may be off"
            why = self._refusal(i, chosen) or f"not worth it: {little}"
            return Parameter(NAMES[i], 0.0, asked.value, asked.sigma, observed, False, why)
        sigma, value = self._sigma(i, chosen, fit), float(fit.x[i])
        rows, depth = self._moves(value * np.eye(RIG)[i])
        why = (
            f"contradicted: {abs(asked.value) / asked.sigma:.0f} times the images' own error, without that of what is "
            f"held; it moves rows by {rows:.2f} px, depth by {depth:.2%}"
        )
        return Parameter(NAMES[i], value, value, sigma, observed, True, why)


def impossible_share(rig: Rig, pairs: Sequence[PointPairs], fit: OrientationFit) -> float:
    """Share of the matches, outliers aside, that lie beyond infinity; 0 where all are outliers."""
    beyond = np.concatenate([beyond_infinity(rig, m.left, m.right) for m in pairs])
    used = beyond[np.concatenate(fit.weights) > 0]
    return float(np.mean(used > 1.0)) if used.size else 0.0


def row_sensitivity(rig: Rig, pairs: Sequence[PointPairs]) -> Floats:
    """Quadratic form (5, 5): mean square pixels by which a correction moves matches across their lines."""
    by_radian = [distances(rig, np.zeros(RIG), m.left, m.right)[1][:, :RIG] for m in pairs]
    return np.asarray(np.mean([d.T @ d / len(d) for d in by_radian], axis=0), dtype=np.float64)
