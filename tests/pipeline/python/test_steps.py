"""Step by step from Python: the values of a run and of the command line, to the bit."""

from __future__ import annotations

import doctest
import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
import xarray
from raising import raises

import rille
from rille.pipeline.cli import main
from rille.pipeline.engine import events
from rille.pipeline.engine.store.base import Store
from rille.pipeline.python import arguments, steps
from rille.pipeline.python import sequence as sequences
from rille.pipeline.report import summary
from rille.pipeline.runs import run_files

MOCKUP = {"frames": 3, "image_width": 285, "image_height": 260, "focal_length": 300.0}
VEHICLE = {"wheel_diameter": 0.05, "track": 0.08, "wheel_base": 0.1, "clearance": 0.03, "max_step": 0.012}


@pytest.fixture(scope="module")
def pair() -> rille.StereoPair:
    return rille.open("mockup-short", mockup=MOCKUP)[0]


@pytest.fixture(scope="module")
def disparity(pair: rille.StereoPair) -> Any:
    return rille.match(pair.left, pair.right, preset="fast")


@pytest.fixture(scope="module")
def dem(pair: rille.StereoPair, disparity: Any) -> Any:
    return rille.terrain(disparity, pair, cell_size=0.004)


def test_its_examples_run() -> None:
    found = [doctest.testmod(module) for module in (steps, sequences, arguments)]
    assert sum(each.attempted for each in found) >= 8
    assert not any(each.failed for each in found)


def test_a_pair_is_the_same_in_another_process(pair: rille.StereoPair) -> None:
    there = pickle.loads(pickle.dumps(pair))
    assert (there.frame, there.sequence.source.opened) == (pair.frame, pair.sequence.source.opened)
    np.testing.assert_array_equal(there.left, pair.left)


def test_a_sequence_is_the_same_from_another_folder(pair: rille.StereoPair, tmp_path: Path, monkeypatch: Any) -> None:
    for side in ("left", "right"):
        (tmp_path / "here" / side).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "here" / side / "000.png"), np.asarray(getattr(pair, side)))
    (tmp_path / "here/calib.txt").write_text("300 0 142 0 0 300 129 0 0 0 1 0\n300 0 142 -29 0 300 129 0 0 0 1 0\n")
    monkeypatch.chdir(tmp_path)
    there = pickle.dumps(rille.open("here"))
    monkeypatch.chdir("/")
    np.testing.assert_array_equal(pickle.loads(there)[0].left, pair.left)


def test_each_step_has_the_values_of_a_run(pair: rille.StereoPair, disparity: Any, dem: Any, tmp_path: Path) -> None:
    given: Any = {"hfvm": {"preset": "fast"}, "locus": {"cell_size": 0.004}, "crosscheck": {"enabled": False}}
    places: Any = {"runs": tmp_path / "runs", "cache": tmp_path / "cache", "executor": "inline"}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(run_files, "MODULES", (summary,))  # no files and figures
        run = rille.reconstruct(pair.sequence, **places, **given)
    keys = {row["label"]: (row["stage"], row["key"]) for row in events.read(run.folder / "ledger.jsonl")}
    store = Store(tmp_path / "cache")
    hazards = rille.hazards(dem)
    ours = {"hfvm/0": disparity, "locus/local/0": dem, "risk/local/0": hazards, "path/local/0": rille.path(hazards)}
    for label, found in ours.items():
        stored = store.open(store.lookup(*keys[label]))
        assert set(stored.arrays) == set(found.data_vars)
        for name in stored.arrays:
            np.testing.assert_array_equal(found[name], stored[name], err_msg=f"{label} {name}")


def test_match_refuses_grey_values_of_another_scale() -> None:
    right = np.random.default_rng(1).random((40, 60))
    for other in (right, (right - 0.5) / 0.3, 65535 * right):
        with raises("RIL-973", "the right image"):
            rille.match(np.float32(255) * right, other)


@pytest.mark.parametrize(("gain", "black", "kind"), [(1, 0, "<u2"), (1, 0, ">u2"), (4, 0, "<u2"), (1, 29000, "<u2")])
def test_match_spreads_samples_of_16_bits_as_the_command_does(gain: int, black: int, kind: str) -> None:
    import cv2

    scene = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 256, (60, 90)).astype(np.uint8), (0, 0), 1.5)
    left, right = ((gain * image.astype(kind) + black).astype(kind) for image in (scene[:, 3:], scene[:, :-3]))
    with pytest.warns(UserWarning, match="RIL-705"):
        found = rille.match(left, right)
    assert abs(float(found.column_disparity.median()) - 3) < 0.1


