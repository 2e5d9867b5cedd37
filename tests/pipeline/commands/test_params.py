"""The reference of parameters: the page in the documentation is the one that the command prints."""

from __future__ import annotations

from pathlib import Path

import pytest
from raising import raises

from rille.datasets.text.validation import known_keys
from rille.pipeline.commands import params
from rille.pipeline.flow import config

PAGE = Path(__file__).resolve().parents[3] / "docs" / "parameters.md"


def test_the_page_in_the_documentation_is_current(capsys: pytest.CaptureFixture[str]) -> None:
    params.params(markdown=True)
    assert PAGE.read_text(encoding="utf-8") == capsys.readouterr().out, "make pages"


def test_every_section_and_key_of_the_configuration_is_there() -> None:
    keys = {f"{name}.{row[0]}" for name, values in params.sections().items() for row in params.rows(values)}
    assert {key for key in known_keys(config.model()) if "." in key} <= keys


def test_choices_and_bounds_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    params.params("hfvm")
    told = capsys.readouterr().out
    assert 'hfvm.preset = "default"    [\'' in told
    assert "merge." not in told
    with raises("RIL-035", "'nope'"):
        params.params("nope")
    with raises("RIL-035", "did you mean locus"):
        params.params("locs")
