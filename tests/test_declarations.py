"""One contract for all stages: what they declare of themselves."""

from __future__ import annotations

import importlib
import inspect

import numpy as np
import pytest

from rille.pipeline.flow.config import stages
from rille.stages.core.declare import Params, declared

UNITS = {"1", "px", "m", "rad", "grey", "m^2, m rad, rad^2", "m, rad", "m/px"}
DATASET_STAGES = ("images.files", "mockup.scene", "mockup.render", "mockup.truth", "mockup.truth_dem")
DRIVE_STAGES = ("mockup.rover", "mockup.sense", "mockup.obstacle", "mockup.overview")
TILE_STAGES = ("tiles.tile_stage", "tiles.join_stage")
DECLARED = (
    stages()
    | {name: declared(importlib.import_module(f"rille.stages.hfvm.{name}")) for name in TILE_STAGES}
    | {name: declared(importlib.import_module(f"rille.datasets.{name}")) for name in (*DATASET_STAGES, *DRIVE_STAGES)}
)


@pytest.mark.parametrize("name", DECLARED)
def test_declaration(name: str) -> None:
    s = DECLARED[name]
    assert name not in stages() or s.name == name
    assert s.summary
    assert len(set(s.inputs)) == len(s.inputs)


@pytest.mark.parametrize("name", DECLARED)
def test_every_parameter_is_explained_and_has_a_default(name: str) -> None:
    for key, field in DECLARED[name].params.model_fields.items():
        assert DECLARED[name].params.meanings().get(key), f"{name}.{key} is not explained"
        assert not field.is_required(), f"{name}.{key} has no default"
    DECLARED[name].params()


@pytest.mark.parametrize("name", stages())
def test_an_argument_that_may_be_absent_has_a_default(name: str) -> None:
    """The dataflow leaves out an argument that is None."""
    for parameter in inspect.signature(DECLARED[name].function or DECLARED[name].run).parameters.values():
        absent = str(parameter.annotation).endswith("| None")
        assert not absent or parameter.default is None, f"{name}: {parameter.name} has no default"


class Short(Params):
    """A model.

    Attributes
    ----------
    most : greatest [m]; here : no entry.
    least : least
        of all.
    """

    most: float = 1.0
    least: float = 0.0


class Long(Short):
    """Another one, which means something else by one of them.

    Attributes
    ----------
    least : zero.
    """


def test_parameters_mean_what_the_docstrings_say() -> None:
    assert Short.meanings() == {"most": "greatest [m]; here : no entry.", "least": "least of all."}
    assert Long.meanings() == {"most": "greatest [m]; here : no entry.", "least": "zero."}


@pytest.mark.parametrize("name", DECLARED)
def test_every_array_has_dims_type_and_unit(name: str) -> None:
    for array in DECLARED[name].outputs:
        assert array.long_name, f"{name}.{array.name}"
        assert array.unit in UNITS, f"{name}.{array.name}: unit {array.unit!r}"
        kind = np.dtype(array.dtype).kind
        assert kind in "fui"
        assert kind != "f" or array.nodata in {"nan", ""}
