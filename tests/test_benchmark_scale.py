"""The benchmark of scale at its smallest: every node is computed, then found, and no folder fills up."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks import scale
from rille.pipeline.engine.graph import Took
from rille.pipeline.engine.store.manifest import Ref
from rille.pipeline.engine.task import Outcome


def test_the_processor_time_of_a_task_is_told_as_that_of_its_stage() -> None:
    ref = Ref("0", "merge", "0", {})

    def ensure() -> Outcome:
        sum(k * k for k in range(100_000))
        return Outcome(ref, False, Took(seconds=9.0))

    told = scale._measured(ensure)()
    assert (told.ref, told.cached, told.took.seconds) == (ref, False, 9.0)
    assert 0 < told.took.kernel < 9


@pytest.mark.slow
def test_the_idle_sequence_is_computed_and_found_again(tmp_path: Path) -> None:
    how = ["--executor", "inline", "--jobs", "1"]
    lines = list(scale.figures(12, how, tmp_path, {scale.UNFLUSHED: "1"}))
    found = re.fullmatch(r"12 pairs, (\d+) nodes", lines[0])
    assert found, lines
    nodes = int(found[1])
    assert nodes > 12 * 12
    for what in ("overhead", "plan when all is cached", "run that computes nothing"):
        assert any(what in line for line in lines), lines
    assert scale.entries(tmp_path / "cache")[0] < nodes / 4
