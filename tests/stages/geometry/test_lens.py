import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raising import raises

from rille.stages.geometry.geometry import Camera
from rille.stages.geometry.lens import Lens

UNIT = Camera(100.0, 200.0, 50.0, 40.0, 101, 81)
RAW = Camera(460.0, 458.0, 367.2, 248.4, 752, 480)
LENSES = {
    "none": Lens(RAW),
    "radtan": Lens(RAW, "radtan", (-0.283, 0.074, 2e-4, -3e-4)),
    "radtan of five": Lens(RAW, "radtan", (-0.266, -0.0386, 1.8e-3, -2.8e-4, 0.238)),
    "rational": Lens(RAW, "rational", (0.3, 0.02, 1e-4, 2e-4, 0.001, 0.6, 0.1, 0.005)),
    "thin prism": Lens(RAW, "rational", (0.3, 0.02, 1e-4, 2e-4, 0.0, 0.6, 0.1, 0.0, 1e-3, 2e-4, -1e-3, 1e-4)),
    "tilted": Lens(RAW, "rational", (0.3, 0.02, 1e-4, 2e-4, 0.0, 0.6, 0.1, 0.0, 1e-3, 2e-4, -1e-3, 1e-4, 0.01, -0.02)),
    "fisheye": Lens(Camera(191.0, 190.5, 255.0, 257.0, 512, 512), "fisheye", (0.0035, 0.0007, -0.0021, 0.0002)),
}


def expected(model, coefficients, x, y):
    """Distorted normalised coordinates, written out from the models' definitions."""
    r2 = x * x + y * y
    if model == "fisheye":
        k1, k2, k3, k4 = coefficients
        r = math.sqrt(r2)
        t = math.atan(r)
        scale = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8) / r
        return x * scale, y * scale
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = (*coefficients, *(0.0,) * (12 - len(coefficients)))
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2**2,
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2,
    )


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("radtan", (0.1, 0.01, 0.002, -0.003)),
        ("radtan", (-0.1, 0.02, 0.002, -0.003, 0.005)),
        ("rational", (0.1, 0.01, 0.002, -0.003, 0.004, 0.2, 0.03, 0.001)),
        ("rational", (0.1, 0.01, 0.002, -0.003, 0.004, 0.2, 0.03, 0.001, 0.01, 0.02, 0.03, 0.04)),
        ("fisheye", (0.1, 0.01, -0.002, 0.003)),
    ],
)
def test_distortion_is_the_formula_of_its_model(model, coefficients):
    lens = Lens(UNIT, model, coefficients)
    x, y = 0.3, -0.45
    raw = lens.distort(UNIT.project([[x, y, 1.0]]), UNIT)
    xd, yd = expected(model, coefficients, x, y)
    np.testing.assert_allclose(raw, [[100 * xd + 50, 200 * yd + 40]], atol=1e-9)


