"""What a set of drives says of its ways, by hand."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.driving.ratios import HEADINGS, Ratios, share, wilson
from rille.stages.planning.wheels import HeightGrid

WAYS = [(1.0, 1.0), (3.0, 2.0), (2.3, 2.0), (0.9, 1.0)]


def test_together_the_long_ways_count_more():
    assert Ratios(WAYS).together() == pytest.approx(7.2 / 6.0)
    assert Ratios(WAYS).each() == pytest.approx([0.9, 1.0, 1.15, 1.5])


def test_a_way_of_just_the_limit_is_within():
    assert Ratios([(1.15, 1.0), (1.1501, 1.0)]).within() == 1


def test_resampled_sets_lie_about_all_together_and_are_drawn_the_same_each_time():
    low, high = Ratios(WAYS).interval()
    assert 0.9 < low < Ratios(WAYS).together() < high < 1.5
    assert (low, high) == Ratios(WAYS).interval()
    assert Ratios([(2.0, 1.0)] * 5).interval() == (2.0, 2.0)


def test_more_drives_make_a_narrower_interval():
    few, many = (Ratios(WAYS * n).interval() for n in (1, 25))
    assert many[1] - many[0] < 0.5 * (few[1] - few[0])


def test_a_cell_for_each_heading():
    cells = Ratios(WAYS).cells()
    assert len(cells) == len(HEADINGS) == len(Ratios([]).cells())
    assert cells[0].startswith("1.20 (")
    assert cells[1] == "1.07, 1.50"
    assert cells[2].startswith("3: 75 % (")


def test_shares_have_the_interval_of_wilson():
    # 10 of 10: 1 / (1 + z^2 / n)
    assert wilson(10, 10) == pytest.approx((10 / (10 + 1.959964**2), 1.0))
    assert wilson(5, 10) == pytest.approx((0.2366, 0.7634), abs=1e-4)
    assert share(37, 37) == "100 % (91-100)"
    assert share(0, 0) == "-"
    assert all(map(math.isnan, wilson(0, 0)))


def test_by_the_limits_alone_the_way_is_straight_where_nothing_stands_in_it(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "benchmarks")
    from driving.beds import config_of, prepared
    from driving.exact_bed import ExactBed
    from driving.limits import shortest_within_limits

    plain = [
        "mockup.rocks=0.0",
        "mockup.craters=0.0",
        "mockup.cell=0.004",
        "mockup.relief=0.0",
        "mockup.bed_length=1.2",
    ]
    sequence, layers = prepared(plain)
    config, goal = config_of(layers), (0.0, 0.5)
    bed = ExactBed.of(sequence, config, goal)
    (x, y), _ = bed.start()
    found = shortest_within_limits(bed, goal, config.local_planner)
    reach = (
        0.5 * config.local_planner.tolerance * config.vehicle.wheel_base
    )  # it has arrived this near, on a grid of 7.5 mm
    assert found == pytest.approx(math.hypot(goal[0] - x, goal[1] - y) - reach, abs=0.01)
    wall = bed.ground.height.copy()
    wall[120:125] += 0.05
    walled = replace(bed, ground=HeightGrid.of(wall, bed.ground.x0, bed.ground.y0, bed.ground.cell, 0.03))
    assert shortest_within_limits(walled, goal, config.local_planner) is None
