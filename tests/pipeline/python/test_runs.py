"""The same reconstruction from Python as by the command line, and its results as arrays with coordinates and units."""

from __future__ import annotations

import doctest
import errno
import os
import pickle
import shlex
from pathlib import Path

import numpy as np
import pytest
import rasterio
import xarray
from raising import raises
from toys.browser import Browser

import rille
from rille.pipeline.cli import main
from rille.pipeline.engine import events, keys
from rille.pipeline.flow import config as configuration
from rille.pipeline.python import arguments, runs
from rille.pipeline.runs.options import Options
from rille.stages.core.errors import ConfigError

MOCKUP = {"frames": 3, "image_width": 285, "image_height": 260, "focal_length": 300.0}
STAGES = {"keyframes": {"stride": 2}, "locus": {"cell_size": 0.004}, "hfvm": {"preset": "fast"}}


def digests(run: Path) -> dict[str, str]:
    return {row["label"]: row["digest"] for row in events.read(run / "ledger.jsonl")}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> rille.Run:
    folder = tmp_path_factory.mktemp("api")
    sequence = rille.open("mockup-short", mockup=MOCKUP)
    places = {"runs": folder / "runs", "cache": folder / "cache"}
    return rille.reconstruct(sequence, **places, executor="inline", **STAGES)  # type: ignore[arg-type]


def test_it_gives_the_digests_of_the_command_line(run: rille.Run, capsys: pytest.CaptureFixture[str]) -> None:
    folder = run.folder.parents[2]
    given = [f"--set={word}" for word in arguments.assignments({"mockup": MOCKUP, **STAGES})]
    where = ["--runs", str(folder / "again"), "--cache", str(folder / "cache"), "--executor", "inline", "--quiet"]
    with pytest.raises(SystemExit, match="0"):
        main(["reconstruct", "mockup-short", *given, *where])
    assert "computed 0," in capsys.readouterr().out, "all that it needs was computed from Python"
    assert digests(folder / "again/mockup-short/latest") == digests(run.folder)
    assert len(digests(run.folder)) > 30
    asked = shlex.split(run.report["command"])
    assert asked[:3] == ["rille", "reconstruct", "mockup-short"]
    assert {"--set", *given} == {word if word == "--set" else f"--set={word}" for word in asked[3:]}


def test_each_public_name_stands_in_the_reference() -> None:
    reference = (Path(__file__).parents[3] / "docs/reference/api.md").read_text(encoding="utf-8")
    assert not [name for name in rille.__all__ if f":: {name}" not in reference and f"rille.{name}" not in reference]


def test_terrain_and_trajectory_have_coordinates_and_units(run: rille.Run) -> None:
    assert run.complete, run.report["missing"]
    terrain = run.terrain
    assert set(terrain.elevation.dims) == {"x", "y"}
    assert terrain.elevation.units == terrain.x.units == terrain.y.units == "m"
    assert terrain.cell_size_m == pytest.approx(0.004)
    assert float(terrain.elevation.median()) == np.nanmedian(terrain.elevation)
    assert terrain.chunk().elevation.chunks
    here = float(terrain.elevation.sel(x=0.0, y=0.5, method="nearest"))
    assert -0.25 < here < -0.11, "the camera stands 0.18 m above the bed"
    trajectory = run.trajectory
    assert trajectory.position.units == "m"
    assert trajectory.time.units == "s"
    assert trajectory.sel(frame=0).position.values == pytest.approx(np.zeros(3), abs=1e-9)
    assert float(trajectory.position.sel(frame=2, axis="y")) > 0.01, "it drives ahead"
    each = trajectory.rotation.values
    assert each @ each.transpose(0, 2, 1) == pytest.approx(np.broadcast_to(np.eye(3), each.shape), abs=1e-9)
    assert run.metrics["trajectory_drift"]["unit"] == "%"


def test_the_terrain_is_saved_as_netcdf(run: rille.Run, tmp_path: Path) -> None:
    run.terrain.to_netcdf(tmp_path / "terrain.nc", engine="scipy")
    with xarray.open_dataset(tmp_path / "terrain.nc") as again:
        np.testing.assert_array_equal(again.elevation, run.terrain.elevation)
        assert again.elevation.units == "m"
        assert again.spatial_ref.crs_wkt == run.terrain.spatial_ref.crs_wkt


