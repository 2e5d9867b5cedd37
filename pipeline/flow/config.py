"""Configuration: one section a stage, layered, strictly validated, and written back with every default filled.

Layers, later ones win: defaults of the code, what suits the sequence (``Sequence.defaults``), ``--config FILE.toml``,
``--set section.key=value``. The sections and their fields are the parameter models of the stages themselves.
"""

from __future__ import annotations

import importlib
import pkgutil
import tomllib
from collections.abc import Iterable, Mapping
from functools import cache
from types import ModuleType
from typing import Any, Literal

import numpy as np
import tomli_w
from pydantic import create_model

from rille.datasets.protocol import Sequence
from rille.datasets.text.validation import Model, validated
from rille.stages.core.declare import Params, Stage, declared
from rille.stages.core.errors import ConfigError

PRESETS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    # So many points because models that are half as wrong show half as small an error of the poses that merge them.
    (
        "terrain",
        "accurate",
        {
            "hfvm": {"preset": "accurate"},
            "locus": {"both": True},
            "track": {"points": 2000},
            "merge": {"max_std_cells": 0.7},
        },
    ),
    # Three steps leave more of its larger errors: after six, elevations of three beds err by .82 to .87 times as much.
    ("hfvm", "fast", {"locus": {"refine_steps": 6}}),
    # Half the resolution of disparities and displacements is enough for a trajectory.
    (
        "keyframes",
        "navigation",
        {
            "hfvm": {"preset": "fast"},
            "motion": {"level": 3},
            "track": {"points": 200},
            "orientation": {"samples": 600},
        },
    ),
)
"""Presets of a section, and what each sets in other sections, beneath the values that are given there."""


class TerrainParams(Params):
    """One choice for all stages that make elevations.

    Attributes
    ----------
    preset : accurate: sets hfvm.preset accurate, locus.both, track.points 2000 and merge.max_std_cells 0.7; errors are
        about two fifths smaller, matching takes many times as long; keys set explicitly win.
    reference : what elevations are measured from: ground; scene: the plane that most of the scene lies on; or the plane
        with a normal x, y, z through a point x, y, z [m] of the left camera's frame (x right, y down, z ahead); not
        set: the ground, or the scene's plane where too little speaks for ground.
    """

    preset: Literal["default", "accurate"] = "default"
    reference: Literal["ground", "scene"] | tuple[float, float, float, float, float, float] | None = None


DATASET_SECTIONS = ("mockup", "misalign", "rover")
"""Sections that belong to a kind of sequence; the sequence validates them."""


RECONSTRUCTION = ("builders", "reconstruction", "selection", "world", "assessment")
DRIVE = ("builders", "closed_loop")
"""Modules of this folder that lay out the tasks of each kind of run."""


@cache
def stages(*flows: str) -> dict[str, Stage]:
    """The stages that modules of flows import (all by default), by name.

    Each stage with parameters has a section.
    """
    every = dict.fromkeys((*RECONSTRUCTION, *DRIVE))
    found = [vars(importlib.import_module(f"rille.pipeline.flow.{flow}")).values() for flow in flows or every]
    used = [value for values in found for value in values]
    listed = [v if isinstance(v, Stage) else declared(v) for v in used if isinstance(v, Stage | ModuleType)]
    return {stage.name: stage for stage in listed if stage is not None}


def stage_names() -> set[str]:
    """Names of all stages, of those that make or read images, too."""
    from rille import datasets, stages

    modules = [
        importlib.import_module(found.name)
        for package in (stages, datasets)
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    ]
    return {stage.name for stage in map(declared, modules) if stage is not None}


@cache
def model() -> type[Params]:
    """Model of the whole configuration, made of the stages' own parameter models."""
    from rille.pipeline.flow.closed_loop import DriveParams
    from rille.pipeline.flow.tiles import Tiling
    from rille.stages.hazard.vehicle import DEFAULT_VEHICLE, Vehicle

    fields: dict[str, Any] = {
        name: (stage.params, stage.params()) for name, stage in stages().items() if stage.params.model_fields
    }
    fields["terrain"] = (TerrainParams, TerrainParams())
    fields["tiling"] = (Tiling, Tiling())
    fields["drive"] = (DriveParams, DriveParams())
    fields["vehicle"] = (Vehicle, DEFAULT_VEHICLE)
    return create_model("Config", __base__=Params, **fields)


