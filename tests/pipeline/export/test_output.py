"""Every output by its record: made by its task of what the record names alone, described, listed, in the docs."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pyogrio
import pyproj
import pytest
import rasterio
import xarray
from evo.tools import file_interface
from toys.finished import FRAMES, bundles, checked, checks, sequence, view

from rille.datasets.georeference import Georeference
from rille.pipeline.engine.graph import Graph, Handle
from rille.pipeline.engine.keys import digest
from rille.pipeline.export import catalogue
from rille.pipeline.export.output import Output, pack, unpack
from rille.pipeline.export.view import RUN, part
from rille.pipeline.report import canvas, gallery
from rille.pipeline.report.canvas import FIGURE
from rille.pipeline.runs import run_files
from rille.pipeline.runs.run_files import add, handles
from rille.stages.core.declare import Bundle

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "outputs.md"
PLACE = Georeference("EPSG:32633", (1.0, 2.0, 3.0), 0.5)
BEGIN, END = "<!-- table -->\n", "<!-- end of table -->\n"


class Made(Handle):
    """A handle of an artifact that is known by its name."""

    def __init__(self, name: str, *, there: bool) -> None:
        super().__init__(0, cast(Any, None), {}, "computed", cast(Any, name if there else None))
        self.name = name


def laid_out(name: str, whole: Any) -> Handle | None:
    """The task that makes an output of a run."""
    return next(add(Graph(), module, output, whole) for module, output in outputs() if output.name == name)


def made_by(task: Handle | None, made: dict[str, Bundle]) -> Bundle:
    """The artifact of a task, of arguments that went through JSON."""
    assert task is not None
    digest(task.spec.args)  # they are part of a key
    args, stage = json.loads(json.dumps(task.spec.args)), task.spec.stage
    return stage.run(stage.params(), args, {"read": [made[handle.name] for handle in read(task)]})


def read(task: Handle) -> list[Any]:
    """What a task reads."""
    return cast(list[Any], task.inputs["read"])


def place(bundle: Bundle, folder: Path) -> None:
    """The files of an artifact in a folder."""
    for name, content in unpack(bundle).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def write(output: Output, folder: Path, whole: Any, made: dict[str, Bundle]) -> None:
    """The files of an output in a folder, by its task."""
    place(made_by(add(Graph(), next(m for m, o in outputs() if o is output), output, whole), made), folder)


def run(place: Georeference | None = None) -> Any:
    """A finished run whose products are handles, and their bundles by reference."""
    made = bundles() | checks()
    known: dict[str, Made] = {}

    def handle(value: Any) -> Any:
        if isinstance(value, str):
            return known.setdefault(value, Made(value, there=value in made))
        if isinstance(value, dict):
            return {k: handle(v) for k, v in value.items()}
        return [handle(v) for v in value] if isinstance(value, list) else value

    products = checked()
    for name, value in vars(products).items():
        setattr(products, name, handle(value))
    where = replace(sequence(truth=True), georeference=place)
    config = SimpleNamespace(**vars(view().config), select=SimpleNamespace(rule="overlap", overlap=0.7))
    bundle = lambda found: None if found is None or found.ref is None else made[found.ref]  # noqa: E731
    return view(products=products, sequence=where, config=config, bundle=bundle), made


def outputs() -> Iterator[tuple[Any, Output]]:
    for module in run_files.MODULES:
        for output in module.OUTPUTS:
            yield module, output


@pytest.fixture(autouse=True)
def _unpainted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are laid out, but not painted."""
    monkeypatch.setattr(canvas, "encode", lambda _, alt, *, photo=False: canvas.Panel(f"{photo}", alt, 1, 1))


