"""Folders of runs and artifacts that others made: whatever they hold, one line, and nothing outside is touched."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import pytest
import rasterio
import zarr
from affine import Affine
from pydantic import TypeAdapter
from raising import raises
from terrain_runs import finished

from rille.pipeline.cli import main
from rille.pipeline.engine.runtime.atomic import read_hint
from rille.pipeline.engine.store.base import Store
from rille.pipeline.export import read_dem
from rille.pipeline.export.output import unpack
from rille.pipeline.export.programs import rocrate
from rille.pipeline.export.programs.run_artifacts import export_run
from rille.pipeline.export.read_dem import frames_of, read_elevation
from rille.pipeline.python.runs import open_run
from rille.pipeline.runs import crate
from rille.stages.core.declare import Bundle

ROW = '{"label": "a", "stage": "hfvm", "status": "computed", "key": "k", "seconds": 1, "kernel": 1, "digest": "d"}\n'
ENDED = '{"run": {"ok": true, "total": 1.0}}\n'
POSE = "1 0 0 0 0 1 0 0 0 0 1 0\n"
DEEP = "[" * 100_000


@pytest.fixture(autouse=True)
def _never_hangs() -> Iterator[None]:
    before = signal.signal(signal.SIGALRM, lambda *_: pytest.fail("it hangs"))
    signal.alarm(30)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two runs of one sequence that are right, the later of which is given."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cache").mkdir()
    for number in "12":
        folder = tmp_path / "runs" / "seq" / number
        folder.mkdir(parents=True)
        (folder / "ledger.jsonl").write_text(ROW + ENDED)
        (folder / "report.json").write_text('{"complete": true, "metrics": {}}')
        (folder / "config.toml").write_text("")
    return folder


def told(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[Any, list[str]]:
    """Exit code and codes of the errors of a command."""
    with pytest.raises(SystemExit) as ended:
        main(list(words))
    lines = capsys.readouterr().err.splitlines()
    return ended.value.code, [line.split(":")[1].split()[-1] for line in lines]


COMPARE = ("compare", "seq/1", "seq/2")
WHY = ("why", "seq/2", "a", "--cache", "cache")
TIMING = ("timing", "seq/2")
GC = ("cache", "gc", "--dry-run", "--cache", "cache")


def test_runs_that_are_right_are_read(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in (COMPARE, WHY, ("runs",), GC):
        assert told(capsys, *words) == (0, [])


@pytest.mark.parametrize("words", [("runs",), WHY, COMPARE, TIMING, GC])
@pytest.mark.parametrize("line", ["5\n", '{"label": [1]}\n', '{"label": "a"}\n{"label": "b", "digest": "e"}\n'])
def test_a_ledger_that_is_none(run: Path, words: tuple[str, ...], line: str, capsys: Any) -> None:
    (run / "ledger.jsonl").write_text(line)
    assert told(capsys, *words) == (2, ["RIL-980"])


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('{"run": 5}\n', ("runs",)),
        ('{"run": {"ok": true, "total": "x"}}\n', ("runs",)),
        (ROW.replace('"key"', '"inputs": {"x": 5}, "key"'), WHY),
        (ROW + '{"run": {"jobs": "x"}}\n', TIMING),
    ],
)
def test_a_ledger_with_lines_of_another_form(run: Path, line: str, words: tuple[str, ...], capsys: Any) -> None:
    (run / "ledger.jsonl").write_text(line)
    assert told(capsys, *words) == (2, ["RIL-980"])


def test_a_ledger_that_is_no_text_ends_there(run: Path, capsys: Any) -> None:
    for content in (b"\xff\xfe\xff", DEEP.encode()):
        (run / "ledger.jsonl").write_bytes(content)
        assert told(capsys, "runs") == (0, [])


def test_a_pipe_in_place_of_a_ledger_is_no_run(run: Path, capsys: Any) -> None:
    (run / "ledger.jsonl").unlink()
    os.mkfifo(run / "ledger.jsonl")
    assert told(capsys, "runs") == (0, [])
    assert told(capsys, *GC) == (0, [])
    assert told(capsys, *WHY) == (2, ["RIL-067"])


@pytest.mark.parametrize("content", ["[]", "{}", '{"metrics": 5}', '{"metrics": {"a": 5}}', "{", DEEP])
def test_a_report_that_is_none(run: Path, content: str, capsys: Any) -> None:
    for number in "12":
        (run.parent / number / "report.json").write_text(content)
    assert told(capsys, *COMPARE) == (2, ["RIL-980"])


@pytest.mark.parametrize("name", ["report.json", "config.toml", "trajectory.kitti"])
def test_a_pipe_in_place_of_a_file_of_a_run(run: Path, name: str, capsys: Any) -> None:
    for number in "12":
        (run.parent / number / name).unlink(missing_ok=True)
        os.mkfifo(run.parent / number / name)
    assert told(capsys, *COMPARE) == (2, ["RIL-138"])


@pytest.mark.parametrize("content", ["a b c\n", "1 2 3 4\n1 2\n"])
def test_a_trajectory_that_is_none(run: Path, content: str, capsys: Any) -> None:
    for number in "12":
        (run.parent / number / "trajectory.kitti").write_text(content)
    assert told(capsys, *COMPARE) == (2, ["RIL-980"])


@pytest.mark.parametrize(
    ("name", "content", "ask"),
    [
        ("report.json", "{", lambda run: run.report),
        ("report.json", "{}", lambda run: run.metrics),
        ("report.json", DEEP, lambda run: run.complete),
        ("trajectory.kitti", "1 2 3\n", lambda run: run.trajectory),
        ("trajectory.kitti", POSE, lambda run: run.trajectory),
        ("terrain.zarr", "x", lambda run: run.terrain),
    ],
)
def test_from_python(run: Path, name: str, content: str, ask: Callable[[Any], Any]) -> None:
    (run / "frames.json").write_text("{}")
    (run / name).write_text(content)
    with raises("RIL-980"):
        ask(open_run(run))


def test_a_fault_of_the_program_is_not_told_as_one_of_the_run(run: Path, capsys: Any, monkeypatch: Any) -> None:
    def broken(*_: Any) -> Any:
        raise ValueError("own")

    monkeypatch.setattr("rille.pipeline.python.runs.Run.file", broken)
    assert told(capsys, "view", "seq/2") == (1, ["RIL-999"])


@pytest.mark.parametrize("kind", ["colmap", "nav2"])
def test_an_export_of_a_run_whose_ledger_is_none(run: Path, kind: str, capsys: Any) -> None:
    (run / "ledger.jsonl").write_text('{"label": "a"}\n')
    assert told(capsys, "export", "seq/2", "--to", kind, "--cache", "cache") == (2, ["RIL-980"])


def huge(folder: Path, axis: int) -> None:
    """A zarr group that claims a square of so many cells, and holds none."""
    group = zarr.create_group(store=str(folder), zarr_format=2)
    for name, dims in {"x": ["x"], "y": ["y"], "elevation": ["y", "x"]}.items():
        shape = (axis,) * len(dims)
        group.create_array(name, shape=shape, chunks=(1000,) * len(dims), dtype="f8").attrs["_ARRAY_DIMENSIONS"] = dims


def test_a_zarr_group_that_claims_more_than_can_be_read(run: Path) -> None:
    huge(run / "terrain.zarr", 10**10)
    with raises("RIL-982"):
        assert open_run(run).terrain


@pytest.mark.parametrize("codec", [numcodecs.Zlib(9), numcodecs.Zstd()])
def test_a_zarr_group_that_unpacks_to_more_than_it_claims(run: Path, codec: Any) -> None:
    """A chunk of 8 kB that a few megabytes stand for, which zlib makes gigabytes of; zstd needs a few kilobytes."""
    group = zarr.create_group(store=str(run / "terrain.zarr"), zarr_format=2)
    x = group.create_array("x", shape=(1000,), chunks=(1000,), dtype="f8", compressors=codec)
    x.attrs["_ARRAY_DIMENSIONS"] = ["x"]
    x[:] = 1.0
    if isinstance(codec, numcodecs.Zlib):
        (run / "terrain.zarr" / "x" / "0").write_bytes(bytes(5_000_000))
    with raises("RIL-997"):
        assert open_run(run).terrain


def test_a_raster_that_claims_more_than_can_be_read(tmp_path: Path) -> None:
    path, transform = tmp_path / "dem.tif", Affine(0.1, 0, 0, 0, -0.1, 0)
    with rasterio.open(
        path, "w", "GTiff", 60_000, 60_000, 1, dtype="float32", transform=transform, SPARSE_OK=True, tiled=True
    ):
        pass
    with raises("RIL-981"):
        read_elevation(path)


def test_a_small_file_does_not_take_more_than_it_can_hold(tmp_path: Path) -> None:
    about = {"width": 3000, "dtype": "float32", "transform": Affine(0.1, 0, 0, 0, -0.1, 0)}
    for name, rows in (("dem.tif", 2000), ("sparse.tif", 1000)):
        with rasterio.open(tmp_path / name, "w", "GTiff", height=rows, count=1, SPARSE_OK=True, tiled=True, **about):
            pass
    with raises("RIL-981"):
        read_elevation(tmp_path / "dem.tif")
    assert read_elevation(tmp_path / "sparse.tif").grid.values.shape == (1000, 3000)


def test_what_needs_more_memory_than_there_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with rasterio.open(
        tmp_path / "dem.tif", "w", "GTiff", 100, 100, 1, dtype="float32", transform=Affine(0.1, 0, 0, 0, -0.1, 0)
    ) as file:
        file.write(np.ones((1, 100, 100), np.float32))
    monkeypatch.setattr(read_dem, "free", lambda: 390_000)
    with raises("RIL-981"):
        read_elevation(tmp_path / "dem.tif")


def test_a_pipe_in_a_zarr_group_is_not_waited_for(run: Path) -> None:
    huge(run / "terrain.zarr", 10)
    os.mkfifo(run / "terrain.zarr" / "elevation" / "0.0")
    with raises("RIL-723"):
        assert open_run(run).terrain


@pytest.mark.parametrize("name", ["frames.json", "trajectory.kitti"])
def test_a_pipe_in_a_run_is_not_waited_for(tmp_path: Path, name: str) -> None:
    folder = finished(tmp_path / "run")
    (folder / name).unlink()
    os.mkfifo(folder / name)
    with raises("RIL-138"):
        read_elevation(folder)
    if name == "frames.json":
        with raises("RIL-138"):
            frames_of(folder / name)


@pytest.mark.parametrize("content", [DEEP, "{", "5", '{"georeference": 5}', '{"georeference": {"crs": "EPSG:32633"}}'])
def test_a_run_whose_frames_are_none_has_no_cameras(tmp_path: Path, content: str) -> None:
    folder = finished(tmp_path / "run")
    (folder / "frames.json").write_text(content)
    assert read_elevation(folder).viewpoints is None


@pytest.mark.parametrize("text", [DEEP, '{"@graph":' * 50_000, "5", '{"@graph": [5]}', '{"@graph": [{"@id": "#run"}]}'])
def test_a_crate_that_is_none(tmp_path: Path, text: str) -> None:
    (tmp_path / rocrate.METADATA).write_text(text)
    with raises("RIL-023"):
        crate.read(tmp_path)


def test_a_crate_of_data_alone_is_no_run(tmp_path: Path) -> None:
    """Whatever its text mentions."""
    assert crate.read(tmp_path) is None
    root = {"@id": "./", "@type": "Dataset", "mentions": {"@id": "#run"}}
    (tmp_path / rocrate.METADATA).write_text(json.dumps({"@graph": [root]}))
    assert crate.read(tmp_path) is None


def test_a_crate_takes_no_file_along_that_a_link_names(run: Path, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("of another folder")
    (run / "report.json").write_text('{"command": "rille reconstruct seq"}')
    (run / "dem.tif").symlink_to(tmp_path / "secret")
    with raises("RIL-723", "dem.tif"):
        export_run("rocrate", run, run / "crate", Store(run.parents[2] / "cache"))
    (run / "dem.tif").unlink()
    (run / "terrain.zarr").mkdir()
    (run / "terrain.zarr" / "0.0").symlink_to(tmp_path / "secret")
    with raises("RIL-723", "0.0"):
        export_run("rocrate", run, run / "crate", Store(run.parents[2] / "cache"))
    assert not (run / "crate").exists()


def test_a_drive_makes_no_crate(run: Path) -> None:
    (run / "report.json").write_text('{"command": "rille drive mockup-loop"}')
    with raises("RIL-611", "config.toml"):
        export_run("rocrate", run, run / "crate", Store(run.parents[2] / "cache"))
    assert not (run / "crate").exists()


def test_a_raster_whose_text_is_not_utf8(tmp_path: Path) -> None:
    path = tmp_path / "dem.tif"
    about = {
        "dtype": "float32",
        "crs": 'LOCAL_CS["abcdefgh",UNIT["metre",1]]',
        "transform": Affine(0.5, 0, 0, 0, -0.5, 0),
    }
    with rasterio.open(path, "w", "GTiff", 4, 4, 1, **about) as file:
        file.write(np.ones((1, 4, 4), np.float32))
    path.write_bytes(path.read_bytes().replace(b"abcdefgh", b"abc\xb1\xffgh\x80"))
    with raises("RIL-629"):
        read_elevation(path)


@pytest.mark.parametrize("name", ["dem.tif", "dem.asc"])
def test_a_pipe_for_a_raster_is_not_waited_for(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with raises("RIL-138"):
        read_elevation(tmp_path / name)


def test_a_raster_that_names_other_files_is_not_followed(tmp_path: Path) -> None:
    with rasterio.open(
        tmp_path / "own.tif", "w", "GTiff", 4, 4, 1, dtype="float32", transform=Affine(0.5, 0, 0, 0, -0.5, 0)
    ) as own:
        own.write(np.ones((1, 4, 4), np.float32))
    (tmp_path / "dem.tif").write_text(
        '<VRTDataset rasterXSize="4" rasterYSize="4"><GeoTransform>0,0.5,0,0,0,-0.5</GeoTransform>'
        '<VRTRasterBand dataType="Float32" band="1"><SimpleSource>'
        f'<SourceFilename relativeToVRT="0">{tmp_path / "own.tif"}</SourceFilename>'
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )
    with raises("RIL-629"):
        read_elevation(tmp_path / "dem.tif")
    (tmp_path / "dem.tif").rename(tmp_path / "dem.asc")
    with raises("RIL-629"):
        read_elevation(tmp_path / "dem.asc")


@pytest.mark.parametrize("name", ["dem.tif", "dem.asc"])
def test_a_mask_beside_a_raster_is_not_followed_either(tmp_path: Path, name: str) -> None:
    def write(path: Path, kind: str) -> None:
        with rasterio.open(path, "w", "GTiff", 4, 4, 1, dtype=kind, transform=Affine(0.5, 0, 0, 0, -0.5, 0)) as file:
            file.write(np.ones((1, 4, 4), kind))

    write(tmp_path / "dem.tif", "float32")
    write(tmp_path / "own.tif", "uint8")
    with rasterio.open(tmp_path / "own.tif", "r+") as file:
        file.write(np.zeros((1, 4, 4), np.uint8))
    (tmp_path / "dem.asc").write_text("ncols 4\nnrows 4\nxllcorner 0\nyllcorner -2\ncellsize 0.5\n" + "1 1 1 1\n" * 4)
    (tmp_path / f"{name}.msk").write_text(
        '<VRTDataset rasterXSize="4" rasterYSize="4"><Metadata><MDI key="INTERNAL_MASK_FLAGS_1">0</MDI></Metadata>'
        '<VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
        f'<SourceFilename relativeToVRT="0">{tmp_path / "own.tif"}</SourceFilename>'
        "</SimpleSource></VRTRasterBand></VRTDataset>"
    )
    assert np.isfinite(read_elevation(tmp_path / name).grid.values).all()


def test_an_ascii_grid_that_claims_more_than_can_be_read(tmp_path: Path) -> None:
    head = "ncols 60000\nnrows 60000\nxllcorner 0\nyllcorner 0\ncellsize 1\n"
    (tmp_path / "dem.asc").write_text(f"{head}1 2 3\n")
    with raises("RIL-981"):
        read_elevation(tmp_path / "dem.asc")
    (tmp_path / "dem.asc").write_text(head.replace("60000", "6"))
    with raises("RIL-629"):
        read_elevation(tmp_path / "dem.asc")


@pytest.mark.parametrize("name", ["../outside", "a/../../outside", "/outside"])
def test_a_forged_artifact_writes_nothing_outside_of_a_run(name: str) -> None:
    with raises("RIL-983"):
        unpack(Bundle({"content": np.zeros((1, 1024), np.uint8)}, {"files": [[name, 3]]}))


def test_json_of_a_ledger_is_read_line_by_line(run: Path, capsys: Any) -> None:
    (run / "ledger.jsonl").write_text(json.dumps({"label": "a\ud800", "stage": "s", "status": "failed"}) + "\n" + ENDED)
    assert told(capsys, "runs") == (0, [])


@pytest.mark.parametrize("content", [DEEP, None])
def test_notes_of_a_cache_that_are_none(run: Path, content: str | None, capsys: Any) -> None:
    path = Path("cache/roots/a.json")
    path.parent.mkdir()
    if content is None:
        os.mkfifo(path)
    else:
        path.write_text(content)
    assert told(capsys, *GC) == (1, ["RIL-742"])


def test_a_pipe_in_place_of_a_hint_holds_nothing(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "hint")
    assert read_hint(tmp_path / "hint", TypeAdapter(list[int])) is None