def test_the_terrain_is_saved_as_zarr(run: rille.Run, tmp_path: Path) -> None:
    run.terrain.to_zarr(tmp_path / "terrain.zarr", consolidated=False)
    again = xarray.open_zarr(tmp_path / "terrain.zarr", consolidated=False)
    np.testing.assert_array_equal(again.elevation, run.terrain.elevation)
    np.testing.assert_array_equal(again["count"], run.terrain["count"])


def test_a_run_stays_where_it_is_when_the_program_changes_its_folder(
    run: rille.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = run.folder.parents[2]
    monkeypatch.chdir(folder)
    sequence = rille.open("mockup-short", mockup=MOCKUP)
    again = rille.reconstruct(sequence, runs="here", cache="cache", executor="inline", **STAGES)  # type: ignore[arg-type]
    monkeypatch.chdir(tmp_path)
    assert again.folder.parents[1] == folder / "here"
    np.testing.assert_array_equal(again.terrain.elevation, run.terrain.elevation)
    assert pickle.loads(pickle.dumps(again)) == rille.open_run(again.folder)


def test_names_are_completed_before_they_are_loaded() -> None:
    assert {*rille.__all__} <= {*dir(rille)}


def test_the_map_of_the_report_answers_with_the_values_of_the_rasters(
    run: rille.Run, chromium: str, tmp_path: Path
) -> None:
    """At ten random places with an elevation; the page stores it in 16 bits and the standard deviation in 8."""
    with rasterio.open(run.folder / "dem.tif") as dem, rasterio.open(run.folder / "dem_sigma.tif") as dem_sigma:
        z, sigma, place = dem.read(1), dem_sigma.read(1), dem.transform
    with rasterio.open(run.folder / "risk.tif") as raster:
        assert raster.transform == place
        risk = raster.read(1)
    rows, cols = np.nonzero(np.isfinite(z))
    step = float(np.nanmax(z) - np.nanmin(z)) / 65534
    browser = Browser(chromium, tmp_path)
    try:
        browser.open(run.folder / "report.html")
        for n in np.random.default_rng(3).choice(len(rows), 10, replace=False):
            cell = int(rows[n]), int(cols[n])
            x, y = place * (cell[1] + 0.5, cell[0] + 0.5)
            found = browser.run(f"document.getElementById('map-view').answer({x}, {y})")
            assert found["elevation"] == pytest.approx(float(z[cell]), abs=step)
            assert found["sigma"] == pytest.approx(float(sigma[cell]), rel=0.02)
            assert found["risk"] == risk[cell]
        assert browser.messages == []
    finally:
        browser.close()


def test_a_run_is_opened_and_shown(run: rille.Run, monkeypatch: pytest.MonkeyPatch) -> None:
    again = rille.open_run("mockup-short", run.folder.parents[1])
    assert again == run
    assert rille.open_run(run.folder) == run
    shown: list[str] = []
    monkeypatch.setattr(runs.webbrowser, "open", shown.append)
    again.show()
    assert shown == [(run.folder / "report.html").resolve().as_uri()]


def test_a_run_tells_its_tasks_and_what_is_missing(run: rille.Run) -> None:
    assert {row["label"]: row["digest"] for row in run.tasks} == digests(run.folder)
    assert all(item["what"] for item in run.missing)
    assert run.complete or run.missing


def test_a_quiet_run_shows_no_progress(run: rille.Run, capsys: pytest.CaptureFixture[str]) -> None:
    places = {"runs": run.folder.parents[1], "cache": run.folder.parents[2] / "cache"}
    sequence = rille.open("mockup-short", mockup=MOCKUP)
    rille.reconstruct(sequence, **places, executor="inline", quiet=True, **STAGES)  # type: ignore[arg-type]
    said = capsys.readouterr()
    assert said.out.count("\n") == 1
    assert all(line.startswith("rille: note") for line in said.err.splitlines())


def test_what_cannot_be_is_one_clear_line(tmp_path: Path) -> None:
    sequence = rille.open("mockup-short", mockup=MOCKUP)
    with raises("RIL-860"):
        rille.reconstruct(sequence, runs=tmp_path, cache=tmp_path / "cache", mockup={"frames": 4})
    with raises("RIL-861"):
        rille.reconstruct(sequence, locus=0.002)  # type: ignore[arg-type]
    with raises("RIL-861", "frames=3"):
        rille.open("mockup-short", frames=3)  # type: ignore[arg-type]
    for nothing in (None, sequence[0], [sequence[0]]):
        for take in (rille.open, rille.reconstruct):
            with raises("RIL-970", f"{nothing!r:.80}"):
                take(nothing)  # type: ignore[operator]
    for place in (None, 3, b"runs", "a\0b"):
        for name in ["runs"] if place is None else ["runs", "cache"]:
            with raises("RIL-970", f"{name}={place!r}"):
                rille.reconstruct(sequence, **{name: place})  # type: ignore[arg-type]
        with raises("RIL-970", f"path={place!r}"):
            rille.open_run(place)  # type: ignore[arg-type]
    with raises("RIL-737", "a" * 5000):
        rille.open_run("a" * 5000)
    for number in (2, slice(0, 2), [0, 1]):
        with raises("RIL-055", repr(number)):
            rille.reconstruct(sequence, frames=number, runs=tmp_path, cache=tmp_path / "cache")  # type: ignore[arg-type]
    for nothing in (None, tmp_path):
        with raises("RIL-866", "locus.cell_size"):
            rille.reconstruct(sequence, locus={"cell_size": nothing})
    for folder in (tmp_path, str(tmp_path)):
        with raises("RIL-862"):
            _ = rille.Run(folder).terrain  # type: ignore[arg-type]
    with raises("RIL-970", "folder=None"):
        rille.Run(None)  # type: ignore[arg-type]
    with pytest.raises(AttributeError):
        _ = rille.nothing


@pytest.mark.parametrize("value", ["two  blanks", "a\nline", 'a "quote"', [[1, 2], [3, 4]], True, 1e-7])
def test_settings_come_back_from_their_assignments(value: object) -> None:
    words = arguments.assignments({"section": {"key": value}})
    assert "\n" not in words[0]
    assert configuration.parse_assignments(words) == {"section": {"key": value}}


def test_one_sequence_may_stand_for_a_list_of_one() -> None:
    for one in ("no-such-sequence", Path("no/such/folder"), None, rille.open("mockup-short", mockup=MOCKUP)[0]):
        (error,) = rille.reconstruct_many(one)  # type: ignore[arg-type]
        assert isinstance(error, rille.RilleError)


def test_its_examples_run() -> None:
    found = doctest.testmod(runs)
    assert found.attempted >= 4
    assert not found.failed


def test_no_stage_of_the_package_depends_on_it() -> None:
    assert "rille.pipeline" in (found := keys.module_digests("rille.pipeline.engine.plain"))
    assert "rille.pipeline.python.runs" not in found


@pytest.mark.slow
def test_a_client_that_is_handed_in_computes_the_same_bits(run: rille.Run, tmp_path: Path) -> None:
    from distributed import Client, LocalCluster

    sequence = rille.open("mockup-short", mockup=MOCKUP)
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as cluster,
        Client(cluster) as client,
    ):
        again = rille.reconstruct(sequence, client, runs=tmp_path / "runs", cache=tmp_path / "cache", **STAGES)  # type: ignore[arg-type]
    statuses = {row["status"] for row in events.read(again.folder / "ledger.jsonl")}
    assert statuses == {"computed"}
    assert digests(again.folder) == digests(run.folder)


def test_a_failure_of_the_system_is_an_error_of_rille(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that a notebook catches it, and the other sequences of a batch go on."""

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "config.toml")

    monkeypatch.setattr("rille.pipeline.engine.runtime.atomic.write", full)
    given = {"runs": tmp_path / "runs", "cache": tmp_path / "cache", "executor": "inline"}
    assert [error.code for error in rille.reconstruct_many(["mockup-short"] * 2, **given)] == ["RIL-737"] * 2


def test_a_tilde_is_the_home_of_the_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(given: str, options: Options) -> None:
        assert (given, options.runs, options.cache) == (f"{tmp_path}/a", tmp_path / "b", f"{tmp_path}/c")
        raise ConfigError("RIL-061", "far enough")

    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr("rille.pipeline.runs.session.perform", stop)
    with raises("RIL-061"):
        rille.reconstruct("~/a", runs="~/b", cache="~/c")
