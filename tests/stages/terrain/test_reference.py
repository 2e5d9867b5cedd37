from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from rille.stages.geometry.geometry import RigidTransform
from rille.stages.geometry.pose_arrays import GROUND_PLANE
from rille.stages.terrain.reference import MIN_REACH_HEIGHTS, MIN_REFERENCE_SHARE, judge

WALL = {"no_ground": "a wall", "plane": None, "ground_share": 0.0}
OTHER = {**WALL, "other_up": [0.8, -0.6, 0.0]}


def ground(share: float = 0.2, reach: float = 3.0, height: float = 1.6, roll: float = 0.0, **facts: Any) -> Any:
    """Facts of a pair whose plane may be ground by its attitude."""
    c, s = math.cos(math.radians(roll)), math.sin(math.radians(roll))
    T = RigidTransform([[c, s, 0], [0, 0, 1], [s, -c, 0]], [0.0, 0.0, 0.0]).to_list()
    known = {"T_local_left": T, "source": GROUND_PLANE, "plane": [0.0, 0.0, -height]}
    return {**known, "ground_share": share, "ground_reach": reach, **facts}


@pytest.mark.parametrize(
    ("levels", "shown"),
    [
        ([], False),
        ([WALL, WALL], False),
        ([ground()], False),  # a floor under shelves
        ([ground(), WALL, WALL], False),
        ([ground(MIN_REFERENCE_SHARE)], True),
        ([ground(reach=MIN_REACH_HEIGHTS)], True),  # a street between walls
        ([ground(0.0)], True),  # stated
        ([ground(source="attitude")], True),
        ([ground(source="pitch", plane=[math.tan(math.radians(11.0)), 0.0, -1.0])], False),
        ([ground(), ground(height=1.5, roll=5.0)], True),  # of one vehicle
        ([ground(), ground(height=1.0)], False),
        ([ground(), ground(roll=15.0)], False),
        ([ground(MIN_REFERENCE_SHARE), WALL, WALL], True),
        ([ground(MIN_REFERENCE_SHARE), OTHER], False),
        ([ground(MIN_REFERENCE_SHARE), ground(MIN_REFERENCE_SHARE), OTHER], True),
    ],
)
def test_ground_is_what_pairs_show_with_evidence(levels: list[Any], shown: bool) -> None:
    assert judge(levels, coarse=False).ground == shown


def test_ground_too_far_for_the_rig_counts_where_a_cell_size_is_stated() -> None:
    far = ground(MIN_REFERENCE_SHARE, no_ground="too coarse")
    assert [judge([far], coarse=coarse).ground for coarse in (False, True)] == [False, True]
    assert "40% of the matched pixels: too coarse" in judge([far, WALL], coarse=False).why


def test_the_reason_holds_the_figures() -> None:
    why = judge([ground(0.29, 3.2), OTHER], coarse=False).why
    figures = "0 of 2", "1 another plane", "29%", "3.2 camera heights", "40%", "[0.80, -0.60, 0.00]"
    assert [part for part in figures if part not in why] == []


def test_ground_that_may_not_be_seen_is_named_beside_another_plane() -> None:
    unseen, seen = ({**OTHER, "matched_below": share} for share in (0.06, 0.9))
    assert (
        "; of 1 of the pairs less than half of the lowest quarter of the left image is matched (at least 6%)"
        in judge([unseen, seen], coarse=False).why
    )
    assert "lowest quarter" not in judge([seen, seen], coarse=False).why


def test_a_camera_that_rolls_needs_an_attitude() -> None:
    rolled = [{**WALL, "other_up": [-math.sin(a), -math.cos(a), 0.0]} for a in np.radians([60.0, 75.0])]
    alike, differ = (judge(levels, coarse=False).why for levels in (rolled[:1] * 2, rolled))
    assert "world.up in a manifest" in alike
    assert "[attitude]" in differ
