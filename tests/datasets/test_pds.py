"""Labels of PDS3 and VICAR: the camera that they state, seen through the lens and the pose that Rille makes of it."""

from __future__ import annotations

import numpy as np
import pytest
from cahvore_camera import Cahvore
from raising import raises

from rille.datasets.cameras import UNKNOWN_SIZE, read_cameras, rig_of
from rille.stages.geometry.cahvore import Bending
from rille.stages.geometry.lens import Lens

A = np.array([0.9990, 0.0100, -0.0436]) / np.linalg.norm([0.9990, 0.0100, -0.0436])
ACROSS = np.cross(A, (0, 0, -1.0)) / np.linalg.norm(np.cross(A, (0, 0, 1)))
ACROSS = -ACROSS if np.cross(A, ACROSS)[2] > 0 else ACROSS  # rows point down, along minus z
DOWN = np.cross(A, ACROSS)
OPTICAL = A + 0.004 * ACROSS - 0.002 * DOWN
OPTICAL /= np.linalg.norm(OPTICAL)
C = np.array([0.4, -0.2, 1.9])
VECTORS = {
    "C": C,
    "A": A,
    "H": 900 * ACROSS + 512 * A,
    "V": 901 * DOWN + 0.7 * ACROSS + 383.5 * A,
    "O": OPTICAL,
    "R": np.array([2e-4, -0.21, 0.05]),
    "E": np.array([0.004, -0.002, 0.001]),
}
KINDS = {"CAHV": 4, "CAHVOR": 6, "CAHVORE": 7}
SHIFT = 0.3 * ACROSS


def components(kind, general=0.37, **other):
    values = VECTORS | other
    rows = [tuple(map(float, values[name])) for name in list(VECTORS)[: KINDS[kind]]]
    return [*rows, 3.0, general] if kind == "CAHVORE" else rows


def pds(kind, rows):
    lines = ["PDS_VERSION_ID = PDS3", "RECORD_TYPE = FIXED_LENGTH", "GROUP = DERIVED_IMAGE_PARMS", "END_GROUP"]
    lines += ["GROUP                     = GEOMETRIC_CAMERA_MODEL_PARMS", f' MODEL_TYPE = "{kind}"']
    for k, row in enumerate(rows, start=1):
        value = "(" + ",\r\n    ".join(map(repr, row)) + ")" if isinstance(row, tuple) else f"{row} <rad>"
        lines.append(f" MODEL_COMPONENT_{k} = {value}")
    return "\r\n".join([*lines, "END_GROUP = GEOMETRIC_CAMERA_MODEL_PARMS", "END", ""])


def vicar(kind, rows):
    text = "FORMAT='HALF'  TYPE='IMAGE'  NL=768  NS=1024  PROPERTY='GEOMETRIC_CAMERA_MODEL'  "
    text += f"MODEL_TYPE='{kind}'  " + "  ".join(f"MODEL_COMPONENT_{k}={row}" for k, row in enumerate(rows, start=1))
    text += "  PROPERTY='ROVER'  MODEL_COMPONENT_1=(9.0,9.0,9.0)  "
    return f"LBLSIZE={len(text) + 16:<8d}" + text


def vectors(kind, rows):
    """The text that JPL's programs write."""
    *rows, type_, linearity = rows if kind == "CAHVORE" else [*rows, None, None]
    model = f"{kind}{type_:.0f},{linearity} = general" if type_ else f"{kind} = perspective, distortion"
    lines = [f"{name} = {' '.join(map(repr, row))}" for name, row in zip("CAHVORE", rows, strict=False)]
    return "\n".join(
        ["# camera", f"Model = {model}", "Dimensions = 1024 768", "", *lines, "Hs    = 900", "S internal =", ""]
    )


def put(tmp_path, text, image=b"", name="left.IMG"):
    path = tmp_path / name
    path.write_bytes(text.encode() + image)
    return path


def exact(kind, c=C):
    """The camera that the vectors state; rays of far points do not depend on E."""
    v = VECTORS | {"C": c}
    lens = Bending(tuple(A)) if kind == "CAHV" else Bending(tuple(OPTICAL), tuple(v["R"]))
    lens = Bending(tuple(OPTICAL), tuple(v["R"]), 0.37) if kind == "CAHVORE" else lens
    return Cahvore(tuple(c), tuple(A), tuple(v["H"]), tuple(v["V"]), lens)


