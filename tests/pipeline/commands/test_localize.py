"""``rille localize``: the place of a run in maps of other programs; no place, and no map, are one clear line each."""

from __future__ import annotations

import json
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
from affine import Affine
from map_runs import Frame, centres, grey, height, made_map, made_run
from raising import raises

from rille.datasets.georeference import Georeference
from rille.pipeline import cli
from rille.pipeline.commands.results import localize
from rille.stages.geometry.geometry import RigidTransform

FRAME = Frame(0.4, -0.6, 0.25, yaw=130.0, tilt=0.3)
UTM = "EPSG:32633"
GROUND = Affine.translation(500100.0, 5200200.0) @ Affine.rotation(25.0)
"""From the ground's x, y to the map's system."""
RASTERS = {
    "turned": Affine.translation(-4.0, 4.0) @ Affine.scale(0.1, -0.1),
    "upside down": Affine.translation(-4.0, -4.0) @ Affine.scale(0.1, 0.1),
    "fine": Affine.translation(-2.5, 2.0) @ Affine.scale(0.02, -0.02),
}


def elevations(path: Path, raster: Affine, to_map: Affine = GROUND, noise: float = 0.005, **more: Any) -> Path:
    size = 80 if abs(raster.a) > 0.05 else 230
    x, y = centres(size, size, raster)
    z = 100.0 + height(x, y) + noise * np.random.default_rng(2).standard_normal(x.shape)
    return made_map(path, z.astype(np.float32), to_map @ raster, **{"crs": UTM} | more)


def run(folder: Path, dem: Path | None, output: Path, **more: Any) -> int:
    return localize.localize(str(folder), dem, output=output, cache=str(output.parent / "cache"), **more)


def truth(to_map: Affine = GROUND, lift: float = 100.0) -> RigidTransform:
    own = FRAME.pose
    turn = np.array([[to_map.a, to_map.b, 0.0], [to_map.d, to_map.e, 0.0], [0.0, 0.0, 1.0]])
    return RigidTransform(turn @ own.rotation, turn @ own.translation + [to_map.c, to_map.f, lift])


def facts(output: Path) -> dict[str, Any]:
    return dict(json.loads(output.with_suffix(".json").read_text()))