def test_barrel_of_one_tenth_by_hand():
    # One focal length off the axis, 10 % further out: 50 + 100 * 1.1.
    lens = Lens(UNIT, "radtan", (0.1, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(lens.distort([[150.0, 40.0]]), [[160.0, 40.0]], atol=1e-9)
    np.testing.assert_allclose(lens.undistort([[160.0, 40.0]]), [[150.0, 40.0]], atol=1e-6)


def test_the_skew_of_a_rover_s_camera_lowers_what_lies_to_the_right():
    lens = Lens(UNIT, "cahvore", (3.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))
    np.testing.assert_allclose(lens.distort([[90.0, 40.0], [10.0, 70.0]], UNIT), [[90.0, 41.2], [10.0, 68.8]])
    np.testing.assert_allclose(lens.undistort([[90.0, 41.2], [10.0, 68.8]], UNIT), [[90.0, 40.0], [10.0, 70.0]])


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_undistort_inverts_distort_over_the_whole_raw_image(lens):
    c = lens.camera
    y, x = np.mgrid[0 : c.height : 16, 0 : c.width : 16].astype(float)
    raw = np.stack([x.ravel(), y.ravel()], 1)
    ideal = lens.undistort(raw)
    seen = np.isfinite(ideal).all(axis=1)
    # A fisheye sees corners that are more than 90 degrees off the axis: no pinhole camera does.
    angle = np.hypot((raw[:, 0] - c.cx) / c.fx, (raw[:, 1] - c.cy) / c.fy)
    assert seen[angle < 1.5].all() if lens.model == "fisheye" else seen.all()
    np.testing.assert_allclose(lens.distort(ideal)[seen], raw[seen], atol=1e-4)


@settings(max_examples=40, deadline=None)
@given(
    k1=st.floats(-0.4, 0.4),
    k2=st.floats(-0.1, 0.2),
    p1=st.floats(-2e-3, 2e-3),
    p2=st.floats(-2e-3, 2e-3),
    x=st.floats(-0.9, 0.9),
    y=st.floats(-0.9, 0.9),
)
def test_any_radial_tangential_lens_inverts_inside_its_reach(k1, k2, p1, p2, x, y):
    lens = Lens(RAW, "radtan", (k1, k2, p1, p2))
    if np.hypot(x, y) > 0.9 * lens.reach:
        return
    ideal = RAW.project([[x, y, 1.0]])
    np.testing.assert_allclose(lens.undistort(lens.distort(ideal)), ideal, atol=1e-2)


def test_model_that_folds_back_has_a_reach():
    # r (1 - 0.3 r^2) grows up to 1 - 0.9 r^2 = 0, where it is 0.703.
    lens = Lens(UNIT, "radtan", (-0.3, 0.0, 0.0, 0.0))
    limit = math.sqrt(1 / 0.9)
    assert lens.reach == pytest.approx(limit)
    inside, outside = UNIT.project([[limit - 1e-3, 0.0, 1.0], [limit + 1e-3, 0.0, 1.0]])
    assert np.isfinite(lens.distort([inside])).all()
    assert np.isnan(lens.distort([outside])).all()
    last = limit * (1 - 0.3 * limit**2)
    assert np.isfinite(lens.undistort(UNIT.project([[last - 1e-3, 0.0, 1.0]]))).all()
    assert np.isnan(lens.undistort(UNIT.project([[last + 1e-3, 0.0, 1.0]]))).all()


def test_reach_of_the_other_models():
    assert math.isinf(Lens(UNIT).reach)
    assert math.isinf(LENSES["radtan"].reach)
    # A pole of the denominator at r = 2, before which the quotient grows.
    assert Lens(UNIT, "rational", (0, 0, 0, 0, 0, -0.25, 0, 0)).reach == pytest.approx(2.0)
    # theta (1 - 0.3 theta^2) grows up to theta = sqrt(1 / 0.9), 60.4 degrees.
    assert Lens(UNIT, "fisheye", (-0.3, 0, 0, 0)).reach == pytest.approx(math.tan(math.sqrt(1 / 0.9)))
    assert math.isinf(LENSES["fisheye"].reach)


@pytest.mark.parametrize("lens", [*LENSES.values(), Lens(RAW, "radtan", (-0.5, 0.0, 0.0, 0.0))])
def test_maps_are_distort_of_every_pixel(lens):
    ideal = lens.ideal_camera()
    x, y = lens.maps(ideal)
    assert x.shape == y.shape == (ideal.height, ideal.width)
    row, col = np.mgrid[0 : ideal.height, 0 : ideal.width].astype(float)
    raw = lens.distort(np.stack([col.ravel(), row.ravel()], 1), ideal)
    # Single precision at 752 pixels.
    np.testing.assert_allclose(np.stack([x.ravel(), y.ravel()], 1), raw, atol=1e-4)


def test_ideal_camera_has_the_focal_length_of_the_lens():
    assert LENSES["radtan"].ideal_camera() == RAW
    assert Lens(RAW).ideal_camera() == RAW


def test_ideal_camera_of_a_narrow_fisheye_sees_its_edges():
    # Equidistant: 320 px are 0.32 rad, a pinhole needs f tan(0.32) = 320.
    lens = Lens(Camera(1000.0, 1000.0, 320.0, 320.0, 641, 641), "fisheye", (0.0, 0.0, 0.0, 0.0))
    ideal = lens.ideal_camera()
    assert ideal.fx == pytest.approx(320 / math.tan(0.32))
    np.testing.assert_allclose(lens.distort([[0.0, 320.0], [640.0, 320.0]]), [[0.0, 320.0], [640.0, 320.0]], atol=1e-6)


@pytest.mark.parametrize("edge", [(0.0, 320.0), (640.0, 320.0), (320.0, 0.0), (320.0, 640.0)])
def test_the_farthest_edge_of_a_narrow_fisheye_decides(edge):
    # The principal point lies off the middle, away from the edge.
    cx, cy = (320.0 + 0.1 * (320.0 - v) for v in edge)
    lens = Lens(Camera(1000.0, 1000.0, cx, cy, 641, 641), "fisheye", (0.0, 0.0, 0.0, 0.0))
    at = [(edge[0], cy)] if edge[1] == 320.0 else [(cx, edge[1])]
    np.testing.assert_allclose(lens.distort(at), at, atol=1e-6)


def test_ideal_camera_of_a_wide_fisheye_keeps_most_of_its_resolution():
    lens = LENSES["fisheye"]
    assert lens.ideal_camera().fx == pytest.approx(0.7 * lens.camera.fx)
    assert lens.ideal_camera().fy == pytest.approx(0.7 * lens.camera.fy)


def test_ideal_lenses():
    assert Lens(RAW).ideal
    assert Lens(RAW, "radtan", (0.0, 0.0, 0.0, 0.0)).ideal
    assert not LENSES["radtan"].ideal
    # Equidistant projection is no pinhole, even without coefficients.
    assert not Lens(RAW, "fisheye", (0.0, 0.0, 0.0, 0.0)).ideal


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_json_round_trip(lens):
    assert Lens.from_dict(lens.to_dict()) == lens


def test_no_points():
    assert LENSES["radtan"].undistort(np.empty((0, 2))).shape == (0, 2)
    assert LENSES["radtan"].distort(np.empty((0, 2))).shape == (0, 2)


@pytest.mark.parametrize(
    ("model", "coefficients", "code"),
    [
        ("omni", (), "RIL-369"),
        ("radtan", (0.1, 0.2, 0.3), "RIL-370"),
        ("none", (0.1,), "RIL-370"),
        ("fisheye", (0.1, 0.2, 0.3, math.nan), "RIL-371"),
    ],
)
def test_bad_lenses(model, coefficients, code):
    with raises(code):
        Lens(RAW, model, coefficients)
