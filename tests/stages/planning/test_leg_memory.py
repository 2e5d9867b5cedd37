"""What follows a leg, and what is remembered for the next one."""

from __future__ import annotations

import pytest

from rille.stages.planning.local_planner.look import PlannerMemory

THERE = (0.3, 0.9)


def test_looks_count_until_a_leg_is_driven() -> None:
    memory = PlannerMemory()
    looks = []
    for verdict in ("look", "turn", "look", "drive", "look"):
        assert memory.after(verdict) == "drive"
        looks.append(memory.looks)
    assert looks == [1, 1, 2, 0, 1]


def test_what_is_closed_is_tried_once_more_as_the_last_way() -> None:
    memory = PlannerMemory(looks=3)
    assert memory.after("closed", THERE) == "again"
    assert (memory.closed, memory.looks) == ([THERE], 0)
    assert memory.after("no path") == "again"
    assert memory.closed == []
    assert memory.after("closed", THERE) == "again"
    assert memory.after("no path") == "end"


@pytest.mark.parametrize("verdict", ["goal", "no path"])
def test_it_ends_at_the_goal_or_where_nothing_is_closed(verdict: str) -> None:
    assert PlannerMemory().after(verdict) == "end"


def test_a_closed_leg_without_a_place_is_refused() -> None:
    with pytest.raises(ValueError, match="where"):
        PlannerMemory().after("closed")
