"""Arithmetic of long sequences: which limit is met first."""

from benchmarks.cluster import Measured, rows


def met(frames, workers=64, task=0.25):
    return dict(rows(frames, workers, task, Measured()))["limits met"]


def test_limits_are_met_one_after_the_other():
    assert met(2_000) == "none"
    assert met(18_000) == "none"
    assert met(19_000).startswith("the index")
    assert "the client holds" not in met(79_000)
    assert "the client holds" in met(82_000)
    assert "one task" in met(41_000)


def test_short_tasks_leave_the_scheduler_behind():
    assert "scheduler" in met(2_000, workers=300)
    assert met(2_000, workers=200, task=1.0) == "none"
