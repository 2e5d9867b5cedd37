"""Points of a run as LAZ and PLY, read back by other programs."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
import trimesh
from raising import raises

from rille.datasets.georeference import Georeference
from rille.pipeline.export.programs.cloud import write_run
from rille.stages.core.declare import Bundle
from rille.stages.core.validity import Validity
from rille.stages.geometry.geometry import Camera, Rig, RigidTransform, rotation_exp

CAMERA = Camera(40.0, 41.0, 19.5, 14.5, 40, 30)
RIG = Rig(CAMERA, CAMERA, RigidTransform(np.eye(3), np.array([-0.2, 0.0, 0.0])))
POSES = {3: RigidTransform(rotation_exp([-1.5, 0.1, 0.2]), np.array([0.5, 2.0, 1.0]))}
POSES[5] = RigidTransform(rotation_exp([-1.4, 0.0, 0.1]), np.array([0.6, 3.0, 1.1]))
PLACE = Georeference("EPSG:32633", (400000.25, 5200000.5, 1800.0), 0.7)
SHAPE = CAMERA.height, CAMERA.width
DEPTH = {3: 4.0, 5: 6.0, 9: 2.0}


class Recorded:
    """A run in memory: three pairs before walls, the last of which is not in the world."""

    def __init__(self, folder: Path, place: Georeference | None = None) -> None:
        self.run = folder
        folder.mkdir(exist_ok=True)
        about = {"georeference": None if place is None else place.to_dict()}
        (folder / "frames.json").write_text(json.dumps(about))
        poses = np.array([POSES[3].matrix34, np.full((3, 4), np.nan), POSES[5].matrix34, POSES[5].matrix34])
        facts = {"frames": [3, 4, 5, 9], "main": 1, "verticals": ["ground", "ground"]}
        self.made: dict[str, Bundle] = {
            "trajectory": Bundle({"poses": poses, "piece": np.array([1, -1, 1, 0], np.int16)}, facts),
            "calibration": Bundle({}, {"rig": RIG.to_dict()}),
        }
        for pair, depth in DEPTH.items():
            validity = np.full(SHAPE, Validity.MATCHED, np.uint8)
            validity[:2] = Validity.INTERPOLATED
            arrays = {
                "column_disparity": np.full(SHAPE, -0.2 * CAMERA.fx / depth, np.float32),
                "row_disparity": np.zeros(SHAPE, np.float32),
                "disparity_std": np.full(SHAPE, 0.1, np.float32),
                "validity": validity,
            }
            grey = np.full(SHAPE, 10 * pair, np.uint8)
            self.made |= {f"hfvm/{pair}": Bundle(arrays, {}), f"image/left/{pair}": Bundle({"image": grey}, {})}

    def one(self, label: str, *, last: bool = False) -> Bundle:
        return self.made[label]

    def left_image(self, frame: int) -> Bundle:
        return self.made[f"image/left/{frame}"]

    def input(self, label: str, port: str) -> Bundle:
        return self.made["calibration"]

    def labels(self, pattern: str) -> list[str]:
        return [match[1] for name in self.made if (match := re.fullmatch(pattern, name))]


def expected(every: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Where the points of both pairs lie in the world, and their pairs."""
    v, u = np.mgrid[: CAMERA.height : every, : CAMERA.width : every]
    keep = v.ravel() >= 2
    rays = CAMERA.rays(np.stack([u.ravel(), v.ravel()], 1)[keep].astype(float))
    parts = [POSES[pair].apply(rays * DEPTH[pair]) for pair in (3, 5)]
    return np.concatenate(parts), np.repeat([3, 5], len(rays))


def written(run: Any, path: Path, **thinning: Any) -> str:
    return write_run(path, run, **thinning)


