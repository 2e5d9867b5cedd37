"""Fixtures of the sequence tests: sources run without an engine, and a bed small enough for a fraction of a second."""

from __future__ import annotations

import importlib
import json

import pytest

from rille.datasets.mockup.params import MockupParams
from rille.datasets.protocol import Source
from rille.stages.core.declare import Bundle, check_outputs, declared

TINY = {
    "frames": 3,
    "bed_width": 0.9,
    "bed_length": 0.8,
    "cell": 0.002,
    "image_width": 96,
    "image_height": 80,
    "focal_length": 100.0,
}


class Materialiser:
    """Runs sources and keeps what they gave, as an engine would; arguments pass through JSON on the way."""

    def __init__(self) -> None:
        self.kept: dict[str, Bundle] = {}

    def __call__(self, source: Source) -> Bundle:
        args = json.loads(json.dumps(dict(source.args)))
        key = f"{source.module} {source.params!r} {json.dumps(args, sort_keys=True)} {sorted(source.inputs)}"
        if key not in self.kept:
            stage = declared(importlib.import_module(source.module))
            inputs = {port: self(upstream) for port, upstream in source.inputs.items()}
            bundle = stage.run(source.params, args | dict(source.hints), inputs)
            check_outputs(stage, bundle)
            json.dumps(bundle.meta, allow_nan=False)
            self.kept[key] = bundle
        return self.kept[key]


@pytest.fixture(scope="session")
def materialise() -> Materialiser:
    return Materialiser()


@pytest.fixture(scope="session")
def tiny() -> MockupParams:
    return MockupParams(**TINY)