@pytest.mark.parametrize("name", RASTERS)
def test_a_run_is_found_in_a_map_that_is_turned_mirrored_or_as_fine(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    dem = elevations(tmp_path / "map.tif", RASTERS[name])
    out = tmp_path / "out"
    assert run(made_run(tmp_path / "run", FRAME), dem, out) == 0
    found, true = facts(out), truth()
    T = RigidTransform.from_matrix(found["T_map_world"])
    sigma = np.array([found["sigma"][key] for key in ("x_m", "y_m", "z_m")])
    assert (np.abs(T.translation - true.translation) < 4 * sigma + 2e-3).all()
    assert sigma.max() < 0.03
    assert found["place"]["yaw_deg"] == pytest.approx(130.0 + 25.0, abs=4 * found["sigma"]["yaw_deg"] + 0.02)
    assert T.rotation == pytest.approx(true.rotation, abs=5e-3)
    row = np.loadtxt(out.with_suffix(".tum"))
    assert row[1:4] == pytest.approx(T.apply([0.1, 0.2, 0.3]))
    said = capsys.readouterr().out
    assert "UTM zone 33N" in said
    world = tomllib.loads(said[said.index("[world]") :])["world"]
    place = Georeference(world["crs"], tuple(world["origin"]), math.radians(world["azimuth_deg"]))
    assert place.crs == UTM
    assert place.origin == pytest.approx(T.translation, abs=1e-3)
    cos, sin = math.cos(place.azimuth), math.sin(place.azimuth)
    assert T.rotation[:2, :2] == pytest.approx(np.array([[cos, sin], [-sin, cos]]), abs=0.02)


def test_flat_ground_has_no_place_and_no_trajectory_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(1)
    flat = made_map(tmp_path / "flat.tif", rng.normal(0, 0.005, (80, 80)).astype(np.float32), RASTERS["turned"])
    (tmp_path / "out.tum").write_text("of an earlier map")
    assert run(made_run(tmp_path / "run", FRAME), flat, tmp_path / "out") == 3
    assert facts(tmp_path / "out")["ambiguous"] is True
    assert not (tmp_path / "out.tum").exists()
    assert capsys.readouterr().out.startswith("ambiguous ")


def test_a_start_bounds_the_search(tmp_path: Path) -> None:
    dem, folder, true = elevations(tmp_path / "map.tif", RASTERS["turned"]), made_run(tmp_path / "run", FRAME), truth()
    x, y, _ = true.translation
    near = localize.Area(f"{x + 0.3},{y - 0.2},150", 0.5)
    assert run(folder, dem, tmp_path / "near", area=near) == 0
    assert facts(tmp_path / "near")["place"]["x_m"] == pytest.approx(x, abs=0.05)
    assert run(folder, dem, tmp_path / "far", area=localize.Area(f"{x + 2.0},{y},150", 0.5)) == 3


def image(path: Path, cell: float, to_map: Affine = GROUND) -> Path:
    raster = Affine.translation(-3.0, 3.0) @ Affine.scale(cell, -cell)
    size = round(6.0 / cell)
    # Means, as a camera takes them: samples of finer texture would be noise.
    fine = grey(*centres(4 * size, 4 * size, raster @ Affine.scale(0.25)))
    mean = fine.reshape(size, 4, size, 4).mean(axis=(1, 3))
    return made_map(path, mean.astype(np.uint8), to_map @ raster, crs=UTM)


def test_an_ortho_image_tells_x_y_and_yaw_and_bounds_the_elevations(tmp_path: Path) -> None:
    folder, true = made_run(tmp_path / "run", FRAME), truth()
    ortho = image(tmp_path / "ortho.tif", 0.04)
    assert run(folder, None, tmp_path / "alone", ortho=ortho) == 0
    found = facts(tmp_path / "alone")
    assert set(found["place"]) == {"x_m", "y_m", "yaw_deg"}
    for name, value in {"x_m": true.translation[0], "y_m": true.translation[1], "yaw_deg": 155.0}.items():
        assert abs(found["place"][name] - value) < 5.0 * found["sigma"][name], name
    assert found["sigma"]["x_m"] < 0.02
    dem = elevations(tmp_path / "map.tif", RASTERS["turned"])
    assert run(folder, dem, tmp_path / "both", ortho=ortho) == 0
    assert facts(tmp_path / "both")["keypoints"] == found["keypoints"]


def test_an_ortho_image_of_another_place_is_said_and_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, dem = made_run(tmp_path / "run", FRAME), elevations(tmp_path / "map.tif", RASTERS["turned"])
    noise = np.random.default_rng(3).integers(0, 255, (100, 100)).astype(np.uint8)
    other = made_map(tmp_path / "other.tif", noise, GROUND @ RASTERS["turned"], crs=UTM)
    assert run(folder, dem, tmp_path / "out", ortho=other) == 0
    assert "RIL-327" in capsys.readouterr().err
    assert run(folder, None, tmp_path / "alone", ortho=other) == 3


def test_input_that_is_no_map_is_one_line_each(tmp_path: Path) -> None:
    folder, dem = made_run(tmp_path / "run", FRAME), elevations(tmp_path / "map.tif", RASTERS["turned"])
    place = Georeference("EPSG:32632", (0.0, 0.0, 0.0), 0.0)
    elsewhere = made_run(tmp_path / "elsewhere", FRAME, place)
    unknown = made_map(tmp_path / "unknown.tif", np.full((80, 80), np.nan, np.float32), RASTERS["turned"])
    small = made_map(tmp_path / "small.tif", np.zeros((12, 12), np.float32), RASTERS["turned"])
    coarse = made_map(tmp_path / "coarse.tif", np.zeros((9, 9), np.float32), Affine.scale(2.0, -2.0))
    placeless = made_map(tmp_path / "placeless.tif", np.zeros((80, 80), np.float32), Affine.identity())
    degrees = elevations(tmp_path / "degrees.tif", RASTERS["turned"], crs="EPSG:4326")
    colours, about = tmp_path / "colours.tif", {"width": 80, "height": 80, "count": 3, "dtype": "uint8"}
    with rasterio.open(colours, "w", driver="GTiff", transform=RASTERS["turned"], **about) as file:
        file.write(np.zeros((3, 80, 80), np.uint8))
    plane = made_run(tmp_path / "plane", FRAME, vertical="reference plane")
    empty = made_run(tmp_path / "empty", FRAME, known=math.nan)
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "ledger.jsonl").write_text("")
    cases: list[tuple[str, Path, Path | None, dict[str, Any]]] = [
        ("RIL-844", folder, None, {}),
        ("RIL-846", folder, dem, {"area": localize.Area(within=3.0)}),
        ("RIL-847", folder, dem, {"area": localize.Area("here")}),
        ("RIL-847", folder, dem, {"area": localize.Area("1,2,3,4")}),
        ("RIL-615", elsewhere, dem, {}),
        ("RIL-628", folder, unknown, {}),
        ("RIL-338", folder, small, {}),
        ("RIL-630", folder, placeless, {}),
        ("RIL-633", folder, degrees, {}),
        ("RIL-636", folder, colours, {}),
        ("RIL-627", folder, tmp_path / "none.tif", {}),
        ("RIL-842", plane, dem, {}),
        ("RIL-843", empty, dem, {}),
        ("RIL-862", bare, dem, {}),
    ]
    for code, where, what, more in cases:
        with raises(code):
            run(where, what, tmp_path / "out", **more)
    assert run(folder, coarse, tmp_path / "out") == 3  # RIL-337: a handful of cells determines nothing


def test_the_command_reads_its_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, dem = made_run(tmp_path / "run", FRAME), elevations(tmp_path / "map.tif", RASTERS["turned"])
    x, y, _ = truth().translation
    words = ["localize", str(folder), str(dem), f"--near={x},{y},155", "--within", "1", "-o", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as end:
        cli.main([*words, "--cache", str(tmp_path / "cache")])
    assert end.value.code == 0
    assert "yaw" in capsys.readouterr().out
