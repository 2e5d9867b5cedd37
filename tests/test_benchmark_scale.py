"""The benchmark of scale at its smallest: every node is computed, then found, and no folder fills up."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import scale


@pytest.mark.slow
def test_the_idle_sequence_is_computed_and_found_again(tmp_path: Path) -> None:
    how = ["--executor", "inline", "--jobs", "1"]
    _, row = scale.table([12], how, tmp_path, flush=False)
    assert row.split()[0] == "12"
    nodes = int(row.split()[1])
    assert nodes > 12 * 12
    assert scale.entries(tmp_path / "12" / "cache")[0] < nodes / 4
