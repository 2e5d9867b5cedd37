"""A way as straight pieces: shortened where it is clear, cut by length and by turn."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from rille.stages.planning.local_planner.route import (
    Piece,
    length_of,
    pieces,
    split,
    straightened,
    through,
    turnable,
    vertices,
    within_turn,
)  # fmt: skip
from rille.stages.planning.local_planner.state_lattice import (
    AHEAD,
    BACK,
    HEADING_STEPS,
    TO_LEFT,
    TO_RIGHT,
    LatticeGraph,
    PoseGrid,
)

STAIRS = [
    Piece((0.0, 0.0), (0.0, 0.1), 0.0, 1),
    Piece((0.0, 0.1), (0.1, 0.1), -math.pi / 2, 1),
    Piece((0.1, 0.1), (0.1, 0.2), 0.0, 1),
]


def everywhere(x: np.ndarray, y: np.ndarray, heading: np.ndarray) -> bool:
    return True


def test_where_all_is_clear_one_piece_is_left() -> None:
    (line,) = straightened(STAIRS, 0.0, everywhere, 0.01)
    assert (line.a, line.b) == ((0.0, 0.0), (0.1, 0.2))
    assert line.heading == pytest.approx(-math.atan2(0.1, 0.2))
    assert line.length == pytest.approx(math.hypot(0.1, 0.2))


def test_a_corner_that_is_not_clear_stays() -> None:
    def beside(x: np.ndarray, y: np.ndarray, heading: np.ndarray) -> bool:
        return not bool(((x > 0.011) & (y < 0.09)).any())

    way = straightened(STAIRS, 0.0, beside, 0.01)
    assert vertices(way, (0.0, 0.0)).tolist() == [[0.0, 0.0], [0.0, 0.1], [0.1, 0.2]]


def test_a_line_whose_turn_is_not_clear_is_not_taken() -> None:
    asked: list[float] = []

    def little(x: np.ndarray, y: np.ndarray, heading: np.ndarray) -> bool:
        asked.append(float(np.ptp(heading)))
        return float(np.ptp(heading)) < math.radians(20)

    way = straightened(STAIRS, 0.0, little, 0.01)
    assert [piece.b for piece in way] == [piece.b for piece in STAIRS]  # as given: the graph has looked at them
    assert max(asked) > math.radians(20)


def test_ahead_and_back_are_not_joined() -> None:
    there_and_back = [Piece((0.0, 0.0), (0.0, 0.1), 0.0, 1), Piece((0.0, 0.1), (0.0, 0.05), 0.0, -1)]
    assert straightened(there_and_back, 0.0, everywhere, 0.01) == there_and_back
    behind = [Piece((0.0, 0.0), (0.0, -0.1), 0.0, -1), Piece((0.0, -0.1), (0.02, -0.2), 0.2, -1)]
    (line,) = straightened(behind, 0.0, everywhere, 0.01)
    assert line.gear == -1
    assert line.heading == pytest.approx(math.atan2(0.02, 0.2))


def test_the_first_metres_and_the_first_turns() -> None:
    part = split(STAIRS, 0.15)[0]
    assert length_of(part) == pytest.approx(0.15)
    assert part[-1].b == pytest.approx((0.05, 0.1))
    assert within_turn(STAIRS, 0.0, 1.0) == (STAIRS[:1], pytest.approx(-1.0))
    assert within_turn(STAIRS, 0.0, 1.6) == (STAIRS, 0.0)  # turns to and fro do not add up
    assert within_turn(STAIRS, -0.8, 1.6) == (STAIRS, 0.0)
    # but what was turned to one side is lost on the other
    assert within_turn(STAIRS, -0.8, 0.9) == (STAIRS[:1], pytest.approx(-0.9))
    assert within_turn(STAIRS, 0.5, 1.6) == (STAIRS[:1], pytest.approx(-1.1))
    assert within_turn(STAIRS[1:], -0.8, 0.3) == ([], pytest.approx(-0.3))
    # a turn at the end of a leg goes on from the heading there, and no farther than the next piece asks for
    bent = [Piece((0.0, 0.0), (0.0, 0.1), -0.6, 1), Piece((0.0, 0.1), (0.1, 0.1), -0.8, 1)]
    assert within_turn(bent, 0.0, 0.7) == (bent[:1], pytest.approx(-0.1))
    assert within_turn([bent[0], replace(bent[1], heading=0.9)], 0.0, 0.7) == (bent[:1], pytest.approx(0.7))
    assert within_turn([bent[0], replace(bent[1], heading=-1.1)], -0.6, 0.4) == (bent[:1], pytest.approx(-0.4))
    # a turn that is counted on past half a turn keeps its direction
    around = [Piece((0.0, 0.0), (0.0, 0.1), 1.2 * math.pi, 1)]
    assert within_turn(around, 0.0, 0.5) == ([], pytest.approx(0.5))


def test_the_first_and_the_last_metres_are_the_whole_way() -> None:
    for length in (0.0, 0.04, 0.1, 0.15, 0.25):
        parts = [piece for part in split(STAIRS, length) for piece in part]
        assert length_of(parts) == pytest.approx(length_of(STAIRS))
        assert [piece.b for piece in parts if piece.b in [p.b for p in STAIRS]] == [piece.b for piece in STAIRS]
        assert all(a.b == pytest.approx(b.a) for a, b in itertools.pairwise(parts))


def test_pieces_through_points_head_where_they_are_driven() -> None:
    points = np.array([(0.0, 0.0), (0.0, 0.1), (0.1, 0.1), (0.1, 0.0)])
    found = through(points, np.array([1, 1, -1], np.int8), 2 * math.pi)
    assert [piece.heading for piece in found] == pytest.approx([2 * math.pi, 1.5 * math.pi, 2 * math.pi])
    assert [piece.gear for piece in found] == [1, 1, -1]
    np.testing.assert_array_equal(vertices(found, found[0].a), points)


def test_a_turn_is_looked_at_all_the_way() -> None:
    def but_once(x: np.ndarray, y: np.ndarray, heading: np.ndarray) -> bool:
        return not bool((np.abs(heading - 0.5) < 0.05).any())

    assert not turnable((0.0, 0.0), 0.0, 1.0, but_once)
    assert turnable((0.0, 0.0), 0.0, 0.4, but_once)


def test_what_rounding_leaves_over_is_no_piece() -> None:
    way = [Piece((0.0, 0.0), (0.0, 0.1), 0.0, 1), Piece((0.0, 0.1), (0.0, 0.2), 0.0, 1)]
    assert [piece.b for piece in split(way, 0.1 + 1e-15)[0]] == [(0.0, 0.1)]
    assert [piece.a for piece in split(way, 0.1 - 1e-15)[1]] == [(0.0, 0.1)]


def graph_but(what: str, k: int) -> LatticeGraph:
    """Five places by five, all of which is known but the pose, step or turn ``k`` of the middle one."""
    known = {name: np.ones((8, 5, 5), bool) for name in ("pose", "step", "turn")}
    known.get(what, np.ones((8, 5, 5), bool))[k % 8, 2, 2] = False
    price = np.ones((8, 5, 5))
    grid = PoseGrid((0.0, 0.0), 0.0, 0.1, (5, 5), (2, 2))
    return LatticeGraph(grid, price, price, price, (known["pose"], known["step"], known["turn"]))


@pytest.mark.parametrize("k", range(8))
def test_a_stretch_is_unknown_whichever_way_it_is_driven(k: int) -> None:
    a, b = (2, 2), (2 + int(HEADING_STEPS[k][0]), 2 + int(HEADING_STEPS[k][1]))
    for heading, begin, move, end in ((k, a, AHEAD, b), (k, b, BACK, a), (k + 8, b, AHEAD, a), (k + 8, a, BACK, b)):
        moves = [(heading, *begin, move), (heading, *end, -1)]
        known = {what: [piece.known for piece in pieces(graph_but(what, k), moves)] for what in ("", "step", "pose")}
        assert known == {"": [True], "step": [False], "pose": [False]}
        assert pieces(graph_but("step", k + 1), moves)[0].known


@pytest.mark.parametrize("k", [0, 6, 7, 15])
def test_a_turn_over_unknown_ground_makes_what_follows_unknown(k: int) -> None:
    for first, turn, then in ((k, TO_LEFT, k + 1), (k + 1, TO_RIGHT, k)):
        dr, dc = (int(v) for v in HEADING_STEPS[then % 16])
        moves = [(first, 2, 2, turn), (then, 2, 2, AHEAD), (then, 2 + dr, 2 + dc, AHEAD), (then, 2, 2, -1)]
        for what, known in (("", [True, True]), ("turn", [False, True])):
            assert [piece.known for piece in pieces(graph_but(what, k), moves)] == known
