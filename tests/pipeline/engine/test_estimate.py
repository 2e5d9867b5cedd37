"""The time left: tasks to come, by this run's means and by those of the run before."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from rille.pipeline.engine import estimate
from rille.pipeline.engine.estimate import TimeEstimate

EARLIER = {"image": (0.5, 0.1), "match": (0.5, 1.0), "map": (0.25, 2.0)}
OPENED = ["image"] * 4 + ["match"] * 4


def end(run: TimeEstimate, stage: str, seconds: float, status: str = "computed", compiling: float = 0.0) -> None:
    handle: Any = SimpleNamespace(
        stage=stage, status=status, took=SimpleNamespace(seconds=seconds, compiling=compiling)
    )
    run.end(handle)


def test_nothing_is_said_before_anything_was_computed_or_where_nothing_is_known() -> None:
    run = TimeEstimate(OPENED, EARLIER, 1)
    end(run, "image", 0.0, status="cached")
    assert run.left() is None
    first = TimeEstimate(OPENED, {}, 1)
    end(first, "image", 1.0)
    assert first.left() is None


@pytest.mark.parametrize("jobs", [1, 2])
def test_stages_that_have_run_count_by_their_own_means_the_others_by_the_earlier_ones(jobs: int) -> None:
    run = TimeEstimate(OPENED, EARLIER, jobs)
    end(run, "image", 8.3, compiling=8.0)
    assert run.left() == pytest.approx((3 * 0.3 + 4 * 1.0 + 2 * 2.0) / jobs)
    for _ in range(3):
        run.added("map")
    assert run.left() == pytest.approx((3 * 0.3 + 4 * 1.0 + 3 * 2.0) / jobs)


def test_the_next_run_starts_from_what_this_one_took(tmp_path: Any) -> None:
    run = TimeEstimate(["image", "image"], {"map": (1.0, 5.0)}, 1)
    estimate.remember(tmp_path, run)
    assert estimate.recall(tmp_path) == {}, "nothing was computed"
    end(run, "image", 0.5)
    run.added("map")
    estimate.remember(tmp_path, run)
    assert estimate.recall(tmp_path) == {"image": (1.0, 0.5), "map": (0.5, 5.0)}


@pytest.mark.parametrize("damaged", ["", "[1]", '{"map": [1]}', '{"map": ["a", 1]}'])
def test_a_damaged_file_counts_as_none(tmp_path: Any, damaged: str) -> None:
    (tmp_path / estimate.FILE).write_text(damaged)
    assert estimate.recall(tmp_path) == {}