@pytest.mark.parametrize("georeference", [None, PLACE], ids=["local", "placed"])
@pytest.mark.parametrize("output", [output for _, output in outputs()], ids=lambda output: output.name)
def test_a_task_makes_of_what_its_row_names_what_the_whole_run_would(
    output: Output, georeference: Georeference | None, tmp_path: Path
) -> None:
    whole, made = run(georeference)
    assert output.write is not None
    if all(attrgetter(str(name))(whole) for name in output.needs):
        output.write(tmp_path / output.name, whole)
    found = unpack(made_by(laid_out(output.name, whole), made))
    assert found == unpack(pack(tmp_path))
    if output in gallery.OUTPUTS:
        assert FIGURE.validate_json(found[output.name]).why == ""


def test_nothing_but_what_is_named_of_a_run_is_within_reach() -> None:
    whole, _ = run()
    named = part(whole, (RUN.products.world_risk, RUN.sequence.name))
    assert named.products.world_risk is whole.products.world_risk
    assert (named.sequence.name, named.frames) == ("bed", FRAMES)
    for lost in (lambda run: run.products.world_path, lambda run: run.sequence.truth):
        with pytest.raises(AttributeError):
            lost(named)


def test_the_map_of_coloured_images_reads_what_it_needs() -> None:
    whole, made = run()
    for name in [name for name in made if name.startswith("image")]:
        grey = made[name]["image"]
        made[name] = Bundle({"image": grey, "colour": np.repeat(grey[..., None], 3, axis=2)}, made[name].meta)
    found = made_by(laid_out("Map", whole), made)
    assert FIGURE.validate_json(unpack(found)["Map"]).why == ""


def test_nothing_is_made_without_what_it_needs_and_holes_are_passed_on() -> None:
    whole, _ = run()
    whole.products.world_path.ref = None
    path = next(o for _, o in outputs() if o.name == "path.gpkg")
    assert [cast(Any, handle).name for handle in handles(path, whole)] == ["path"]
    assert laid_out("path.gpkg", whole) is None
    drawn = laid_out("Map", whole)
    assert drawn is not None
    assert drawn.spec.args["run"]["part"]["products"]["part"]["world_path"] is None
    assert {handle.name for handle in read(drawn)} == {
        *("accuracy", "disparity0", "disparity4", "rig", "trajectory", "risk", "tile"),
        *(f"image{frame}" for frame in FRAMES),
    }


def test_files_come_out_of_an_artifact_as_they_went_in(tmp_path: Path) -> None:
    (tmp_path / "a" / "deep").mkdir(parents=True)
    for name, size in {"b.txt": 0, "a/deep/c.bin": 3000, "d": 1024}.items():
        (tmp_path / "a").joinpath(name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / "a" / name).write_bytes(bytes(range(256)) * 12 if size == 3000 else b"x" * size)
    bundle = pack(tmp_path / "a")
    place(Bundle(dict(bundle.arrays), json.loads(json.dumps(dict(bundle.meta)))), tmp_path / "b")
    assert unpack(pack(tmp_path / "b")) == unpack(bundle)
    assert len(unpack(bundle)) == 3


def test_every_module_with_outputs_is_one_of_those_that_a_run_makes() -> None:
    modules = (ROOT / "pipeline").rglob("*.py")
    declared = {path.stem for path in modules if re.search(r"^STAGE = stage\(", path.read_text(), re.MULTILINE)}
    listed = {module.__name__.rpartition(".")[2] for module in run_files.MODULES}
    assert declared == listed, (
        "in pipeline/export a module is found by itself; one of figures stands in run_files.MODULES"
    )