def parse_assignments(assignments: Iterable[str]) -> dict[str, Any]:
    """``["locus.cell_size=0.002", ...]`` to a nested mapping; values are TOML, bare words are text.

    Raises
    ------
    ConfigError
        There is no ``=``, or no dot in the key.
    """
    nested: dict[str, Any] = {}
    for text in assignments:
        key, sep, value = text.partition("=")
        key = key.strip()
        if not sep or "." not in key:
            raise ConfigError(
                "RIL-024", f"--set {text!r} is not section.key=value", remedy="write e.g. --set locus.cell_size=0.002"
            )
        merge(nested, expand({key: _toml_value(value.strip())}))
    return nested


def _toml_value(text: str) -> Any:
    try:
        return tomllib.loads(f"v = {text}")["v"]
    except (ValueError, RecursionError):  # also numbers of thousands of digits
        return text


def expand(dotted: Mapping[str, Any]) -> dict[str, Any]:
    """``{"a.b": 1}`` to ``{"a": {"b": 1}}``."""
    nested: dict[str, Any] = {}
    for key, value in dotted.items():
        for part in reversed(key.split(".")):
            value = {part: value}
        merge(nested, value)
    return nested


def merge(into: dict[str, Any], layer: Mapping[str, Any], within: str = "") -> dict[str, Any]:
    """Lay a nested mapping over another one, in place.

    Raises
    ------
    ConfigError
        A key is a value in one and a section in the other.
    """
    for key, value in layer.items():
        if key in into and isinstance(value, Mapping) is not isinstance(into[key], Mapping):
            single = into[key] if isinstance(value, Mapping) else value
            raise ConfigError("RIL-721", f"{within}{key} is a section and has a value", remedy=f"leave {single!r} out")
        if isinstance(value, Mapping) and isinstance(into.get(key), dict):
            merge(into[key], value, f"{within}{key}.")
        else:
            into[key] = merge({}, value) if isinstance(value, Mapping) else _plain(value)
    return into


def _plain(value: Any) -> Any:
    """A value as Python has it, where it is NumPy's, as those of sweeps are."""
    if isinstance(value, np.ndarray):
        value = list(value) if value.ndim else value[()]
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.floating):
        # By its own digits: .002 of single precision is .002, not .0020000000949949026.
        return float(str(value))
    return value.item() if isinstance(value, np.generic) else value


def refuse_other_sections(given: Iterable[str], own: tuple[str, ...], command: str) -> None:
    """Refuse sections that a command does not read.

    Raises
    ------
    ConfigError
        One of those ``given`` is none of its ``own``.
    """
    for section in given:
        if section not in own:
            text = f"--set {section}: {command} reads {', '.join(own)} alone"
            raise ConfigError("RIL-046", text, remedy=f"write --set {own[0]}.key=value")


def split_dataset(layers: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Part the sections of sequences from those of stages: ``(dataset sections, stage sections)``."""
    ours = {k: v for k, v in layers.items() if k in DATASET_SECTIONS}
    return ours, {k: v for k, v in layers.items() if k not in DATASET_SECTIONS}


def build(*layers: Mapping[str, Any]) -> Params:
    """Validated configuration of nested layers, later ones winning.

    Raises
    ------
    ConfigError
        A key is unknown or a value not permitted; the message has the dotted key, the value and what is permitted.
    """
    nested: dict[str, Any] = {}
    for layer in layers:
        merge(nested, layer)
    for section, preset, values in PRESETS:
        given = nested.get(section)
        if isinstance(given, Mapping) and given.get("preset") == preset:
            nested = merge(merge({}, values), nested)
    return validate(model(), nested, also=DATASET_SECTIONS)


def suited(sequence: Sequence) -> dict[str, Any]:
    """Parameters that suit a sequence, by section: its vehicle's limits, and defaults that it states."""
    vehicle = {} if sequence.vehicle is None else {"vehicle": sequence.vehicle.model_dump(mode="json")}
    return merge(vehicle, expand(sequence.defaults))


def validate(kind: type[Model], values: Mapping[str, Any], section: str = "", also: Iterable[str] = ()) -> Model:
    """``kind(**values)`` of a section, or of the whole configuration."""
    return validated("RIL-027", kind, values, section=section, also=also)


def to_toml(config: Params, extra: Mapping[str, Params] | None = None) -> str:
    """Configuration as TOML with every default filled and each key explained; it can be given back by ``--config``."""
    sections = {name: getattr(config, name) for name in type(config).model_fields} | dict(extra or {})
    return "\n".join(_section(name, values) for name, values in sections.items())


def _section(name: str, values: Params) -> str:
    lines, meanings = [f"[{name}]"], values.meanings()
    for key, value in values.model_dump(mode="json").items():
        lines += [f"# {meanings[key]}"] if key in meanings else []
        lines.append(f"# {key} is not set" if value is None else tomli_w.dumps({key: value}).strip())
    return "\n".join(lines) + "\n"