@pytest.mark.parametrize("every", [0, -1, 1.5, None, "2", 10**30])
def test_points_are_of_each_so_many_th_row(pair: rille.StereoPair, disparity: Any, every: Any) -> None:
    with raises("RIL-867", "every"):
        rille.points(disparity, pair, every)


def test_match_takes_named_dimensions_in_either_order() -> None:
    left = np.random.default_rng(1).integers(0, 256, (40, 60)).astype(np.uint8)
    plain = rille.match(left, np.roll(left, -3, 1))
    turned = [xarray.DataArray(image.T, dims=("x", "y")) for image in (left, np.roll(left, -3, 1))]
    np.testing.assert_array_equal(rille.match(*turned).column_disparity, plain.column_disparity)


def test_match_leaves_out_what_is_masked() -> None:
    left = np.random.default_rng(1).integers(0, 256, (80, 120)).astype(np.uint8)
    masked = np.ma.masked_array(left, mask=np.arange(120) < 60 + np.zeros((80, 1)))
    found = np.isfinite(rille.match(masked, np.roll(left, -3, 1)).column_disparity)
    assert found[:, 70:100].all()
    assert not found[:, :40].any()


def test_match_warns_of_images_that_do_not_fit() -> None:
    left, right = (np.random.default_rng(k).integers(0, 256, (80, 120)).astype(np.uint8) for k in (1, 2))
    with pytest.warns(UserWarning, match="RIL-700"):
        rille.match(left, right)


def test_the_package_says_its_version_and_what_it_raises() -> None:
    with pytest.raises(rille.RilleError):
        rille.open("nix")
    assert rille.__version__ in Path("pyproject.toml").read_text(encoding="utf-8")


def test_match_has_the_values_of_the_command(pair: rille.StereoPair, tmp_path: Path) -> None:
    import cv2

    for camera in ("left", "right"):
        cv2.imwrite(str(tmp_path / f"{camera}.png"), np.asarray(getattr(pair, camera)))
    out = tmp_path / "d.tif"
    with pytest.raises(SystemExit, match="0"):
        main(["match", *(str(tmp_path / f"{c}.png") for c in ("left", "right")), "--dense", "-o", str(out)])
    images = [cv2.imread(str(tmp_path / f"{c}.png"), cv2.IMREAD_GRAYSCALE) for c in ("left", "right")]
    found = rille.match(*images)
    with rasterio.open(out) as file:
        column, row = file.read()
    np.testing.assert_array_equal(found.column_disparity, column)
    np.testing.assert_array_equal(found.row_disparity, row)


def test_places_and_goals_are_in_metres(dem: Any) -> None:
    assert float(dem.x[1] - dem.x[0]) == pytest.approx(0.004)
    assert dem.elevation.units == "m"
    hazards = rille.hazards(dem, vehicle=VEHICLE)
    free = np.argwhere(np.asarray(hazards.risk) == 0)
    goal = tuple(float(v) for v in (hazards.x[free[0, 1]], hazards.y[free[0, 0]]))
    found = rille.path(hazards, goal=goal)
    if found.sizes["vertex"]:
        assert np.asarray(found.path[-1, :2]) == pytest.approx(goal, abs=0.004)
    else:
        assert found.attrs["reason"]
    with raises("RIL-406", "999"):
        rille.path(hazards, target=(999.0, 999.0))


def test_the_vehicle_may_be_a_file(dem: Any, tmp_path: Path) -> None:
    (tmp_path / "rover.toml").write_text("[vehicle]\n" + "".join(f"{k} = {v}\n" for k, v in VEHICLE.items()))
    one, other = rille.hazards(dem, vehicle=tmp_path / "rover.toml"), rille.hazards(dem, vehicle=VEHICLE)
    np.testing.assert_array_equal(one.risk, other.risk)


def test_settings_may_be_numbers_of_numpy(disparity: Any, pair: rille.StereoPair) -> None:
    dem = rille.terrain(disparity, pair, cell_size=np.float32(0.009))
    # By its own digits, not those of the double that is nearest to its bits.
    assert json.loads(dem.attrs["rille"])["settings"]["locus"]["cell_size"] == 0.009
    plane = [0.0, 0.0, -1.0, 0.0, 0.0, 0.5]
    one, other = (rille.terrain(disparity, pair, reference=given, cell_size=0.01) for given in (plane, np.array(plane)))
    np.testing.assert_array_equal(one.elevation, other.elevation)


