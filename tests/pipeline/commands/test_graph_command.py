"""The stages of a run as text for Graphviz."""

from __future__ import annotations

from pathlib import Path

import pytest

from rille.pipeline.commands.computing.plan import graph
from rille.pipeline.runs.options import Settings


def test_every_stage_is_in_the_text(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = Settings(assignments=("mockup.frames=3",), cache=str(tmp_path / "cache"))
    graph("mockup-short", options=options)
    text = capsys.readouterr().out
    assert '  "mockup.render" [label="mockup.render x 6"];' in text
    assert '"mockup.render" -> "pyramid"' in text
    assert '  label="more tasks follow, known only after frame_screening";' in text
