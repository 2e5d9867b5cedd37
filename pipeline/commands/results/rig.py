"""``rille rig``: one rig from the matches of several runs, for manifests to pin."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import tomli_w

from rille.datasets.text.reading import read_toml
from rille.pipeline.engine.plain import warn
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.programs.run_artifacts import RunArtifacts
from rille.pipeline.runs import lookup, options
from rille.pipeline.runs.options import RUNS, CacheFolder, Output, Run, Runs
from rille.stages.calibration.joint_rig import Joint, disagreements, joint
from rille.stages.calibration.relative_orientation import MIN_MATCHES, PointPairs
from rille.stages.calibration.rig import RigParams
from rille.stages.core.errors import InputError
from rille.stages.geometry.geometry import Rig


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
