"""Nav2's map, read back by the rules that its documentation states."""

import numpy as np
from raising import raises
from toys.artifacts import recorded
from toys.map_server import load

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
    assert export_run("nav2", tmp_path, tmp_path / "nav2", recorded(tmp_path, {"risk/world": bundle})).endswith(
        "600 cells"
    )
    grid = load(tmp_path / "nav2" / "map.yaml")
    places, classes, p = LATTICE.xy(), bundle["risk"], bundle["p_hazard"]
    for row, col in np.random.default_rng(1).integers(0, (30, 20), (60, 2)):
        expected = {2: 100, 3: -1}.get(int(classes[row, col]), round(100 * float(p[row, col])))
        assert grid.at(*places[row, col]) == expected


def test_of_a_drive_the_map_of_its_last_stop_is_written(tmp_path):
    last, other = risk(), Bundle({}, {})
    made = {f"risk/{k}{kind}": other for k in range(11) for kind in ("/near", "")} | {"risk/truth": other}
    store = recorded(tmp_path, made | {"risk/10": last} | {f"merge/{k}": other for k in range(11)})
    assert export_run("nav2", tmp_path, tmp_path / "nav2", store).endswith("600 cells")


def test_a_run_without_a_map_is_told_how_to_get_one(tmp_path):
    with raises("RIL-609", "run the same command again"):
        export_run("nav2", tmp_path, tmp_path / "nav2", recorded(tmp_path, {"calibration": Bundle({}, {})}))
    assert not (tmp_path / "nav2").exists()
