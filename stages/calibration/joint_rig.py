"""One rig from the matches of several runs.

Each run repairs its rig by its own images, so that rigs of pieces of one log differ a little. Here the matches of all
runs together decide which parameters depart from the calibration, and by how much, as those of all pairs do in a run.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from rille.stages.calibration.parameter_selection import Parameter, RelativeParams, decide
from rille.stages.calibration.relative_orientation import MIN_MATCHES, PointPairs, estimate
from rille.stages.core.arrays import Floats
from rille.stages.core.errors import InputError, warning
from rille.stages.geometry.epipolar import corrected
from rille.stages.geometry.geometry import Rig


@dataclass(frozen=True)
class Estimate:
    """Correction of a rig by the matches of one run: values and standard deviations (5,), radians."""

    run: str
    values: Floats
    sigma: Floats


@dataclass(frozen=True)
class Joint:
    """The rig of all runs, its parameters, and each run's own estimate."""

    rig: Rig
    parameters: tuple[Parameter, ...]
    estimates: tuple[Estimate, ...]


def joint(given: Rig, matches: Mapping[str, Sequence[PointPairs]], params: RelativeParams) -> Joint:
    """The rig of several runs: the given one, corrected where the matches of all together contradict it.

    Parameters
    ----------
    matches : of each run, by its name.

    Raises
    ------
    InputError
        A run has no pair with enough matches.
    """
    empty = next((name for name, pairs in matches.items() if not pairs), None)
    if empty is not None:
        text = f"run {empty} has no pair with {MIN_MATCHES} matches"
        raise InputError("RIL-030", text, remedy="leave it out, or choose more frames")
    decision = decide(given, [pair for pairs in matches.values() for pair in pairs], params)
    observed, priors = [p.observed for p in decision.parameters], params.priors(given)
    estimates = (Estimate(name, *estimate(given, pairs, observed, priors)) for name, pairs in matches.items())
    return Joint(corrected(given, decision.correction), decision.parameters, tuple(estimates))


def disagreements(found: Joint, significance: float) -> Iterator[str]:
    """Lines on estimates of runs that differ from the joint one by more than ``significance`` standard deviations."""
    for k, parameter in enumerate(found.parameters):
        for one in found.estimates if parameter.observed else ():
            off = one.values[k] - parameter.asked
            away = abs(off) / one.sigma[k]
            if away > significance:
                turn = math.degrees(off)
                text = f"{parameter.name.replace('_', ' ')} of run {one.run} is {turn:+.3f} degrees off the others"
                yield warning("RIL-025", f"{text}, {away:.0f} standard deviations: did the rig move between them?")