def test_points_have_the_colours_of_the_left_image(pair: rille.StereoPair, disparity: Any, tmp_path: Path) -> None:
    import cv2

    grey = np.asarray(pair.left)
    cv2.imwrite(str(tmp_path / "left.png"), np.stack([grey // 2, grey // 3, grey], axis=2))  # blue, green, red
    cv2.imwrite(str(tmp_path / "right.png"), np.asarray(pair.right))
    (tmp_path / "m.toml").write_text(
        '[images]\nleft = "left.png"\nright = "right.png"\n[cameras]\nfx = 300.0\ncx = 142.0\ncy = 129.5\n'
        "[rig]\nbaseline = 0.1\n"
    )
    with pytest.warns(UserWarning, match="RIL-796"):
        cloud = rille.points(disparity, rille.open(tmp_path / "m.toml")[0], every=5)
    column, row = cloud.pixel.values.T
    there = grey[row, column]
    np.testing.assert_array_equal(cloud.colour, np.stack([there, there // 3, there // 2], axis=1))


def test_what_does_not_fit_is_one_clear_line(pair: rille.StereoPair, disparity: Any, dem: Any) -> None:
    import xarray

    with pytest.raises(IndexError):
        pair.sequence[3]
    assert pair.sequence[-1].frame == 2
    assert [p.frame for p in pair.sequence] == [0, 1, 2]
    with raises("RIL-748", "'middle'"):
        pair.taken("middle")
    with raises("RIL-864", "rille.terrain"):
        rille.hazards(xarray.Dataset())
    for step, other, maker in (
        (lambda data: rille.terrain(data, pair), dem, "rille.match"),
        (lambda data: rille.terrain(data, pair), pair.left, "rille.match"),
        (rille.hazards, disparity, "rille.terrain"),
        (rille.path, dem, "rille.hazards"),
        (rille.hazards, np.zeros((3, 3)), "rille.reconstruct(..., vehicle="),
        (lambda data: rille.points(data, pair), np.zeros((260, 285)), "[disparity] of a manifest"),
    ):
        with raises("RIL-864", maker):
            step(other)
    for changed in (dem.isel(row=slice(20, None)), dem.sortby("y"), dem.transpose(), dem.thin(col=2)):
        with raises("RIL-864", "rille.terrain returns, whole"):
            rille.hazards(changed)
    for attributes in ({}, {"rille": "of my own"}, {"rille": "[1]"}):
        with raises("RIL-864", "attribute rille", "data.attrs = MADE.attrs", "rille.terrain", "vehicle="):
            rille.hazards(dem.drop_attrs().assign_attrs(attributes))
    hazards = rille.hazards(dem, vehicle=VEHICLE)
    for bands, name in ((["risk"], "reason"), (["risk", "reason"], "elevation")):
        with raises("RIL-864", f"no {name}", "rille.hazards"):
            rille.path(hazards[bands])
    with raises("RIL-864", "row_disparity"):
        rille.terrain(disparity[["column_disparity"]], pair)
    with raises("RIL-864", "validity (row, col)"):
        rille.terrain(disparity.assign(validity=disparity.validity.T), pair)
    for wrong in (disparity.validity + 0.5, disparity.validity.astype(str), disparity.validity.astype(int) - 300):
        with raises("RIL-971", "validity"):
            rille.terrain(disparity.assign(validity=wrong), pair)
    with raises("RIL-674", "rille.open(...)[0]"):
        rille.terrain(disparity, pair.sequence)
    for image, name in ((disparity, "Dataset"), ([[1, 2], [3]], "list"), ("left.png", "left.png")):
        with raises("RIL-675", name):
            rille.match(image, pair.right)
    with raises("RIL-865", "(260, 285)"):
        rille.terrain(disparity.isel(row=slice(5)), pair)
    with raises("RIL-027", "hfvm.no"):
        rille.match(pair.left, pair.right, no=1)
    with raises("RIL-861", "vehicle=3"):
        rille.hazards(dem, vehicle=3)
    with raises("RIL-027", "vehicle.wings"):
        rille.hazards(dem, vehicle={"wings": 2})
    with raises("RIL-027", "path.target = 3"):
        rille.path(rille.hazards(dem), goal=3)  # type: ignore[arg-type]


def test_the_disparity_of_another_pair_is_named(pair: rille.StereoPair, disparity: Any, tmp_path: Path) -> None:
    other, own = pair.sequence[1], np.asarray
    disparity.to_netcdf(tmp_path / "d.nc")
    for step in (rille.terrain, rille.points):
        with pytest.warns(UserWarning, match=r"RIL-796.* left image of pair 1 of mockup-short"):
            step(xarray.load_dataset(tmp_path / "d.nc"), other)
    with pytest.warns(UserWarning, match=r"RIL-796.* right image of pair 0"):
        rille.points(rille.match(own(pair.left), other.right, preset="fast"), pair)
    of_arrays = rille.match(own(pair.left), own(pair.right), preset="fast")  # such as images that a user has sharpened
    assert rille.points(of_arrays, pair, every=9).sizes["point"] > 100


def test_what_a_user_draws_into_an_image_stays_with_them() -> None:
    pair = rille.open("mockup-short", mockup=MOCKUP | {"frames": 1})[0]
    before = pair.left
    pair.left[:50] = 0
    np.testing.assert_array_equal(pair.left, before)


def test_pairs_are_counted_by_whole_numbers(pair: rille.StereoPair) -> None:
    sequence = pair.sequence
    assert sequence[-1] == sequence[np.int64(2)] == sequence[2]
    assert [p.frame for p in sequence[::-2]] == [2, 0]
    lossy = rille.StereoSequence(replace(sequence.source, lost={1: "no left image"}))
    assert [p.frame for p in lossy[0:3]] == [p.frame for p in lossy] == [0, 2]
    for wrong in ("000000", 1.0, None, [0, 1], slice("a"), slice(0, 3, 0)):
        with raises("RIL-747", repr(wrong)):
            _ = sequence[wrong]  # type: ignore[index]
    assert repr(sequence) == "<StereoSequence mockup-short: 3 pairs>"


def test_pixels_are_masked_by_their_validity(pair: rille.StereoPair, disparity: Any, dem: Any) -> None:
    sure = disparity.disparity_std < float(disparity.disparity_std.median())
    of_one = disparity.assign(validity=disparity.validity.where(sure, 0))
    fewer = rille.terrain(of_one, pair, cell_size=0.004)
    assert 0 < int(fewer.elevation.notnull().sum()) < int(dem.elevation.notnull().sum())
    of_column = disparity.assign(column_disparity=disparity.column_disparity.where(sure))
    for masked in (disparity.where(sure), of_column):
        found = rille.terrain(masked, pair, cell_size=0.004)
        np.testing.assert_array_equal(found.elevation, fewer.elevation)
        assert len(rille.points(masked, pair).point) == len(rille.points(of_one, pair).point)


def test_masked_cells_of_a_risk_map_are_unknown(dem: Any) -> None:
    hazards = rille.hazards(dem, vehicle=VEHICLE)
    near = hazards.y < float(hazards.y.median())
    of_risk = hazards.assign(risk=hazards.risk.where(near, 3), reason=hazards.reason.where(near, 128))
    of_risk["elevation"] = of_risk.elevation.where(near)
    found, told = (rille.path(masked) for masked in (hazards.where(near), of_risk))
    assert found.sizes["vertex"] > 1
    np.testing.assert_array_equal(found.path, told.path)
    assert float(found.path[:, 1].max()) < float(hazards.y.median())


@pytest.mark.parametrize("more", [(), ("validity",)])
def test_two_bands_without_attributes_are_a_disparity(
    more: tuple[str, ...], pair: rille.StereoPair, disparity: Any, dem: Any
) -> None:
    bands = disparity[["column_disparity", "row_disparity", *more]].drop_attrs()
    found = rille.terrain(bands, pair, cell_size=0.004)
    both = found.elevation.notnull() & dem.elevation.notnull()
    assert int(both.sum()) > 0.9 * int(dem.elevation.notnull().sum())
    assert float(abs(found.elevation - dem.elevation).where(both).median()) < 0.001
    thin, thick = (
        rille.points(bands.assign_attrs(rille=json.dumps({"settings": {"locus": {"sigma_disparity": sigma}}})), pair)
        for sigma in (0.2, 0.3)
    )
    assert float(thick.sigma_along[0] / thin.sigma_along[0]) == pytest.approx(1.5)
    assert len(rille.points(bands, pair).point) == len(thin.point), "0.2 px by default"