def test_a_run_writes_the_files_that_it_describes(tmp_path: Path) -> None:
    whole, made = run()
    for module in catalogue.MADE:
        for output in module.OUTPUTS:
            write(output, tmp_path, whole, made)
    with rasterio.open(tmp_path / "hazard.tif") as file:
        measures, risk = file.read(), made["risk"]
        for name, values in zip(file.descriptions, measures, strict=True):
            exact = np.degrees(risk[name]) if file.units[file.descriptions.index(name)] == "degree" else risk[name]
            np.testing.assert_allclose(values, exact, rtol=2.0**-12)
    assert (measures.view(np.uint32) & 0xFFF == 0).all(), "measures are rounded to significant bits"
    names = [p.name for p in tmp_path.iterdir()]
    facts = catalogue.describe(names, whole)
    described = [o.name for o in catalogue.OUTPUTS if o.frame]
    assert list(facts["files"]) == described
    assert set(described) | {"risk.tif.aux.xml"} == set(names)
    assert {about["frame"] for about in facts["files"].values()} <= catalogue.FRAMES.keys()
    assert facts["frames"][4] == {"frame": 4, "name": "left004", "time": 4.0}
    assert facts["units"]["time"] == "frame number"
    assert facts["frames_of_reference"]["world"]["handedness"] == "right"
    assert "scalar last" in facts["conventions"]["quaternion"]
    assert [name for name, *_ in catalogue.listed(tmp_path)][:3] == ["report.html", "report.json", "crosscheck.tum"]
    assert all(words and programs for _, words, programs in catalogue.listed(tmp_path))
    crosscheck = file_interface.read_tum_trajectory_file(tmp_path / "crosscheck.tum")
    np.testing.assert_array_equal(crosscheck.timestamps, range(5))


def test_both_trajectories_state_one_frame_where_the_vertical_is_not_known(tmp_path: Path) -> None:
    whole, made = run()
    made["trajectory"] = Bundle(made["trajectory"].arrays, made["trajectory"].meta | {"verticals": ["none"], "main": 0})
    heads = []
    for name in ("trajectory.tum", "crosscheck.tum"):
        output = next(o for _, o in outputs() if o.name == name)
        write(output, tmp_path, whole, made)
        heads.append((tmp_path / name).read_text().splitlines()[0])
    assert heads[0] == heads[1]
    assert "nothing tells of the vertical" in heads[0]


@pytest.mark.parametrize("georeference", [None, PLACE], ids=["local", "placed"])
def test_all_files_of_a_run_state_one_system(georeference: Georeference | None, tmp_path: Path) -> None:
    whole, made = run(georeference)
    for module in catalogue.MADE:
        for output in module.OUTPUTS:
            write(output, tmp_path, whole, made)
    found = {}
    for path in tmp_path.glob("*.tif"):
        with rasterio.open(path) as raster:
            found[path.name] = pyproj.CRS.from_user_input(raster.crs)
    found["path.gpkg"] = pyproj.CRS.from_user_input(pyogrio.read_info(tmp_path / "path.gpkg")["crs"])
    terrain = xarray.open_zarr(tmp_path / "terrain.zarr")
    assert set(terrain.elevation.attrs["ancillary_variables"].split()) == {
        "elevation_std",
        "spread",
        "count",
        "source",
        "relief_std",
    }
    local = pyproj.CRS.from_wkt(terrain.spatial_ref.attrs["crs_wkt"])
    found["terrain.zarr"] = local if georeference is None else pyproj.CRS(terrain.attrs["georeference_crs"])
    assert len(found) >= 10
    if georeference is None:
        assert len({crs.to_wkt() for crs in found.values()}) == 1, "programs compare the text"
        assert {crs.name for crs in found.values()} == {"Rille world frame (local metres)"}
        assert {(a.direction, a.unit_name) for crs in found.values() for a in crs.axis_info} == {
            ("east", "metre"),
            ("north", "metre"),
        }
    else:
        assert {crs.to_epsg() for crs in found.values()} == {32633}


def table() -> str:
    """All files of a run, as the docs list them."""
    rows = ["| file | what it is | frame | opens with |", "|---|---|---|---|"]
    rows += [f"| `{o.name}` | {o.what} | {o.frame} | {o.opens} |" for o in catalogue.OUTPUTS]
    return "\n".join(rows) + "\n"


def test_the_docs_list_every_file() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert text[text.index(BEGIN) + len(BEGIN) : text.index(END)] == table(), "make pages"


if __name__ == "__main__":
    page = PAGE.read_text(encoding="utf-8")
    before, after = page.index(BEGIN) + len(BEGIN), page.index(END)
    PAGE.write_text(page[:before] + table() + page[after:], encoding="utf-8")
