"""Alignment of poses: recovers a known motion, also where positions alone do not determine it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rille.stages.geometry.geometry import rotation_exp
from rille.stages.geometry.rigid import alignment, compose, inverse, posed, spread

small = st.floats(-2.0, 2.0)
vectors = st.tuples(small, small, small)


def drive(n: int, step: float) -> np.ndarray:
    """A straight drive along z, not turning."""
    poses = np.tile(np.eye(3, 4), (n, 1, 1))
    poses[:, 2, 3] = step * np.arange(n)
    return poses


@given(vectors, vectors, st.sampled_from([0.0, 1.3]), st.sampled_from([0.1, 1.0]))
def test_a_known_motion_is_found_even_of_a_straight_drive_and_at_rest(
    turn: tuple[float, float, float], shift: tuple[float, float, float], step: float, share: float
) -> None:
    target = drive(5, step)
    motion = np.column_stack([rotation_exp(turn), shift])
    source = compose(inverse(motion), target)
    np.testing.assert_allclose(alignment(source, target, share), motion, atol=1e-9)
    np.testing.assert_allclose(compose(motion, source), target, atol=1e-9)


def test_the_share_decides_between_positions_and_orientations() -> None:
    """Positions on a line turned by 0.1 rad, orientations not: a small share follows the line, a great one does not."""
    target = drive(9, 1.0)
    source = target.copy()
    source[:, :, 3] = target[:, :, 3] @ rotation_exp([0.0, 0.1, 0.0])
    angle = {
        share: np.arccos(np.clip((np.trace(alignment(source, target, share)[:, :3]) - 1) / 2, -1, 1))
        for share in (0.01, 50)
    }
    assert angle[0.01] == pytest.approx(0.1, abs=1e-3)
    assert angle[50] == pytest.approx(0.0, abs=1e-3)


def test_spread_and_posed_by_hand() -> None:
    poses = drive(3, 3.0)
    assert spread(poses) == pytest.approx(np.sqrt((9 + 0 + 9) / 3))
    poses[1, 0, 0] = np.nan
    assert posed(poses).tolist() == [True, False, True]
