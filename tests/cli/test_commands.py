"""Every command does what it says, twice the same, with two sequences in one cache."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from pathlib import Path

import pytest
from place import MOCKUP, OTHER, SEQUENCE, Place, sets

from rille.pipeline.cli import app

RUN_ID = r"\d{8}T\d{6}Z-\d{6}"
RECONSTRUCTED = {"report.html", "report.json", "config.toml", "ledger.jsonl", "trajectory.tum", "trajectory.kitti"}
RECONSTRUCTED |= {
    "dem.tif",
    "dem_sigma.tif",
    "hillshade.tif",
    "ortho.tif",
    "risk.tif",
    "hazard.tif",
    "reason.tif",
    "terrain.zarr",
}
SAME_IN_EACH_RUN = ("trajectory.tum", "trajectory.kitti", "dem.tif", "dem_sigma.tif", "ortho.tif", "risk.tif")


@pytest.mark.parametrize(
    "words",
    [
        ["--version"],
        ["plan", *MOCKUP],
        ["why", "other", "trajectory"],
        ["runs"],
        ["timing", "other"],
        ["view", "other"],
        ["compare", "other", "mockup-short"],
        ["datasets", "list"],
        ["cache", "gc", "--dry-run"],
        ["cache", "verify"],
        ["params", "locus"],
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_a_user_who_starts_a_command_sees_what_these_tests_see(place: Place, words: list[str]) -> None:
    started = place.rille(*words)
    assert (started.status, started.err) == (0, "")
    assert place.here(*words) == started


def test_the_version_and_the_commands(place: Place) -> None:
    version = place.here("--version")
    assert (version.status, version.err) == (0, "")
    found = dict(line.split(maxsplit=1) for line in version.lines)
    assert version.lines[0].startswith("rille ")
    assert {"python", "numpy", "numba", "opencv-python-headless", "dask", "zarr", "system"} <= found.keys()
    bare = place.here()
    assert (bare.status, bare.err) == (0, "")
    assert bare.lines[0] == "Usage: rille COMMAND"


@pytest.mark.parametrize(("name", "frames"), [("mockup", 3), ("other", 2)])
def test_reconstruct(place: Place, name: str, frames: int) -> None:
    sequence = {"mockup": "mockup-short"}.get(name, name)
    first, second = place.said[name], place.said[f"{name} again"]
    assert (first.status, second.status) == (0, 0), first.err + second.err
    counts = r"computed (\d+), cached (\d+), missing (\d+), in [\d.]+ s"
    made = re.fullmatch(rf"(runs/{sequence}/{RUN_ID})/report.html  {counts}", first.last)
    assert made, first.last
    folder, total = place.folder / made[1], int(made[2]) + int(made[3])
    again = place.runs(sequence)[-1]
    counted = f"runs/{sequence}/{again.name}/report.html  computed 0, cached {total}, missing {made[4]}, in "
    assert second.last.startswith(counted)
    assert (folder.parent / "latest").resolve() == again
    assert {p.name for p in folder.iterdir()} >= RECONSTRUCTED
    poses = [line for line in (folder / "trajectory.tum").read_text().splitlines() if not line.startswith("#")]
    assert len(poses) == frames
    assert made[4] == "0"  # as the exit code says: that there is no path is an answer
    listed = json.loads((folder / "report.json").read_text())["missing"]
    said = [line for line in first.err.splitlines() if line.startswith("rille: note: ")]
    assert said == [f"rille: note: {m['what']}: {m['why']}" for m in listed]


def test_a_part_of_a_run_computes_what_it_needs_and_says_what_it_leaves_out(place: Place, tmp_path: Path) -> None:
    words = ["reconstruct", *MOCKUP, "--only", "trajectory.tum", "--runs", str(tmp_path), "--executor", "inline"]
    first, second = place.here(*words), place.here(*words)
    assert (first.status, second.status) == (0, 0), first.err + second.err
    assert re.fullmatch(r"left out, as --only trajectory.tum asks: \d+ known tasks \(.*locus.*\), .*", second.last)
    planned = place.here("plan", *words[1:])
    assert (planned.status, " 0 to do" in planned.out) == (0, True), planned.out
    run = tmp_path / "mockup-short" / "latest"
    whole = place.runs("mockup-short")[0]
    assert (run / "trajectory.tum").read_bytes() == (whole / "trajectory.tum").read_bytes()
    assert not (run / "dem.tif").exists()
    report = json.loads((run / "report.json").read_text())
    assert not report["complete"]
    assert [item["kind"] for item in report["absent"]] == ["part"]


@pytest.mark.slow
def test_a_crate_is_run_again_and_compared(place: Place, tmp_path: Path) -> None:
    crate, runs = tmp_path / "crate", tmp_path / "runs"
    exported = place.rille("export", "other", "--to", "rocrate", "--output", crate)
    assert (exported.status, exported.err) == (0, "")
    metadata = json.loads((crate / "ro-crate-metadata.json").read_text())
    entities = {one["@id"]: one for one in metadata["@graph"]}
    assert entities["ro-crate-metadata.json"]["conformsTo"] == {"@id": "https://w3id.org/ro/crate/1.1"}
    parts = {part["@id"] for part in entities["./"]["hasPart"]}
    assert {"dem.tif", "config.toml", "terrain.zarr/.zattrs", "trajectory.tum"} <= parts
    assert all(hashlib.sha256((crate / name).read_bytes()).hexdigest() == entities[name]["sha256"] for name in parts)
    image = hashlib.sha256(next((place.folder / "other" / "left").iterdir()).read_bytes()).hexdigest()
    assert image in {entities[one["@id"]].get("value") for one in entities["#run"]["object"]}
    planned = place.rille("plan", crate)
    assert (planned.status, " 0 to do" in planned.out) == (0, True), planned.out
    again = place.rille("reconstruct", crate, "--jobs", "1", "--runs", runs)
    assert again.status == 0, again.err
    assert re.fullmatch(rf"(\d+) of \1 results are those of {crate}, to the bit", again.last)
    other = place.rille(
        "reconstruct", crate, "--jobs", "1", "--runs", runs, "--set", "merge.alike=0.5", "--only", "dem.tif"
    )
    assert other.status == 3
    assert "RIL-041" in other.err


@pytest.mark.parametrize("command", ["reconstruct", "plan", "graph", "check"])
@pytest.mark.parametrize(
    ("of", "words"), [("rover.toml", "in a folder where"), ("/no/such/rover.toml", "to this path")]
)
def test_a_crate_away_from_its_images_says_which_and_where(
    tmp_path: Path, place: Place, of: str, words: str, command: str
) -> None:
    run = {"@id": "#run", "name": f"rille reconstruct {of}", "result": []}
    (tmp_path / "ro-crate-metadata.json").write_text(json.dumps({"@graph": [run]}))
    refused = place.here(command, tmp_path)
    assert refused.status == 2
    assert "RIL-612" in refused.complaint
    assert f"a run of {of}, which is not here" in refused.complaint
    assert words in refused.complaint


@pytest.mark.parametrize("command", ["reconstruct", "plan", "graph", "check"])
@pytest.mark.parametrize(
    "content", ["{", '{"@graph": []}', '{"@graph": [{"@id": "#run", "name": "rm -r x", "result": []}]}']
)
def test_what_is_no_crate_of_a_run_is_refused(place: Place, tmp_path: Path, content: str, command: str) -> None:
    (tmp_path / "ro-crate-metadata.json").write_text(content)
    refused = place.here(command, str(tmp_path))
    assert (refused.status, "RIL-023" in refused.complaint) == (2, True)


def test_reconstruct_says_how_it_goes(place: Place) -> None:
    plain = place.said["mockup"].err.splitlines()
    told = [line for line in plain if not line.startswith("rille: note: ")]
    assert all(
        re.fullmatch(r"rille: mockup-short: (\d+/\d+ tasks, .*|\S+: compiling, once: \d+ s)", line) for line in told
    )
    assert all(line.startswith("rille: ") for line in plain)


def test_reconstruct_again_gives_the_same_files(place: Place) -> None:
    first, second = place.runs("mockup-short")
    for name in SAME_IN_EACH_RUN:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name


def test_drive(place: Place) -> None:
    first, second = place.said["drive"], place.said["drive again"]
    assert (first.status, second.status) == (0, 0), first.err + second.err
    assert re.fullmatch(r"goal: \d+ mm from the goal  \(\d+ stops?\)", first.lines[-2])
    assert first.lines[-2] == second.lines[-2]
    assert re.fullmatch(
        rf"runs/mockup-loop/{RUN_ID}/report.html  computed \d+, cached 0, missing 0, in [\d.]+ s", first.last
    )
    assert re.fullmatch(
        rf"runs/mockup-loop/{RUN_ID}/report.html  computed 0, cached \d+, missing 0, in [\d.]+ s", second.last
    )
    folder, again = place.runs("mockup-loop")
    assert {p.name for p in folder.iterdir()} == {p.name for p in again.iterdir()}
    assert {p.name for p in folder.iterdir()} >= {"report.html", "report.json", "config.toml", "ledger.jsonl"}
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert report["complete"], report["missing"]


@pytest.mark.parametrize("words", [MOCKUP, OTHER], ids=lambda words: words[0])
def test_plan_of_what_is_there_finds_nothing_to_do(place: Place, words: list[str]) -> None:
    first = place.here("plan", *words)
    assert (first.status, first.err) == (0, "")
    ran = re.search(r"computed 0, cached (\d+)", place.said[f"{'other' if words is OTHER else 'mockup'} again"].last)
    assert ran is not None
    assert first.last == f"{ran[1]} tasks known: {ran[1]} cached, 0 to do", "outputs are tasks too"


@pytest.mark.parametrize(
    ("words", "cached"),
    [
        (["mockup-short", *sets((*SEQUENCE[:-1], "mockup.frames=2")), "--config", "settings.toml"], False),
        ([*MOCKUP, "--frames", "1:3"], True),
        ([*OTHER, "--frames", "0:1"], True),
        ([*OTHER, "--set", "locus.cell_size=0.02"], True),
    ],
    ids=["a shorter sequence", "later frames", "one frame", "another parameter"],
)
def test_plan_of_something_else_in_the_same_cache(place: Place, words: list[str], cached: bool) -> None:
    first, second = place.here("plan", *words), place.here("plan", *words, "--verbose")
    assert (first.status, first.err) == (0, "")
    assert (second.status, second.err) == (0, "")
    assert first.last.startswith("memory: the largest task, ")
    known, again = (re.search(r"^(\d+) tasks known: (\d+) cached, (\d+) to do", d.out, re.M) for d in (first, second))
    assert known is not None
    assert again is not None
    assert known[0] == again[0]
    assert int(known[1]) == int(known[2]) + int(known[3])
    assert (int(known[2]) > 0) >= cached
    assert int(known[3]) > 0


@pytest.mark.parametrize("sequence", ["mockup-short", "other"])
@pytest.mark.parametrize("task", ["trajectory", "hfvm/0"])
def test_why_tells_of_its_own_sequence(place: Place, sequence: str, task: str) -> None:
    first = place.here("why", sequence, task)
    assert (first.status, first.err) == (0, "")
    stage = task.partition("/")[0]
    run = place.runs(sequence)[-1].name
    assert re.fullmatch(rf"{task}: stage {stage}, (computed|cached) in run {sequence}/{run}", first.lines[0])
    others = {"mockup-short", "other", "mockup-loop"} - {sequence}
    assert not [line for line in first.lines if line.startswith("since") and any(f"{o}/" in line for o in others)]


def test_runs(place: Place) -> None:
    first = place.here("runs")
    assert (first.status, first.err) == (0, "")
    rows = {line.split()[0]: line.split()[1:] for line in first.lines[1:]}
    assert len(rows) == 6
    for run in place.runs("other"):
        state, computed, cached, seconds, posed, *_ = rows[f"other/{run.name}"]
        assert state == "complete"
        assert len(set(posed.split("/"))) == 1
        fresh = run == place.runs("other")[0]
        assert (int(computed) > 0) == fresh
        assert int(computed) + int(cached) > 0
        assert float(seconds) >= 0.1 * fresh  # a run that only looks up ends within a twentieth of a second
    assert place.here("runs", "other").lines[1:] == [line for line in first.lines[1:] if line.startswith("other/")]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_knows_commands_and_options(shell: str) -> None:
    script = app.generate_completion(shell=shell)
    assert {"reconstruct", "compare-dem", "memory-limit"} <= set(re.findall(r"[a-z]+(?:-[a-z]+)*", script))


def test_timing(place: Place) -> None:
    for run in ("mockup-loop", "other"):
        name = f"{run}/{place.runs(run)[0].name}"  # the one that has computed
        first = place.here("timing", name)
        assert (first.status, first.err) == (0, "")
        assert first.lines[0].startswith(f"run {name}: ")
        computed, cached = first.lines[-1].split()[-2:]
        assert first.lines[-1].startswith("all ")
        assert int(computed) > int(cached)
    assert place.here("timing").lines[0].startswith("run mockup-loop/")


def test_view(place: Place) -> None:
    done = place.here("view", "other")
    assert (done.status, done.err) == (0, "")
    assert Path(done.lines[-1]).name == "report.html"


def test_compare(place: Place) -> None:
    same = place.here("compare", *(f"other/{run.name}" for run in (place.runs("other")[0], place.runs("other")[-1])))
    assert (same.status, same.err) == (0, "")
    assert any(line.endswith(" with the same result, 0 with another") for line in same.lines)
    apart = place.here("compare", "other", "mockup-short")
    assert apart.status == 0
    assert apart.last.startswith("positions     ")


def test_check(place: Place) -> None:
    first, second = place.said["check"], place.said["check again"]
    assert (first.status, first.err) == (0, "")
    assert re.fullmatch(r"other: 0 fail, \d+ to look at, \d+ fine", first.last)
    assert {line.split()[0] for line in first.lines[:-1]} <= {"OK", "LOOK", "WARN"}
    assert first == second


def test_check_fails_where_an_image_is_truncated(place: Place, tmp_path: Path) -> None:
    shutil.copytree(place.folder / "other", tmp_path / "torn")
    image = tmp_path / "torn/right/000001.png"
    image.write_bytes(image.read_bytes()[:1000])
    done = place.here("check", "torn", folder=tmp_path)
    assert done.status == 1
    assert re.fullmatch(r"torn: [1-9] fail, \d+ to look at, \d+ fine", done.last)
    assert "000001.png is damaged or truncated" in next(line for line in done.lines if line.startswith("FAIL"))


def test_init_writes_a_manifest_and_replaces_none(place: Place, tmp_path: Path) -> None:
    shutil.copytree(place.folder / "other", tmp_path / "rover")
    assert place.rille("init", "rover", folder=tmp_path).status == 0
    assert not list(tmp_path.glob("*.toml")), "it opens as it is"
    written = place.here("init", "rover", "--force", folder=tmp_path)
    assert (written.status, written.err) == (0, "")
    manifest = tmp_path / "rover.rille.toml"
    before = manifest.read_bytes()
    refused = place.here("init", "rover", "--output", manifest, folder=tmp_path)
    assert refused.status == 2
    assert refused.complaint.startswith("rille: error RIL-038: ")
    assert manifest.read_bytes() == before
    assert place.here("init", "rover", "--force", folder=tmp_path) == written
    assert manifest.read_bytes() == before


@pytest.mark.data
def test_calibrate(place: Place, data_dir: Path, tmp_path: Path) -> None:
    board = data_dir / "chessboard_opencv"
    words = ["calibrate", board / "left0[1-5].jpg", board / "right0[1-5].jpg", "--square", "0.025", "--corners", "9x6"]
    words += ["--model", "radtan4"]
    first = place.rille(*words, folder=tmp_path)
    assert first.status == 0, first.err
    assert all(line.startswith("rille: warning") for line in first.err.splitlines())
    assert first.last == 'file = "rig.yaml"'
    rig = (tmp_path / "rig.yaml").read_bytes()
    assert place.here(*words, folder=tmp_path) == first
    assert (tmp_path / "rig.yaml").read_bytes() == rig


def test_calibrate_wants_a_board(place: Place, tmp_path: Path) -> None:
    images = place.folder / "other"
    done = place.here("calibrate", images / "left", images / "right", "--square", "0.1", folder=tmp_path)
    assert (done.status, done.out) == (2, "")
    assert done.complaint.startswith("rille: error RIL-153: ")
    assert not list(tmp_path.iterdir())


def test_match(place: Place, tmp_path: Path) -> None:
    images = place.folder / "other"
    words = ["match", images / "left/000000.png", images / "right/000000.png", "--confidence", "confidence.tif"]
    first = place.rille(*words, folder=tmp_path)
    assert (first.status, first.err) == (0, "")
    assert re.match(r"disparity\.tif  matched \d+\.\d %, ", first.lines[0])
    files = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    assert set(files) == {"disparity.tif", "confidence.tif"}
    assert place.here(*words, folder=tmp_path) == first
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == files


@pytest.mark.parametrize(("kind", "made"), [("laz", "cloud.laz"), ("ply", "cloud.ply"), ("glb", "terrain.glb")])
def test_export(place: Place, kind: str, made: str, tmp_path: Path) -> None:
    words = ["export", "other", "--to", kind, "--output", tmp_path / made]
    first, files = (place.rille if kind == "laz" else place.here)(*words), contents(tmp_path)
    assert (first.status, first.err) == (0, "")
    assert first.last.startswith(f"{tmp_path / made}  ")
    assert set(files) == {made}
    assert place.here(*words) == first
    assert contents(tmp_path) == files


def test_export_of_a_model_replaces_none(place: Place, tmp_path: Path) -> None:
    words = ["export", place.runs("other")[-1], "--to", "colmap", "--output", tmp_path / "colmap"]
    first, files = place.here(*words), contents(tmp_path)
    assert (first.status, first.err) == (0, "")
    assert first.last.startswith(f"{tmp_path / 'colmap'}  2 frames of 2 images, ")
    assert len(files) > 3
    again = place.here(*words)
    assert (again.status, again.out) == (2, "")
    assert again.complaint.startswith("rille: error RIL-607: ")
    assert contents(tmp_path) == files


def contents(folder: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_compare_dem(place: Place, tmp_path: Path) -> None:
    first_run, last_run = place.runs("mockup-short")
    first = place.rille("compare-dem", first_run, last_run / "dem.tif", folder=tmp_path)
    named = place.here("compare-dem", "mockup-short", last_run / "dem.tif", "--output", tmp_path / "named")
    assert named.lines[2:-1] == first.lines[2:-1]
    for path in tmp_path.glob("named.*"):
        path.unlink()
    assert (first.status, first.err) == (0, "")
    assert first.last == "dem_comparison.tif  dem_comparison.json"
    found = contents(tmp_path)
    assert set(found) == {"dem_comparison.tif", "dem_comparison.json"}
    assert "RMSE 0 m" in first.out
    assert place.here("compare-dem", first_run, last_run / "dem.tif", folder=tmp_path) == first
    assert contents(tmp_path) == found


def test_datasets(place: Place, tmp_path: Path) -> None:
    listed = place.here("datasets", "list")
    assert listed == place.here("datasets")
    assert (listed.status, listed.err) == (0, "")
    assert [line.split()[0] for line in listed.lines[:3]] == ["mockup", "mockup-short", "mockup-loop"]
    exported = place.said["export"]
    assert (exported.status, exported.out, exported.err) == (0, "other\n", "")
    again = place.here("datasets", "export", place.folder / "other", "copy", folder=tmp_path)
    assert (again.status, again.last) == (0, "copy")
    assert (tmp_path / "copy/left/000000.png").is_file()
    small = [f"--set={word}" for word in ("mockup.frames=1", "mockup.image_width=95", "mockup.image_height=87")]
    first = place.here("datasets", "export", "mockup-short", "one", "--cache", "new", *small, folder=tmp_path)
    assert first.status == 0
    assert "earlier format" not in place.here("plan", "mockup-short", "--cache", tmp_path / "new").err


def test_cache_gc_removes_nothing_that_a_run_uses(place: Place) -> None:
    before = {str(p) for p in (place.folder / ".rille/cache").rglob("*")}
    done = place.here("cache", "gc", "--dry-run")
    assert (done.status, done.err) == (0, "")
    assert done.last.startswith("would remove 0 artifacts and 0 leftovers")
    assert before <= {str(p) for p in (place.folder / ".rille/cache").rglob("*")}


def test_cache_verify_names_what_is_damaged(place: Place, tmp_path: Path) -> None:
    sound = place.here("cache", "verify")
    assert (sound.status, sound.err) == (0, "")
    assert re.fullmatch(r"\d+ artifacts are sound, 0 damaged", sound.last)
    copy = tmp_path / "cache"
    shutil.copytree(place.folder / ".rille/cache", copy)
    (artifact, *_) = sorted((copy / "artifacts" / "trajectory").rglob("*.zarr.zip"))
    data = bytearray(artifact.read_bytes())
    data[len(data) // 2] ^= 255
    artifact.write_bytes(data)
    damaged = place.here("cache", "verify", "--cache", copy)
    assert damaged.status == 1
    assert damaged.last.endswith(" 1 damaged")
    assert re.match(r"rille: trajectory(/\d+)? \(trajectory\): ", damaged.complaint)
    assert place.here("cache", "verify", "--cache", copy).status == 0, "it was set aside"


def test_params(place: Place) -> None:
    first = place.here("params", "locus")
    assert (first.status, first.err) == (0, "")
    assert first.lines[0].startswith("locus.cell_size = ")