@pytest.mark.parametrize("place", [None, PLACE])
def test_laspy_reads_every_matched_pixel(tmp_path: Path, place: Georeference | None) -> None:
    path = tmp_path / "a.laz"
    words = written(Recorded(tmp_path / "run", place), path)
    position, pair = expected()
    assert words == f"{len(pair)} points of 2 pairs, 1 without a pose are left out"
    las = laspy.read(path)
    assert las.header.are_points_compressed
    written(Recorded(tmp_path / "run", place), path.with_name("A.LAZ"))
    assert path.with_name("A.LAZ").read_bytes() == path.read_bytes()
    where = position if place is None else place.apply(position)
    # The disparity is stored with 24 bits.
    np.testing.assert_allclose(las.xyz, where, atol=las.header.scales[0] + 1e-6)
    np.testing.assert_array_equal(las.pair, pair)
    np.testing.assert_array_equal(np.asarray(las.red) // 257, 10 * pair)
    (wkt,) = [v.string for v in las.header.vlrs if v.record_id == 2112]
    crs = pyproj.CRS.from_wkt(wkt)  # LAS 1.4 knows WKT 1 alone
    assert crs.is_engineering if place is None else crs.to_epsg() == 32633


def test_sigma_and_ray_are_those_of_the_left_camera(tmp_path: Path) -> None:
    written(Recorded(tmp_path / "run", PLACE), tmp_path / "a.laz")
    las = laspy.read(tmp_path / "a.laz")
    ray = np.column_stack([las.ray_x, las.ray_y, las.ray_z])
    np.testing.assert_allclose(np.linalg.norm(ray, axis=1), 1.0, rtol=1e-5)
    first = np.asarray(las.pair) == 3
    centre = PLACE.apply(POSES[3].translation)
    away = np.linalg.norm(las.xyz[first] - centre, axis=1)
    np.testing.assert_allclose(centre + ray[first] * away[:, None], las.xyz[first], atol=1e-2)
    # Z = b f / d: an error of .1 px moves a point by .1 Z / d of its distance.
    np.testing.assert_allclose(np.asarray(las.sigma_along)[first], away * 0.1 * 4.0 / (0.2 * CAMERA.fx), rtol=1e-2)


@pytest.mark.parametrize("place", [None, PLACE])
def test_trimesh_reads_the_same_points(tmp_path: Path, place: Georeference | None) -> None:
    written(Recorded(tmp_path / "run", place), tmp_path / "a.ply", every=3)
    position, pair = expected(every=3)
    cloud = trimesh.load(tmp_path / "a.ply")
    np.testing.assert_allclose(cloud.vertices, position if place is None else place.apply(position), atol=2e-6)
    np.testing.assert_array_equal(cloud.colors[:, 0], 10 * pair)
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0].decode()
    assert "property int pair" in header  # Open3D leaves out what is uint
    crs = pyproj.CRS.from_wkt(header.split("comment crs ")[1].splitlines()[0])
    assert crs.is_engineering if place is None else crs.to_epsg() == 32633


@pytest.mark.parametrize("place", [None, PLACE])
def test_of_a_voxel_one_point_stays_the_first_pair_s(tmp_path: Path, place: Georeference | None) -> None:
    run = Recorded(tmp_path / "run", place)
    written(run, tmp_path / "all.ply")
    written(run, tmp_path / "thin.ply", voxel=0.5)
    whole, thin = (trimesh.load(tmp_path / f"{n}.ply") for n in ("all", "thin"))
    origin = 0.0 if place is None else np.array(place.origin)
    cubes = [np.floor((cloud.vertices - origin) / 0.5) for cloud in (whole, thin)]
    assert len(np.unique(cubes[1], axis=0)) == len(cubes[1]) == len(np.unique(cubes[0], axis=0))
    # The grey value is ten times the pair.
    of_first = {tuple(cube) for cube in cubes[0][whole.colors[:, 0] == 30]}
    assert all((tuple(c) in of_first) == (grey == 30) for c, grey in zip(cubes[1], thin.colors[:, 0], strict=True))


def test_equal_runs_make_equal_files(tmp_path: Path) -> None:
    for name in ("a.laz", "a.ply"):
        made = []
        for k in range(2):
            written(Recorded(tmp_path / f"run{k}"), tmp_path / name)
            made.append((tmp_path / name).read_bytes())
        assert made[0] == made[1]
        assert {p.name for p in tmp_path.iterdir()} <= {"run0", "run1", "a.laz", "a.ply"}


def test_a_first_pair_without_points_leaves_the_place_of_the_others(tmp_path: Path) -> None:
    """Offsets and steps of the coordinates are those of the first pair that has points."""
    run = Recorded(tmp_path / "run", PLACE)
    run.made["hfvm/3"].arrays["validity"][:] = Validity.INTERPOLATED  # type: ignore[index]
    written(run, tmp_path / "a.LAZ")
    las = laspy.read(tmp_path / "a.LAZ")
    assert set(las["pair"]) == {5}
    np.testing.assert_allclose(np.median(las.xyz[:, :2], axis=0), PLACE.origin[:2], atol=20.0)
    assert las.header.scales[0] < 0.1


def test_a_run_without_a_posed_pair_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    run = Recorded(tmp_path / "run")
    for pair in (3, 5):
        del run.made[f"hfvm/{pair}"]
    with raises("RIL-613"):
        written(run, tmp_path / "a.laz")
    assert not (tmp_path / "a.laz").exists()
