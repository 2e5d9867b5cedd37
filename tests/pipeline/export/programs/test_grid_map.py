"""The grid map, read back from its bag by the rules of grid_map_core."""

import sys

import numpy as np
import pytest
from raising import raises
from rosbags.highlevel import AnyReader

from rille.pipeline.export.programs import grid_map
from rille.stages.core.declare import Bundle
from rille.stages.geometry.lattice import Lattice

LATTICE = Lattice.at(-10, 70, 0.1, 30, 20)
PARTS = (Lattice.at(-10, 70, 0.1, 30, 12), Lattice.at(2, 70, 0.1, 30, 8))


def bundles():
    """A risk map with all four classes, and the two tiles of its terrain, one with a hole."""
    rng = np.random.default_rng(0)
    classes = rng.integers(0, 4, LATTICE.shape).astype(np.uint8)
    risk = {"risk": classes, "p_hazard": rng.random(LATTICE.shape, np.float32)}
    tiles = []
    for part in PARTS:
        z = rng.random(part.shape, np.float32)
        z[3, 4] = np.nan
        tiles.append(Bundle({"elevation": z, "elevation_std": 0.1 * z}, {"lattice": part.to_dict()}))
    return Bundle(risk, {"lattice": LATTICE.to_dict()}), tiles


def written(folder):
    risk, tiles = bundles()
    grid_map.write(folder, risk, tiles)
    with AnyReader([folder]) as reader:
        ((connection, _, data),) = reader.messages()
        assert (connection.topic, connection.msgtype) == ("/grid_map", "grid_map_msgs/msg/GridMap")
        return reader.deserialize(data, connection.msgtype)


def at(message, layer, x, y):
    """Value at a place: index from the corner of greatest x and y, columns one behind another."""
    info, data = message.info, message.data[message.layers.index(layer)]
    row = int((info.pose.position.x + 0.5 * info.length_x - x) / info.resolution)
    column = int((info.pose.position.y + 0.5 * info.length_y - y) / info.resolution)
    outer, inner = data.layout.dim
    assert (outer.label, inner.label) == ("column_index", "row_index")
    assert outer.stride == outer.size * inner.size == len(data.data)
    return data.data[column * inner.stride + row]


def test_every_layer_has_its_value_at_its_place(tmp_path):
    risk, tiles = bundles()
    message = written(tmp_path / "grid_map")
    assert message.header.frame_id == "map"
    assert message.layers == ["elevation", "sigma", "risk", "p_hazard"]
    assert (message.outer_start_index, message.inner_start_index) == (0, 0)
    places = LATTICE.xy()
    whole = {name: np.hstack([tile[name] for tile in tiles]) for name in ("elevation", "elevation_std")}
    for row, col in [(3, 4), *np.random.default_rng(1).integers(0, (30, 20), (60, 2))]:
        x, y = places[row, col]
        kind = int(risk["risk"][row, col])
        expected = {
            "elevation": whole["elevation"][row, col],
            "sigma": whole["elevation_std"][row, col],
            "risk": np.nan if kind == 3 else kind,
            "p_hazard": risk["p_hazard"][row, col],
        }
        for layer, value in expected.items():
            assert at(message, layer, x, y) == pytest.approx(value, nan_ok=True)


def test_equal_maps_are_equal_files(tmp_path):
    for name in "ab":
        written(tmp_path / name / "grid_map")
    a, b = ({p.name: p.read_bytes() for p in (tmp_path / name / "grid_map").iterdir()} for name in "ab")
    assert a == b
    assert sorted(a) == ["grid_map.mcap", "metadata.yaml"]


def test_a_missing_package_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.rosbag2", None)
    with raises("RIL-958", "rille[robots]"):
        grid_map.write(tmp_path / "grid_map", *bundles())
