"""A part of a reconstruction: the tasks of some stages (``--until``), or some files (``--only``)."""

from __future__ import annotations

from collections.abc import Collection

from rille.pipeline.engine.graph import Cut
from rille.pipeline.export import catalogue
from rille.pipeline.flow import config
from rille.pipeline.runs.lookup import refuse_unknown
from rille.stages.core.errors import ConfigError

MADE_BY = {
    "crosscheck_accuracy": "accuracy",
    "local_dem_accuracy": "dem_accuracy",
    "world_tiles": "merge",
    "world_risk": "risk",
    "world_path": "path",
}
"""Stage of each product that files are made of, if their names differ; products without a stage are known early."""


def cut(until: Collection[str], only: Collection[str]) -> Cut | None:
    """The wanted part of a run's graph; None: all of it.

    Parameters
    ----------
    until : names of stages.
    only : names of files of a run, see :data:`rille.pipeline.export.catalogue.OUTPUTS`.

    Raises
    ------
    ConfigError
        There is no such stage, or no such file; both were given.
    """
    if until and only:
        raise ConfigError("RIL-034", "--until and --only are both given", remedy="give one of them")
    stages = set(config.stages(*config.RECONSTRUCTION))
    refuse_unknown("--until", until, stages, "stage")
    files = {output.name: output for output in catalogue.OUTPUTS}
    refuse_unknown("--only", only, files, "file")
    for name in sorted(catalogue.RENDERED.intersection(only)):
        text = f"--only {name}: each run writes that, of what it has made"
        raise ConfigError("RIL-036", text, remedy="name the files to be made, or leave --only out")
    wanted = {*until, "output"}
    if until:
        return Cut(frozenset(until), lambda h: h.stage in wanted or h.label.partition("/")[0] in wanted)
    if not only:
        return None
    read = {str(name).removeprefix("products.") for file in only for name in files[file].names}
    behind = {MADE_BY.get(name, name) for name in read} & stages or {"trajectory"}
    return Cut(frozenset(behind), lambda h: h.label.partition("/")[0] in wanted)
