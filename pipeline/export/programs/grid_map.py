"""A run as a bag with one ``grid_map_msgs/msg/GridMap``: what elevation mapping and its viewers take.

The bag (mcap, ROS 2) has the topic :data:`TOPIC` in the frame ``map``, the run's world frame: metres, x to the right
and y ahead of the first left camera, z up. Its layers are float32, NaN where nothing is known. The first cell of a grid
map is the one of greatest x and y; its first index runs along falling x, its second along falling y, and a layer is
stored by columns (``grid_map_core``, ``GridMapMath``; ``grid_map_ros``, ``GridMapMsgHelpers``).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from rille.pipeline.export.programs.run_artifacts import RunArtifacts
from rille.pipeline.export.rasters import whole
from rille.stages.core.declare import Bundle
from rille.stages.core.errors import InputError
from rille.stages.geometry.lattice import Lattice
from rille.stages.hazard.classification import UNKNOWN

FRAME, TOPIC = "map", "/grid_map"
MESSAGE = "grid_map_msgs/msg/GridMap"

DEFINITIONS = {
    "grid_map_msgs/msg/GridMapInfo": "float64 resolution\nfloat64 length_x\nfloat64 length_y\n"
    "geometry_msgs/Pose pose\n",
    MESSAGE: "std_msgs/Header header\ngrid_map_msgs/GridMapInfo info\nstring[] layers\nstring[] basic_layers\n"
    "std_msgs/Float32MultiArray[] data\nuint16 outer_start_index\nuint16 inner_start_index\n",
}
"""Of ROS 2, where the header stands in the map."""


def write_run(folder: Path, run: RunArtifacts) -> str:
    """Write the bag of a run's terrain as a new folder; what was written, in words.

    Raises
    ------
    InputError
        The package that writes bags is missing.
    """
    risk, tiles, _ = run.world()
    with TemporaryDirectory(dir=folder.parent) as aside:
        bag = Path(aside) / "grid_map"  # a bag's files have the name of its folder
        write(bag, risk, tiles)
        bag.rename(folder)
    return f"{TOPIC} of {risk['risk'].size} cells, for ros2 bag play"


def write(folder: Path, risk: Bundle, tiles: Sequence[Bundle]) -> None:
    """Write a bag of a risk map and of the tiles of the merged terrain; ``folder`` must not exist."""
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise InputError(
            "RIL-958", "bags are written by the package rosbags", remedy="pip install 'rille[robots]'"
        ) from error
    types = get_typestore(Stores.ROS2_HUMBLE)
    for kind, text in DEFINITIONS.items():
        types.register(get_types_from_msg(text, kind))

    def make(kind: str, *values: Any) -> Any:
        return types.types[kind](*values)

    lattice, classes = Lattice.from_dict(risk.meta["lattice"]), np.asarray(risk["risk"], np.float32)
    layers = {
        "elevation": whole(tiles, "elevation", lattice)[1],
        "sigma": whole(tiles, "elevation_std", lattice)[1],
        "risk": np.where(classes == UNKNOWN, np.float32(np.nan), classes),
        "p_hazard": np.asarray(risk["p_hazard"], np.float32),
    }
    # The pose of a grid map is its centre (GridMapInfo), not a corner.
    left, right, bottom, top = lattice.bounds
    middle = make("geometry_msgs/msg/Point", 0.5 * (left + right), 0.5 * (bottom + top), 0.0)
    pose = make("geometry_msgs/msg/Pose", middle, make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0))
    info = make("grid_map_msgs/msg/GridMapInfo", lattice.cell, right - left, top - bottom, pose)
    # By these labels grid_map_ros knows storage by columns: the outer dimension must be called column_index.
    dimensions = [
        make("std_msgs/msg/MultiArrayDimension", "column_index", lattice.rows, lattice.rows * lattice.cols),
        make("std_msgs/msg/MultiArrayDimension", "row_index", lattice.cols, lattice.cols),
    ]
    layout = make("std_msgs/msg/MultiArrayLayout", dimensions, 0)
    # a column of a grid map is one row of a raster, from the greatest x
    data = [make("std_msgs/msg/Float32MultiArray", layout, values[:, ::-1].ravel()) for values in layers.values()]
    header = make("std_msgs/msg/Header", make("builtin_interfaces/msg/Time", 0, 0), FRAME)
    # Basic layers decide which cells are valid (GridMap::isValid): one with elevation but without risk is.
    message = make(MESSAGE, header, info, list(layers), ["elevation"], data, 0, 0)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection(TOPIC, MESSAGE, typestore=types)
        writer.write(topic, 0, types.serialize_cdr(message, MESSAGE))
