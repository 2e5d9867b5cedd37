"""Rasters of each stereo pair in the geometry of its left image (GeoTIFF, float32).

Names as used by rover teams (VICAR): XYZ, RNG and RNE (range and its error), UVW (surface normal), SLP (slope), RUF
(roughness), DSP (disparity). Positions and normals are in the world frame; metadata of a raster describe its camera.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rille.pipeline.export.programs.placed_pairs import PlacedPair, PlacedPairs
from rille.pipeline.export.programs.run_artifacts import RunArtifacts
from rille.pipeline.export.writers import FRAME, WORLDS, Meaning, write_bands
from rille.stages.core.arrays import Floats32
from rille.stages.core.validity import matched
from rille.stages.terrain.camera_products import camera_products

PROFILE = {"driver": "GTiff", "tiled": True, "blockxsize": 256, "blockysize": 256, "predictor": 3}

Bands = Mapping[str, Floats32]


def write_run(folder: Path, run: RunArtifacts) -> str:
    """Write the rasters of every pair into a new folder; return its content, in words."""
    pairs = PlacedPairs(run)
    folder.mkdir()
    for one in pairs:
        tags = _tags(one)
        for name, bands, unit, words in _products(one):
            about = {"frame": WORLDS.get(pairs.vertical, FRAME), "unit": unit, "content": words, **tags}
            write_bands(folder / f"{one.pair:06d}_{name}.tif", bands, Meaning(unit, np.nan, about), PROFILE)
    return f"XYZ, RNG, RNE, UVW, SLP, RUF and DSP of {pairs.words}"


def _products(one: PlacedPair) -> Iterator[tuple[str, Bands, str, str]]:
    """Name, bands, unit and meaning of each raster of a pair."""
    found = camera_products(one.points, one.rig.left)
    turned = found.normal @ one.T_world_left.rotation.T
    place = one.T_world_left.apply(found.position.reshape(-1, 3)).reshape(found.position.shape)
    yield "XYZ", _named("xyz", place), "m", "position"
    yield "RNG", {"range": found.distance}, "m", "distance from the left camera's centre"
    yield "RNE", {"range_error": found.sigma}, "m", "standard deviation of the range; errors of the rig are not in it"
    yield "UVW", _named("uvw", turned), "1", "unit surface normal, towards the camera"
    slope = np.degrees(np.arccos(np.clip(turned[..., 2], -1.0, 1.0))).astype(np.float32)
    yield "SLP", {"slope": slope}, "degree", "angle between the normal and up"
    yield "RUF", {"roughness": found.roughness}, "m", "root mean square distance from the plane of 11 x 11 pixels"
    there = matched(np.asarray(one.disparity["validity"]))
    names = "column_disparity", "row_disparity", "disparity_std"
    bands = {name: np.where(there, one.disparity[name], np.float32(np.nan)) for name in names}
    yield "DSP", bands, "pixel", "right minus left, and its standard deviation along the epipolar line"


def _named(names: str, values: Any) -> Bands:
    return {name: np.ascontiguousarray(values[..., k], np.float32) for k, name in enumerate(names)}


def _tags(one: PlacedPair) -> dict[str, str]:
    """The left camera: focal lengths and principal point (pixels), and its pose (3 x 4, row by row, metres)."""
    camera, pose = one.rig.left, one.T_world_left.matrix34.ravel()
    return {
        "pair": str(one.pair),
        "camera_fx_fy_cx_cy": " ".join(f"{v:.12g}" for v in (camera.fx, camera.fy, camera.cx, camera.cy)),
        "camera_T_world_left": " ".join(f"{v:.12g}" for v in pose),
    }
