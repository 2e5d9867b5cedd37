"""Parameters that were set and that no task reads: each is an error, raised as early as it is known.

A parameter counts as set if it is in force with another value than it would have without ``--set`` and ``--config``:
the ``config.toml`` of a run, which holds all parameters, can be given back. It is read if a task of the run has its
section for parameters or arguments. Parameters of a section that the user has switched off
(``crosscheck.enabled=false``) are permitted. A section that is off by default reads nothing, and the remedy says how to
switch it on.

Sections that no task of such a run can read (of a drive those of a reconstruction, and the other way round) are known
before anything is computed. The others are known once all tasks are laid out: then the run ends with its results, the
line that names the parameter, and the exit code of a run with holes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from functools import cache
from operator import attrgetter
from typing import Any

from rille.pipeline.engine.graph import Graph
from rille.pipeline.flow.config import DRIVE, RECONSTRUCTION, stages
from rille.stages.core.declare import Params
from rille.stages.core.errors import ConfigError

CHECKED = frozenset(("undistort", "pyramid", "motion", "hfvm", "tiling", "orientation", "frame_screening"))
"""Sections that ``rille check`` reads."""


@cache
def foreign(*, driven: bool) -> frozenset[str]:
    """Sections that only the other kind of run has: of a drive those of a reconstruction, and the other way round."""
    drives = {"drive", *stages(*DRIVE)} - {"undistort"}
    reconstructions = {*stages(*RECONSTRUCTION)}
    return frozenset(reconstructions - drives if driven else drives - reconstructions)


def set_by_user(given: Mapping[str, Any], config: Params, without: Params) -> tuple[str, ...]:
    """Dotted keys of ``given`` that a task must read; ``without`` is the configuration as it would be without them."""
    found = []
    for section, values in given.items():
        now, then = getattr(config, section), getattr(without, section)
        # Switched off by the user himself: then what else stands in that section is no mistake.
        off = not getattr(now, "enabled", True) and getattr(then, "enabled", False)
        for name in values if not off else ():
            key = f"{section}.{name}"
            # Parameters that the configuration itself reads: they set others
            if getattr(now, name) != getattr(then, name) and key not in ("terrain.preset", "keyframes.preset"):
                found.append(key)
    return tuple(found)


def refuse(keys: Iterable[str], config: Params, nobody: Collection[str], who: str) -> None:
    """Refuse parameters that the user has set and that no task can read.

    Parameters
    ----------
    keys : dotted keys of the parameters set, see :func:`set_by_user`.
    nobody : sections, and dotted keys, that no task reads.
    who : in words, the run or command that does not read them.

    Raises
    ------
    ConfigError
        No task reads one of the keys.
    """
    if lost := [key for key in keys if key in nobody or key.partition(".")[0] in nobody]:
        raise ConfigError("RIL-730", f"{_values(lost, config)}: no task of {who} reads it", remedy="leave it out")


def unread(keys: Iterable[str], config: Params, graph: Graph) -> list[str]:
    """Those of the keys that no task of a complete graph reads."""
    kinds = {type(h.spec.params) for h in graph.nodes}
    read = {name for name in type(config).model_fields if type(getattr(config, name)) in kinds}
    # Sections that reach stages as arguments, not as their parameters: the flow, and the vehicle.
    read |= {"drive", "terrain"} | {name for h in graph.nodes for name in h.spec.args if name == "vehicle"}
    read |= {"tiling"} if "hfvm" in read else set()
    return [key for key in keys if key.partition(".")[0] not in read]


def error(lost: Iterable[str], config: Params) -> ConfigError:
    """The error of parameters that no task of a run reads."""
    sections = [key.partition(".")[0] for key in lost]
    off = [s for s in sections if not getattr(getattr(config, s), "enabled", True)]
    remedy = f"set {off[0]}.enabled=true, or leave it out" if off else "leave it out, or choose frames that need it"
    return ConfigError("RIL-732", f"{_values(lost, config)}: no task of this run reads it", remedy=remedy)


def _values(keys: Iterable[str], config: Params) -> str:
    """``track.points = 300, merge.alike = 0.5``."""
    return ", ".join(f"{key} = {attrgetter(key)(config)}" for key in keys)
