"""The benchmark of scale at its smallest: every node is computed, then found, and no folder fills up."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from benchmarks import scale


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
