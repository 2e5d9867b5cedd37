"""The whole chain on a small mockup: what is recomputed, what it leaves, and that it is the same for any executor."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray
from raising import raises

from rille.pipeline.engine.events import read
from rille.pipeline.engine.store.artifact import reference
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.maintenance import artifacts
from rille.pipeline.report import gallery
from rille.pipeline.report.canvas import FIGURE, Figure
from rille.pipeline.report.delivery import lacking
from rille.pipeline.runs import run_files, session

SMALL = (
    "mockup.frames=5",
    "mockup.image_width=285",
    "mockup.image_height=260",
    "mockup.focal_length=300.0",
    "keyframes.stride=2",
    "locus.cell_size=0.004",
    "hfvm.preset=default",  # the mockup's own, accurate, has more to compile
)


def options(folder: Path, *more: str, **kw: Any) -> session.Options:
    defaults: dict[str, Any] = {"executor": "inline", "progress": "quiet", "cache": folder / "cache"}
    return session.Options((*SMALL, *more), runs=folder / "runs", **(defaults | kw))


def latest(folder: Path) -> Path:
    return (folder / "runs" / "mockup-short" / "latest").resolve()


def computed(folder: Path) -> set[str]:
    return {row["label"] for row in read(latest(folder) / "ledger.jsonl") if row["status"] == "computed"}


def digests(folder: Path) -> dict[str, str]:
    return {row["label"]: row["digest"] for row in read(latest(folder) / "ledger.jsonl")}


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def cold(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("chain")
    assert session.perform("mockup-short", options(folder)).code == 0
    return folder


def test_outputs_are_all_there_and_sound(cold: Path) -> None:
    folder = latest(cold)
    wanted = {"trajectory.kitti", "trajectory.tum", "dem.tif", "dem_sigma.tif", "ortho.tif", "risk.tif", "hazard.tif"}
    wanted |= {"reason.tif", "risk.tif.aux.xml"}
    wanted |= {"path.gpkg", "frames.json", "crosscheck.tum"}
    wanted |= {"slope.tif", "hillshade.tif", "terrain.zarr"}
    wanted |= {"config.toml", "report.json", "report.html", "ledger.jsonl"}
    assert wanted <= {p.name for p in folder.iterdir()}
    assert np.loadtxt(folder / "trajectory.kitti").shape == (5, 12)
    with rasterio.open(folder / "dem.tif") as dem, rasterio.open(folder / "risk.tif") as risk:
        z = dem.read(1)
        assert z.shape == risk.read(1).shape
        # the camera stands 0.18 m above a bed whose relief is of some centimetres
        assert -0.25 < np.nanmedian(z) < -0.11
    report = json.loads((folder / "report.json").read_text())
    store = Store(cold / "cache")
    manifests = [store.manifest(stage, key) for stage, key in artifacts(store)]
    local = [m for m in manifests if m is not None and m["label"].startswith("path/local/")]
    closed = [m for m in local if not m["meta"]["found"]]
    # On so coarse a bed few stops have ground that leads anywhere; which of them hangs on single cells.
    assert len(local) == 3
    assert all(m["meta"]["ended_by"] for m in local if m not in closed)
    assert report["missing"] == []
    assert report["metrics"]["local_paths"]["value"] == 3 - len(closed)
    assert report["complete"]
    assert report["stages"]["hfvm"]["computed"] == 3


def test_xarray_opens_the_artifact_of_every_stage_with_dimensions_and_units(cold: Path) -> None:
    store = Store(cold / "cache")
    opened: set[str] = set()
    for stage, key in artifacts(store):
        manifest = store.manifest(stage, key)
        if manifest is None or stage in opened:
            continue
        opened.add(stage)
        arrays = manifest["arrays"]
        with xarray.open_zarr(f"zip::{store.root / reference(manifest).path}") as data:
            assert set(data.data_vars) == set(arrays), stage
            lattice = manifest["meta"].get("lattice")
            assert set(data.coords) == ({"x", "y"} if lattice else set()), stage
            if lattice:
                assert [data.x.units, data.x.dims, data.y.units, data.y.dims] == ["m", ("col",), "m", ("row",)], stage
                assert data.y[0] - data.y[1] == pytest.approx(lattice["cell"], rel=1e-6), (stage, "row 0 is farthest")
            for name, about in arrays.items():
                assert data[name].attrs["units"], (stage, name)
                assert data[name].attrs["long_name"], (stage, name)
                assert len(set(data[name].dims)) == len(about["shape"]), (stage, name)
                assert list(data[name].shape) == about["shape"], (stage, name)
    assert opened == {row["stage"] for row in read(latest(cold) / "ledger.jsonl")}


def test_the_same_again_computes_nothing(cold: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_worker(*args: object, **kw: object) -> None:
        raise AssertionError("a worker was started")

    monkeypatch.setattr("rille.pipeline.engine.run.make", no_worker)
    before = digests(cold)
    assert session.perform("mockup-short", options(cold, executor="dask")).code == 0
    assert computed(cold) == set()
    assert digests(cold) == before


def test_what_is_done_to_the_files_of_a_run_reaches_neither_the_cache_nor_the_next_run(cold: Path) -> None:
    assert session.perform("mockup-short", options(cold)).code == 0
    first = latest(cold)
    written = contents(first)
    for path in first.rglob("*"):
        if path.is_file():
            path.write_bytes(b"edited in place")
    assert session.perform("mockup-short", options(cold)).code == 0
    assert latest(cold) != first
    assert computed(cold) == set()
    again = contents(latest(cold))
    assert again.keys() == written.keys()
    rendered = {"report.html", "report.json", "ledger.jsonl"}
    assert {name for name in written if again[name] != written[name]} == rendered


def test_a_damaged_output_is_drawn_again(cold: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert session.perform("mockup-short", options(cold)).code == 0
    before, written = digests(cold), (latest(cold) / "path.gpkg").read_bytes()
    path = next((cold / "cache").glob("artifacts/output.paths/*/*.zip"))
    with zipfile.ZipFile(path) as archive:
        member = next(member for member in archive.infolist() if member.filename.startswith("content/c"))
        start = member.header_offset + len(member.FileHeader())
    data = path.read_bytes()
    path.write_bytes(data[:start] + bytes(member.file_size) + data[start + member.file_size :])
    assert session.perform("mockup-short", options(cold)).code == 0
    assert "is damaged" in capsys.readouterr().err
    assert (latest(cold) / "path.gpkg").read_bytes() == written
    assert digests(cold) == before
    assert session.perform("mockup-short", options(cold)).code == 0
    assert "is damaged" not in capsys.readouterr().err, "the artifact was replaced"


def test_a_figure_that_cannot_be_drawn_is_missing(
    cold: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = FIGURE.dump_json(gallery.draw("Pairs", lambda _: 1 / 0, None))  # type: ignore[arg-type, return-value]

    def read(data: bytes) -> Figure:
        title = FIGURE.validate_json(data).title
        return FIGURE.validate_json(failed) if title == "Pairs" else Figure(title)

    monkeypatch.setattr(run_files, "FIGURE", SimpleNamespace(validate_json=read))
    result = session.perform("mockup-short", options(cold))
    assert result.code == 3
    result.print()
    told = capsys.readouterr()
    assert "rille: missing: Pairs: drawing failed, ZeroDivisionError" in told.err
    found = json.loads((latest(cold) / "report.json").read_text())
    assert not found["complete"]
    lost = lacking(found["missing"])
    assert f", missing {len(lost)}, in " in told.out
    assert [line for line in told.err.splitlines() if line.startswith("rille: missing: ")] == [
        f"rille: missing: {m['what']}: {m['why']}" for m in lost
    ]


def test_one_risk_parameter_reruns_risk_path_and_what_reads_them(cold: Path) -> None:
    assert session.perform("mockup-short", options(cold, "risk.max_hole=0.25")).code == 0
    labels = computed(cold)
    assert {label.split("/")[0] for label in labels} == {"risk", "path", "path_check", "output"}
    drawn = {label.removeprefix("output/") for label in labels if label.startswith("output/")}
    assert {"risk.tif", "Map", "facts"} <= drawn
    assert not drawn & {"dem.tif", "terrain.zarr", "trajectory.tum", "Trajectory", "Elevation error"}


def test_what_the_data_do_not_determine_is_missing_and_the_rest_is_delivered(cold: Path, tmp_path: Path) -> None:
    folder = tmp_path / "runs"
    assert session.perform("mockup-short", replace(options(cold, "vehicle.track=5.0"), runs=folder)).code == 3
    latest = folder / "mockup-short" / "latest"
    assert {"dem.tif", "trajectory.tum", "report.html"} <= {p.name for p in latest.iterdir()}
    report = json.loads((latest / "report.json").read_text())
    failed = [m["what"] for m in report["missing"] if m["kind"] == "failed"]
    assert any(what.startswith("2 of 2 tasks risk failed (world, truth)") for what in failed), failed
    assert not [what for what in failed if "local" in what]  # what the map of a pair is too small for is no failure
    assert not report["complete"]

    # one model without a cell: the world is made of the others
    behind = options(cold, "locus.extent=[-0.1, 0.1, -9.0, -8.9]")
    assert session.perform("mockup-short", replace(behind, runs=folder)).code == 3
    written = {p.name for p in latest.iterdir()}
    assert {"trajectory.tum", "report.html"} <= written
    assert "dem.tif" not in written


def test_written_configuration_repeats_the_run(cold: Path) -> None:
    assert session.perform("mockup-short", options(cold)).code == 0
    first = digests(cold)
    again = session.Options(
        config=latest(cold) / "config.toml",
        runs=cold / "runs",
        cache=cold / "cache",
        executor="inline",
        progress="quiet",
    )
    assert session.perform("mockup-short", again).code == 0
    assert computed(cold) == set()
    assert digests(cold) == first


def test_two_workers_killed_on_the_way_give_the_same_bits(cold: Path, tmp_path: Path) -> None:
    """What they made by then, up to the merged terrain, is that of one process, which goes on from there."""
    assert session.perform("mockup-short", options(cold)).code == 0
    command = [sys.executable, "-m", "rille.pipeline.cli", "reconstruct", "mockup-short", "--jobs", "2", "--quiet"]
    command += [w for a in SMALL for w in ("--set", a)]
    command += ["--cache", str(tmp_path / "cache"), "--runs", str(tmp_path / "runs")]
    process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    until = time.monotonic() + 120
    while time.monotonic() < until and not list((tmp_path / "cache").glob("artifacts/merge/*/*.zip")):
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "runs" / "mockup-short" / "latest").exists()
    assert session.perform("mockup-short", options(tmp_path)).code == 0
    assert digests(tmp_path) == digests(cold)
    assert not computed(tmp_path) & {"hfvm/0", "locus/0", "trajectory"}


def test_frames_are_chosen_strictly() -> None:
    assert session.choose_frames("2:8:3", 9) == (2, 5)
    assert session.choose_frames(None, 3) == (0, 1, 2)
    assert session.choose_frames("4:5", 9) == (4,)
    for bad in ("3", "a:b", "0:10", "9:", "5:5", "-3:5", ":-1", "0:9:0", "0:9:1:1", ""):
        with raises("RIL-055", "9 frames"):
            session.choose_frames(bad, 9)
