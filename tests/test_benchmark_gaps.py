"""The verdict on a bridge over lost frames, by hand."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from rille.stages.core.declare import Bundle

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "benchmarks"))

from gaps import judge, words


def line(steps: list[float]) -> np.ndarray:
    """Poses (frame, 3, 4) along z."""
    poses = np.tile(np.eye(3, 4), (len(steps), 1, 1))
    poses[:, 2, 3] = steps
    return poses


def test_error_and_sigma_are_those_of_the_gap_alone() -> None:
    truth = line([0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
    covariance = np.zeros((4, 6, 6))
    covariance[:, 2, 2] = [0.0, 0.01, 0.02, 0.06]
    found = Bundle(
        {"poses": line([7.0, 8.0, np.nan, 10.5]), "covariance": covariance, "piece": np.array([0, 0, -1, 0])},
        {"pieces": [[1, 4]]},
    )
    row = judge(found, truth, 2, 4, 1)
    np.testing.assert_allclose([row["error"], row["sigma"]], [0.5, np.sqrt(0.05)])
    assert words(row) == "0.500 m, 2.2 sigma"
    assert "WRONG" in words({"error": 0.5, "sigma": 0.1, "pieces": 1})


def test_a_broken_trajectory_is_not_wrong() -> None:
    found = Bundle({"piece": np.array([0, -1, 1])}, {"pieces": [[0, 0], [2, 2]]})
    assert words(judge(found, line([0.0, 1.0, 2.0]), 0, 2, 0)) == "2 pieces"
