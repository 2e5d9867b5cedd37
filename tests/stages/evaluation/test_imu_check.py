"""An IMU whose axes or unit are others than stated contradicts the images, and a right one never does."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rille.stages.evaluation.imu_check import of_mount, of_rotations, of_vertical

AXES = Rotation.from_rotvec([0.02, 0.03, 1.55]).as_matrix()
TIMES = 0.1 * np.arange(25)


def attitudes(rates: np.ndarray) -> np.ndarray:
    """R_reference_left of a sensor that reads ``rates`` (frame, 3), rad/s, in its own axes."""
    R = [np.eye(3)]
    for rate in rates[:-1]:
        R.append(R[-1] @ AXES.T @ Rotation.from_rotvec(0.1 * rate).as_matrix() @ AXES)
    return np.array(R)


def turning(speed: float, seed: int) -> np.ndarray:
    return speed * np.random.default_rng(seed).normal(size=(len(TIMES), 3))


def noisy(R: np.ndarray) -> np.ndarray:
    return R @ Rotation.from_rotvec(np.random.default_rng(9).normal(scale=1e-3, size=(len(R), 3))).as_matrix()


@pytest.mark.parametrize(
    ("read", "words"),
    [
        (lambda w: w[:, [2, 1, 0]], "its z, y, x:"),
        (lambda w: w * [1, -1, 1], "its x, -y, z:"),
        (lambda w: w[:, [1, 2, 0]], "its z, x, y:"),
    ],
)
def test_the_axes_or_unit_that_fit_are_named(read, words):
    rates = turning(1.0, 1)
    (line,) = of_rotations(noisy(attitudes(rates)), attitudes(read(rates)), TIMES, AXES)
    assert words in line


def test_axes_about_which_it_hardly_turns_are_still_told():
    rates = turning(1.0, 4) * [1.0, 0.07, 1.0]
    (line,) = of_rotations(noisy(attitudes(rates)), attitudes(rates[:, [2, 1, 0]]), TIMES, AXES)
    assert "its z, y, x:" in line


def test_rates_in_degrees_of_a_camera_at_rest_are_named():
    bias = np.tile([0.0, 0.02, 0.08], (len(TIMES), 1))
    (line,) = of_rotations(noisy(attitudes(0 * bias)), attitudes(np.rad2deg(bias)), TIMES, AXES)
    assert "degrees a second" in line
    assert "exchange" not in line


def test_an_attitude_that_begins_anew_behind_each_gap_hides_nothing():
    rates = turning(1.0, 2)
    sensed = attitudes(rates[:, [2, 1, 0]])
    for gap in range(2, len(TIMES), 3):
        sensed[gap] = np.nan
        sensed[gap + 1 :] = Rotation.from_rotvec([0.3, -0.5, 1.3]).as_matrix() @ sensed[gap + 1 :]
    (line,) = of_rotations(noisy(attitudes(rates)), sensed, TIMES, AXES)
    assert "its z, y, x:" in line


@pytest.mark.parametrize("speed", [0.0, 0.02, 0.3, 2.0])
def test_a_right_sensor_never_contradicts_not_even_with_its_bias(speed):
    for seed in range(5):
        rates = turning(speed, seed)
        read = rates + np.array([0.0, 0.02, 0.12])
        assert of_rotations(noisy(attitudes(rates)), attitudes(read), TIMES, AXES) == []
    few = np.full((len(TIMES), 3, 3), np.nan)
    assert of_rotations(few, attitudes(read), TIMES, AXES) == []


def pitched(*degrees: float) -> np.ndarray:
    """Up of a camera that looks down by each of the angles, (n, 3)."""
    return np.array([[0.0, -np.cos(p), -np.sin(p)] for p in np.deg2rad(degrees)])


def test_gravity_off_the_ground_names_the_axes_that_would_fit():
    """As of a sensor whose x points up and z back, with x and z exchanged."""
    up = np.array([0.926, 0.013, -0.377])
    (line,) = of_vertical((AXES.T @ up[[2, 1, 0]])[None], (AXES.T @ up)[None], AXES)
    assert "its z, y, x" in line
    assert "gravity alone does not tell" in line
    assert "134 degrees" in line


def test_a_stated_vertical_off_the_ground_is_named():
    (line,) = of_vertical(-pitched(0.0), pitched(0.0), None)
    assert "stated vertical is 180 degrees off" in line
    (line,) = of_vertical(pitched(12.0, 8.0), pitched(-12.0, -8.0), None)
    assert "stated vertical is 20 degrees off" in line
    assert "unless all of that ground is such a slope" in line
    # Slopes to both sides are those of the ground.
    assert of_vertical(pitched(0.0, 0.0), pitched(20.0, -20.0), None) == []


@pytest.mark.parametrize(
    ("stated", "seen", "words"),
    [
        (-12.0, (11.0, 12.0), "looks down by 11.5 degrees; with the other sign it is 0.5 off"),
        (30.0, (11.0, 12.0), "looks down by 11.5 degrees; unless all of that ground is such a slope, correct or"),
        (-3.0, (4.0, 3.0), "with the other sign it is"),
    ],
)
def test_a_pitch_off_the_ground_is_named_and_the_sign_that_would_fit(stated, seen, words):
    (line,) = of_vertical(pitched(*[stated] * len(seen)), pitched(*seen), None, np.deg2rad(stated))
    assert f"world.pitch_deg = {stated:.3g} contradicts" in line
    assert words in line
    assert of_vertical(pitched(*seen), pitched(*[s + 4.0 for s in seen]), None, np.deg2rad(seen[0])) == []


@pytest.mark.parametrize("axis", ["x", "z"])  # pitch, roll
@pytest.mark.parametrize(
    ("mount", "slope", "turn", "rough", "told"),
    [(6, 0, 20, 1, 1), (6, 8, 20, 1, 1), (0, 10, 20, 1, 0), (6, 0, 0, 1, 0), (6, 0, 20, 3, 0), (16, 0, 20, 3, 1)],
)
def test_a_vertical_that_is_off_alike_is_told_from_a_slope_where_the_vehicle_turns(
    axis, mount, slope, turn, rough, told
):
    rng, headings = np.random.default_rng(4), np.deg2rad(turn * np.arange(8.0))
    ground = Rotation.from_euler("y", slope, degrees=True).apply([0.0, 0.0, 1.0])
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    images = Rotation.from_rotvec(np.outer(headings, [0, 0, 1])).as_matrix() @ upright
    off = Rotation.from_euler(axis, mount, degrees=True).apply([0.0, -1.0, 0.0])
    uneven = ground + rng.normal(scale=np.deg2rad(rough), size=(8, 3))
    lines = of_mount(np.tile(off, (8, 1)), np.einsum("nji,nj->ni", images, uneven), images)
    assert len(lines) == told
    for line in lines:
        size, error = (float(word) for word in re.findall(r"is off by ([0-9.]+) \+- ([0-9.]+)", line)[0])
        # Of eight pairs that turn by 140 degrees, on ground that is uneven by a degree: half a degree.
        assert error == pytest.approx(0.5 * rough, rel=0.35)
        assert abs(size - mount) < 2.0 * error


def test_of_no_pair_with_a_pose_nothing_is_said():
    assert of_mount(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3))) == []
