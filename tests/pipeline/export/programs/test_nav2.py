"""Nav2's maps, masks and path, read back by the rules that its documentation states."""

import cv2
import numpy as np
import pytest
import yaml

from rille.pipeline.export.programs import nav2
from rille.stages.core.declare import Bundle
from rille.stages.geometry.lattice import Lattice

LATTICE = Lattice(x0=-1.0, y0=7.0, cell=0.1, rows=30, cols=20)


def risk():
    """Classes and probabilities of a map, all four classes among them."""
    rng = np.random.default_rng(0)
    classes = rng.integers(0, 4, LATTICE.shape).astype(np.uint8)
    return Bundle({"risk": classes, "p_hazard": rng.random(LATTICE.shape, np.float32)}, {"lattice": LATTICE.to_dict()})


def occupancy_at(folder, name, x, y):
    """Occupancy -1..100 at a place, as map_server reads it (nav2_map_server, map_io)."""
    about = yaml.safe_load((folder / f"{name}.yaml").read_text())
    image = cv2.imread(str(folder / about["image"]), cv2.IMREAD_UNCHANGED)
    col = int((x - about["origin"][0]) / about["resolution"])
    row = image.shape[0] - 1 - int((y - about["origin"][1]) / about["resolution"])
    pixel = np.atleast_1d(image[row, col]).astype(float)
    shade = pixel[:3].mean() / 255.0
    if about["mode"] == "raw":
        value = round(shade * 255.0)
        return value if value <= 100 else -1
    assert about["mode"] == "scale"
    assert about["negate"] == 0
    if pixel.size == 4 and pixel[3] < 255:
        return -1
    occupied = 1.0 - shade
    if occupied > about["occupied_thresh"]:
        return 100
    if occupied < about["free_thresh"]:
        return 0
    span = about["occupied_thresh"] - about["free_thresh"]
    return round((occupied - about["free_thresh"]) / span * 100.0)


def test_every_cell_has_its_class_at_its_place(tmp_path):
    bundle = risk()
    nav2.write(tmp_path, bundle, None)
    places, classes, p = LATTICE.xy(), bundle["risk"], bundle["p_hazard"]
    for row, col in np.random.default_rng(1).integers(0, (30, 20), (60, 2)):
        x, y = places[row, col]
        kind = classes[row, col]
        expected = {2: 100, 3: -1}.get(int(kind), round(100 * float(p[row, col])))
        assert occupancy_at(tmp_path, "map", x, y) == expected
        assert occupancy_at(tmp_path, "map_scale", x, y) == pytest.approx(expected, abs=0.6)
        assert occupancy_at(tmp_path, "keepout", x, y) == (100 if kind >= 2 else 0)
        assert occupancy_at(tmp_path, "speed", x, y) == (nav2.SLOW if kind == 1 else 0)
    assert not (tmp_path / "path.yaml").exists()


def test_the_path_is_a_message_whose_poses_look_ahead(tmp_path):
    turn = np.linspace(0, np.pi / 2, 200)
    xyz = np.column_stack([np.sin(turn), 1 - np.cos(turn), 0.01 * turn])
    nav2.write(tmp_path, risk(), Bundle({"path": xyz}, {}))
    message = yaml.safe_load((tmp_path / "path.yaml").read_text())
    assert message["header"]["frame_id"] == "map"
    assert len(message["poses"]) == 200
    for k, pose in enumerate(p["pose"] for p in message["poses"]):
        assert [pose["position"][a] for a in "xyz"] == pytest.approx(xyz[k], abs=1e-6)
        q = [pose["orientation"][a] for a in "xyzw"]
        assert np.linalg.norm(q) == pytest.approx(1.0, abs=1e-6)
        assert 2 * np.arctan2(q[2], q[3]) == pytest.approx(turn[k], abs=0.05)


def test_a_path_of_one_pose_and_of_none(tmp_path):
    assert "poses" in yaml.safe_load(nav2.path_message(np.zeros((1, 3))))
    nav2.write(tmp_path, risk(), Bundle({"path": np.empty((0, 3))}, {}))
    assert not (tmp_path / "path.yaml").exists()