@pytest.mark.parametrize("form", [pds, vicar, vectors])
@pytest.mark.parametrize("kind", KINDS)
def test_lens_and_pose_image_points_as_the_label_says(tmp_path, kind, form):
    image = b"" if form is vectors else b"\0\xff\xfe" * 100
    (camera,) = read_cameras(put(tmp_path, form(kind, components(kind)), image))
    assert camera.size == ((1024, 768) if form is vectors else None)
    assert camera.name == "left"
    rng = np.random.default_rng(1)
    offset = rng.uniform(-0.5, 0.5, (1000, 2)) @ np.array([ACROSS, DOWN])
    points = C + (A + offset) * rng.uniform(1, 30, 1000)[:, None]
    seen = camera.T_camera_reference.apply(points)
    ideal = camera.lens.ideal_camera()
    pixels = camera.lens.distort(ideal.project(seen))
    np.testing.assert_allclose(pixels, exact(kind).project(points), rtol=0, atol=1e-6)
    np.testing.assert_allclose(camera.lens.undistort(pixels), ideal.project(seen), rtol=0, atol=1e-6)


def test_maps_are_the_distortion_of_every_pixel(tmp_path):
    (camera,) = read_cameras(put(tmp_path, pds("CAHVOR", components("CAHVOR"))))
    lens = Lens.from_dict(
        camera.lens.to_dict() | {"camera": camera.lens.camera.to_dict() | {"width": 40, "height": 30}}
    )
    x, y = lens.maps(lens.ideal_camera())
    assert x.shape == (30, 40)
    np.testing.assert_allclose([x[7, 31], y[7, 31]], lens.distort([[31.0, 7.0]])[0], rtol=1e-6)


def test_two_labels_are_a_rig(tmp_path):
    left = read_cameras(put(tmp_path, pds("CAHV", components("CAHV"))))[0]
    shifted = components("CAHV", C=C + SHIFT, V=901 * DOWN + 383.5 * A)
    right = read_cameras(put(tmp_path, pds("CAHV", shifted), name="right.LBL"))[0]
    assert left.lens.camera.width == UNKNOWN_SIZE[0]
    rig, lenses = rig_of(left, right, ((1024, 768), (1024, 768)))
    assert rig.baseline == pytest.approx(0.3)
    assert rig.T_right_left.translation == pytest.approx([-0.3, 0, 0], abs=1e-12)
    assert set(lenses) == {"left"}  # its rows are skewed


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (("CAHVOR", "CAHVORX"), "RIL-952"),
        (("MODEL_COMPONENT_4 = (", "MODEL_COMPONENT_4 = (1.0, "), "RIL-116"),
        (("MODEL_COMPONENT_4", "MODEL_COMPONENT_W"), "RIL-113"),
        (("MODEL_COMPONENT_1 = (0.4", "MODEL_COMPONENT_1 = (north"), "RIL-121"),
    ],
)
def test_a_wrong_label_is_one_line(tmp_path, change, code):
    with raises(code, "left.IMG", "GEOMETRIC_CAMERA_MODEL."):
        read_cameras(put(tmp_path, pds("CAHVOR", components("CAHVOR")).replace(*change)))


@pytest.mark.parametrize(("change", "code"), [(("V =", "W ="), "RIL-113"), (("V =", "V = 1.0"), "RIL-116")])
def test_a_wrong_text_of_vectors_names_the_vector(tmp_path, change, code):
    with raises(code, "left.cahvor: V "):
        read_cameras(put(tmp_path, vectors("CAHVOR", components("CAHVOR")).replace(*change), name="left.cahvor"))


def test_vectors_that_are_no_camera_are_refused(tmp_path):
    for values, code in (({"A": 2 * A}, "RIL-954"), ({"V": -VECTORS["V"]}, "RIL-953"), ({"H": 512 * A}, "RIL-957")):
        with raises(code, "MODEL_COMPONENT"):
            read_cameras(put(tmp_path, pds("CAHV", components("CAHV", **values))))
    rows = components("CAHVORE", general=7.0)
    with raises("RIL-956"):
        read_cameras(put(tmp_path, pds("CAHVORE", rows)))
    with raises("RIL-955"):
        read_cameras(put(tmp_path, pds("CAHVORE", [*rows[:7], 4.0, 0.5])))


def test_a_label_without_end_or_camera_is_refused_as_any_other_file(tmp_path):
    with raises("RIL-100"):
        read_cameras(put(tmp_path, "PDS_VERSION_ID = PDS3\r\nEND\r\n"))
    with raises("RIL-113"):
        read_cameras(put(tmp_path, "PDS_VERSION_ID = PDS3\nGROUP = GEOMETRIC_CAMERA_MODEL\n" + "(" * 500_000))
