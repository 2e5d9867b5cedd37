"""Nav2's maps, masks and path, read back by the rules that its documentation states."""

import numpy as np
import pytest
import yaml
from raising import raises
from toys.artifacts import recorded
from toys.map_server import load

from rille.pipeline.export.programs import nav2
from rille.pipeline.export.programs.run_artifacts import export_run
from rille.stages.core.declare import Bundle
from rille.stages.geometry.lattice import Lattice

LATTICE = Lattice(x0=-1.0, y0=7.0, cell=0.1, rows=30, cols=20)


def risk():
    """Classes and probabilities of a map, all four classes among them."""
    rng = np.random.default_rng(0)
    classes = rng.integers(0, 4, LATTICE.shape).astype(np.uint8)
    return Bundle({"risk": classes, "p_hazard": rng.random(LATTICE.shape, np.float32)}, {"lattice": LATTICE.to_dict()})


def test_every_cell_has_its_class_at_its_place(tmp_path):
    bundle = risk()
    nav2.write(tmp_path, bundle, None)
    grids = {name: load(tmp_path / f"{name}.yaml") for name in ("map", "keepout", "speed")}
    places, classes, p = LATTICE.xy(), bundle["risk"], bundle["p_hazard"]
    for row, col in np.random.default_rng(1).integers(0, (30, 20), (60, 2)):
        x, y = places[row, col]
        kind = classes[row, col]
        expected = {2: 100, 3: -1}.get(int(kind), round(100 * float(p[row, col])))
        assert grids["map"].at(x, y) == expected
        assert grids["keepout"].at(x, y) == (100 if kind >= 2 else 0)
        assert grids["speed"].at(x, y) == (nav2.SLOW if kind == 1 else 0)
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
    assert len(nav2.path_message(np.zeros((1, 3)))["poses"]) == 1
    nav2.write(tmp_path, risk(), Bundle({"path": np.empty((0, 3))}, {}))
    assert not (tmp_path / "path.yaml").exists()


def test_of_a_drive_the_map_of_its_last_stop_is_written(tmp_path):
    last, other = risk(), Bundle({}, {})
    made = {f"risk/{k}{kind}": other for k in range(11) for kind in ("/near", "")} | {"risk/truth": other}
    store = recorded(tmp_path, made | {"risk/10": last} | {f"merge/{k}": other for k in range(11)})
    assert export_run("nav2", tmp_path, tmp_path / "nav2", store).endswith("600 cells, no path")
    assert load(tmp_path / "nav2/keepout.yaml").at(*LATTICE.xy()[0, 0]) == (100 if last["risk"][0, 0] >= 2 else 0)


def test_a_run_without_a_map_is_told_how_to_get_one(tmp_path):
    with raises("RIL-609", "run the same command again"):
        export_run("nav2", tmp_path, tmp_path / "nav2", recorded(tmp_path, {"calibration": Bundle({}, {})}))
    assert not (tmp_path / "nav2").exists()
