"""What follows a leg, and what is remembered for the next one."""

from __future__ import annotations

import pytest

from rille.stages.planning.local_planner.look import PlannerMemory

HERE, THERE = (0.1, 0.2, 0.5), (0.3, 0.9)


def test_looks_count_until_a_leg_is_driven() -> None:
    memory = PlannerMemory()
    looks = []
    for verdict in ("look", "turn", "look", "drive", "look"):
        assert memory.after(verdict, HERE) == "drive"
        looks.append(memory.looks)
    assert looks == [1, 1, 2, 0, 1]


def test_from_where_it_looked_is_remembered_once() -> None:
    memory = PlannerMemory()
    memory.after("closed", HERE, THERE)
    memory.after("look", HERE)
    memory.after("drive", (0.2, 0.3, 0.0))
    assert memory.stands == [HERE, (0.2, 0.3, 0.0)]


def test_what_is_closed_is_tried_once_more_as_the_last_way() -> None:
    memory = PlannerMemory(looks=3)
    assert memory.after("closed", HERE, THERE) == "again"
    assert (memory.closed, memory.looks) == ([THERE], 0)
    assert memory.after("no path", HERE) == "again"
    assert memory.closed == []
    assert memory.after("closed", HERE, THERE) == "again"
    assert memory.after("no path", HERE) == "end"


@pytest.mark.parametrize("verdict", ["goal", "no path"])
def test_it_ends_at_the_goal_or_where_nothing_is_closed(verdict: str) -> None:
    assert PlannerMemory().after(verdict, HERE) == "end"


def test_a_closed_leg_without_a_place_is_refused() -> None:
    with pytest.raises(ValueError, match="where"):
        PlannerMemory().after("closed", HERE)
