"""The graph of a run as text for Graphviz, by stage and by task."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from raising import raises

from rille.pipeline.commands import graph
from rille.pipeline.commands.options import Settings


@pytest.mark.parametrize("tasks", [False, True])
def test_every_task_is_in_the_text(tmp_path: Path, tasks: bool, capsys: pytest.CaptureFixture[str]) -> None:
    options = Settings(assignments=("mockup.frames=3",), cache=str(tmp_path / "cache"))
    assert graph.graph("mockup-short", options=options, tasks=tasks, output=tmp_path / "graph.dot") == 0
    count = int(capsys.readouterr().out.split()[1])
    assert graph.graph("mockup-short", options=options, tasks=tasks) == 0
    text = capsys.readouterr().out
    assert text == (tmp_path / "graph.dot").read_text()
    boxes = [line for line in text.splitlines() if line.startswith('  "') and "->" not in line]
    numbers = [re.search(r" x (\d+)\"]", line) for line in boxes]
    assert sum(1 if n is None else int(n[1]) for n in numbers) == count
    assert ('"mockup.render" -> "pyramid"' in text) != tasks


def test_other_names_are_refused(tmp_path: Path) -> None:
    with raises("RIL-871", "graph.png"):
        graph.graph("mockup-short", output=tmp_path / "graph.png")
