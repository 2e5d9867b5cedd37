"""The drawing of a graph, by stage and by task."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from raising import raises

from rille.pipeline.commands import graph
from rille.pipeline.runs.session import Options


@pytest.mark.parametrize("tasks", [False, True])
def test_every_task_is_in_the_drawing(tmp_path: Path, tasks: bool, capsys: pytest.CaptureFixture[str]) -> None:
    options = Options("mockup-short", ("mockup.frames=3",), cache=tmp_path / "cache")
    assert graph.graph(options, tmp_path / "graph.svg", tasks=tasks) == 0
    count = int(capsys.readouterr().out.split()[1])
    words = [e.text or "" for e in ET.parse(tmp_path / "graph.svg").iter() if e.tag.endswith("text")]
    assert sum(int(w.partition(" x ")[2] or 1) for w in words) == count
    assert graph.graph(options, tmp_path / "graph.dot", tasks=tasks) == 0
    text = (tmp_path / "graph.dot").read_text()
    assert ('"mockup.render" -> "pyramid"' in text) != tasks
    assert text.count("label=") == len(words)


def test_every_arrow_is_looked_at_a_few_times_only() -> None:
    """Of a long sequence there are hundreds of thousands."""

    class Counted(Counter[tuple[str, str]]):
        turns = 0

        def __iter__(self) -> Iterator[tuple[str, str]]:
            self.turns += 1
            return super().__iter__()

    edges = Counted((str(k), str(k + 1)) for k in range(50))
    assert graph.svg(Counter(map(str, range(51))), edges).count("<path") == 50
    assert edges.turns < 5


def test_other_names_are_refused(tmp_path: Path) -> None:
    with raises("RIL-871", "graph.png"):
        graph.graph(Options("mockup-short"), tmp_path / "graph.png")
