"""``rille rig``: one rig from the matches of several runs, for manifests to pin.

Each run repairs its rig by its own images, so that rigs of pieces of one log differ a little. Here the matches of all
runs together decide which parameters depart from the calibration, and by how much, as those of all pairs do in a run.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tomli_w

from rille.datasets.text.reading import read_toml
from rille.pipeline.engine.plain import warn
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.programs.run_artifacts import RunArtifacts
from rille.pipeline.runs import lookup, options
from rille.pipeline.runs.options import RUNS, CacheFolder, Output, Run, Runs
from rille.stages.calibration.parameter_selection import Parameter, decide
from rille.stages.calibration.relative_orientation import MIN_MATCHES, PointPairs, adjust, solution
from rille.stages.calibration.rig import RigParams
from rille.stages.core.arrays import Floats
from rille.stages.core.errors import InputError, warning
from rille.stages.geometry.epipolar import NAMES, corrected
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


def rig(
    run: Run,
    *more: Run,
    output: Annotated[Path, Output] = Path("rig.toml"),
    runs: Runs = RUNS,
    cache: CacheFolder = None,
) -> None:
    """Estimate one rig from several runs with one calibration; manifests pin it by `rig.file`.

    Prints the correction of each parameter by each run, and by all. `rille reconstruct SEQ --until rig` computes what
    is needed of a sequence.

    Parameters
    ----------
    more
        Others.
    output
        TOML file to write.
    """
    options.check_output(output, ".toml")
    if output.exists() and "corrected_by_degrees" not in read_toml(output, "rig"):
        options.check_new(output, ", and is no rig")
    store, matches, given = Store(options.cache_folder(cache)), dict[str, list[PointPairs]](), dict[str, Any]()
    folders = list(dict.fromkeys(lookup.find(name, runs) for name in (run, *more)))
    for folder in folders:
        with lookup.reading(folder):
            artifacts = RunArtifacts(folder, store)
            given[lookup.name(folder)] = artifacts.one("rig").meta["given"]
            pairs = map(PointPairs.of, artifacts.all("orientation").values())
            matches[lookup.name(folder)] = [pair for pair in pairs if len(pair.left) >= MIN_MATCHES]
    other = next((name for name, one in given.items() if one != next(iter(given.values()))), None)
    if other is not None:
        text = f"run {other} has another calibration than {next(iter(given))}"
        raise InputError("RIL-028", text, remedy="give runs of sequences with one calibration, and images of one size")
    params = RigParams.model_validate(read_toml(folders[0] / "config.toml", "configuration").get("rig", {}))
    found = joint(Rig.from_dict(next(iter(given.values()))), matches, params)
    atomic.write(output, _toml(found))
    print("\n".join(_table(found)))
    for line in (*disagreements(found, params.significance), *lookup.shared_images(folders)):
        warn(line)
    print(f"wrote        {output}\nnext         in the manifest of each sequence:")
    print(f'\n[rig]\nfile = "{output.resolve()}"')


def joint(given: Rig, matches: Mapping[str, Sequence[PointPairs]], params: RigParams) -> Joint:
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
    estimates = []
    for name, pairs in matches.items():
        values, covariance, _ = solution(
            adjust(given, pairs, observed, priors, rival=False), observed, priors, rival=False
        )
        estimates.append(Estimate(name, values[: len(NAMES)], np.sqrt(np.diag(covariance))[: len(NAMES)]))
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


def _table(found: Joint) -> Iterator[str]:
    """Table of corrections, degrees, by parameter: of all runs together, and of each."""
    names = [one.run.partition("/")[0] for one in found.estimates]
    heads = names if len(set(names)) == len(names) else [one.run.rpartition("/")[2] for one in found.estimates]
    yield "  ".join([f"{'degrees':17s}", *(f"{head:>17.17s}" for head in ["all", *heads])])
    for k, p in enumerate(found.parameters):
        # The estimate of a parameter that is not observed would be the prior.
        own = [(one.values[k], one.sigma[k]) for one in found.estimates if p.observed]
        each = [(p.asked, p.sigma), *own]
        cells = "  ".join(f"{math.degrees(v):+8.3f} +- {math.degrees(s):.3f}" for v, s in each)
        yield f"{p.name.replace('_', ' '):17s}  {cells}  {'corrected' if p.freed else 'as given: ' + p.why}"


def _toml(found: Joint) -> str:
    """The file's text: the rig, and how it was estimated."""
    turned = {p.name: math.degrees(p.value) for p in found.parameters}
    content = {"runs": [one.run for one in found.estimates], "corrected_by_degrees": turned}
    head = "# A rig for manifests: [rig] file = ... ; x_right = R x_left + t, metres, rows of [R | t].\n"
    return head + tomli_w.dumps(content | {"rig": found.rig.to_dict()})
