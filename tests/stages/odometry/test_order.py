"""Frames that stand in another order than they were taken are told, and no drive is taken for such."""

from __future__ import annotations

import numpy as np
import pytest

from rille.stages.odometry.order import without_jumps


def drive(count: int, seed: int = 0, turn: float = 0.1) -> np.ndarray:
    """Places of a drive of uneven steps of some 1 m."""
    rng = np.random.default_rng(seed)
    heading, step = np.cumsum(rng.normal(0, turn, count)), rng.uniform(0.7, 1.4, count)
    return np.cumsum(np.stack([step * np.cos(heading), step * np.sin(heading), np.zeros(count)], 1), 0)


def test_a_run_in_reverse_is_told():
    order = [*range(8), *range(13, 7, -1), *range(14, 20)]
    assert without_jumps(drive(20)[order]) == [(0, 7), (13, 8), (14, 19)]


def test_names_that_were_sorted_as_text_are_told():
    """1, 10, 11, 12, 13, 14, 2, 3 ..."""
    order = [k - 1 for k in sorted(range(1, 15), key=str)]
    assert without_jumps(drive(14)[order]) == [(0, 0), (6, 13), (1, 5)]


@pytest.mark.parametrize("seed", range(10))
def test_a_drive_with_gaps_rests_and_a_way_back_is_in_order(seed):
    places = drive(60, seed)
    assert without_jumps(places) == []
    assert without_jumps(np.delete(places, [*range(10, 15), *range(30, 36)], axis=0)) == []
    rests = np.repeat(places, np.where(np.arange(60) % 9, 1, 5), axis=0)
    assert without_jumps(rests) == []
    assert without_jumps(np.concatenate([places, places[::-1] + 0.3])) == []


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_few_or_unmoved_frames_have_no_order(count):
    assert without_jumps(np.zeros((count, 3))) == without_jumps(drive(count)) == []
