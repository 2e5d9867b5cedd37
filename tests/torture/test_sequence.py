"""The whole chain on a small mockup: killed on its way, an artifact of each stage damaged, workers killed mid-tile."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import xarray
from test_damage import WAYS
from torn import look

from rille.pipeline.engine import events
from rille.pipeline.engine.store.arrays import DamagedError, array_digests, output_digest
from rille.pipeline.engine.store.artifact import artifact_path, reference
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.maintenance import artifacts

SMALL = (
    *("mockup.frames=5", "mockup.image_width=285", "mockup.image_height=260", "mockup.focal_length=300.0"),
    *("keyframes.stride=2", "locus.cell_size=0.004"),
)

pytestmark = pytest.mark.slow


def command(where, *more):
    words = [sys.executable, "-m", "rille.pipeline.cli", "reconstruct", "mockup-short", "--jobs", "2", "--quiet"]
    words += [w for a in SMALL for w in ("--set", a)]
    return [*words, "--cache", str(where / "cache"), "--runs", str(where / "runs"), *more]


def rows(where):
    latest = where / "runs" / "mockup-short" / "latest"
    return {r["label"]: r for r in events.read(latest / "ledger.jsonl")}


def begin(where, *more):
    return subprocess.Popen(command(where, *more), start_new_session=True, stdout=subprocess.DEVNULL,
                            stderr=subprocess.PIPE, text=True)  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The undisturbed run."""
    where = tmp_path_factory.mktemp("whole")
    start = time.monotonic()
    subprocess.run(command(where), check=True, stdout=subprocess.DEVNULL)
    span = time.monotonic() - start
    return SimpleNamespace(where=where, span=span, right={r["key"]: r["digest"] for r in rows(where).values()})


def same_files(whole, where):
    """Names of products that differ from those of the undisturbed run."""
    report = json.loads((where / "runs" / "mockup-short" / "latest" / "report.json").read_text())
    assert report["complete"]
    names = ("trajectory.kitti", "crosscheck.tum", "path.gpkg", "dem.tif", "risk.tif")
    both = [[Path(w) / "runs" / "mockup-short" / "latest" / name for w in (whole.where, where)] for name in names]
    return [a.name for a, b in both if a.read_bytes() != b.read_bytes()]


def test_small_mockup_killed_on_its_way(whole, tmp_path, row):
    rng, tries, right = random.Random(5), 4, whole.right
    lost, wrong, known = [], [], {}
    for _ in range(tries):
        process = begin(tmp_path)
        time.sleep(rng.uniform(0.15, 0.35) * whole.span)
        with_latest = (tmp_path / "runs" / "mockup-short" / "latest").exists()
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            assert not with_latest, "latest moves last"
        process.communicate()
        found = look.published(tmp_path / "cache")
        lost += sorted(set(known) - set(found)) + sorted(look.manifests(tmp_path / "cache") - set(found))
        wrong += look.wrong(found, right)
        known = found
    shutil.rmtree(tmp_path / "runs")
    subprocess.run(command(tmp_path), check=True, stdout=subprocess.DEVNULL)
    resumed = rows(tmp_path)
    wrong += [label for label, r in rows(whole.where).items() if resumed[label]["digest"] != r["digest"]]
    wrong += same_files(whole, tmp_path)
    computed = sum(r["status"] == "computed" for r in resumed.values())
    row("small mockup, SIGKILL", tries, lost, wrong, computed, len(right) - len(known), f"{len(right)} artifacts")


def one_of_each_stage(store):
    """The first artifact of each stage: its manifest."""
    found = {}
    for stage, key in artifacts(store):
        found.setdefault(stage, store.manifest(stage, key))
    return found


def test_an_artifact_of_each_stage_opens_with_xarray_and_has_units(whole):
    store = Store(whole.where / "cache")
    made = one_of_each_stage(store)
    assert len(made) > 25
    for stage, manifest in made.items():
        opened = xarray.open_zarr(f"zip::{store.root / reference(manifest).path}")
        assert set(opened.data_vars) == set(manifest["arrays"]), stage
        for name in opened.data_vars:
            assert opened[name].attrs["units"], (stage, name)
            assert opened[name].attrs["long_name"], (stage, name)


def value(store, made):
    """Digest of what a reader gets; None if the damage is seen."""
    ref = store.lookup(made["stage"], made["key"])
    if ref is None:
        return None
    try:
        bundle = store.open(ref)
        return output_digest(array_digests(bundle.arrays), bundle.meta)
    except DamagedError:
        return None


def test_an_artifact_of_each_stage_damaged_is_seen_or_read_as_it_was(whole, tmp_path, row):
    cache, rng = tmp_path / "cache", random.Random(7)
    shutil.copytree(whole.where / "cache", cache)
    store, tries, seen, wrong = Store(cache), 0, 0, []
    made = one_of_each_stage(store)
    for stage, manifest in made.items():
        path = cache / artifact_path(stage, manifest["key"])
        whole_file = path.read_bytes()
        for way in WAYS:
            for name in (*zipfile.ZipFile(path).namelist(), "directory"):
                tries += 1
                damage(path, way, name, rng)
                found = value(Store(cache), manifest)
                seen += found is None
                if found not in (None, manifest["digest"]):
                    wrong.append((stage, way, name))
                path.parent.mkdir(exist_ok=True)
                path.write_bytes(whole_file)
    row("each file of an artifact of each stage", tries, [], wrong, 0, 0, f"{len(made)} stages, {seen} seen when read")


def damage(path, way, name, rng):
    """A part of a file changed, or the whole of it cut short or removed."""
    data, change = path.read_bytes(), WAYS[way]
    if change is None:
        path.unlink()
        return
    start, stop = look.span(data, name) if way in ("zeros", "flip") else (0, len(data))
    path.write_bytes(data[:start] + change(data[start:stop], rng) + data[stop:])


def test_a_run_heals_an_artifact_of_each_stage(whole, tmp_path, row):
    cache, rng = tmp_path / "cache", random.Random(9)
    shutil.copytree(whole.where / "cache", cache)
    store, certain = Store(cache), 0
    made = one_of_each_stage(store)
    for turn, manifest in enumerate(made.values()):
        way = list(WAYS)[turn % len(WAYS)]
        path = cache / artifact_path(manifest["stage"], manifest["key"])
        damage(path, way, rng.choice(sorted(zipfile.ZipFile(path).namelist())), rng)
        certain += way in ("truncate", "empty", "delete")
    subprocess.run(command(tmp_path), check=True, stdout=subprocess.DEVNULL)
    healed = rows(tmp_path)
    wrong = [label for label, r in rows(whole.where).items() if healed[label]["digest"] != r["digest"]]
    wrong += same_files(whole, tmp_path)
    lost = sorted(set(whole.right) - set(look.manifests(cache)))
    # not by the ledger: what is found when the results are drawn is computed by a second run
    computed = sum(store.manifest(m["stage"], m["key"])["provenance"] != m["provenance"] for m in made.values())
    row("one artifact of each stage damaged", len(made), lost, wrong, computed, range(certain, len(made) + 1),
        "what keeps its size counts where it is read")  # fmt: skip


TILED = ("--frames", "0:2", "--set", "hfvm.preset=fast", "--set", "crosscheck.enabled=false")


def test_workers_killed_mid_tile(whole, tmp_path, row):
    calm, torn = tmp_path / "calm", tmp_path / "torn"
    words = (*TILED, "--set", "tiling.tile=128")
    subprocess.run(command(calm, *words), check=True, stdout=subprocess.DEVNULL)
    process, kills, tiles = begin(torn, *words), 0, 0
    # Twice: a task that loses its workers a third time counts as their killer.
    for wanted in (2, 9):
        while tiles < wanted and process.poll() is None:
            time.sleep(0.02)
            tiles = sum(path.read_text().count('"label": "hfvm/0/') for path in torn.glob("runs/*/*/ledger.jsonl"))
        assert process.poll() is None, process.stderr.read()
        for child in psutil.Process(process.pid).children():
            # A worker killed before may still be a zombie, which has no command.
            if child.status() != psutil.STATUS_ZOMBIE and "spawn_main" in " ".join(child.cmdline()):
                child.kill()
                kills += 1
    assert process.wait() == 0, process.stderr.read()
    found = rows(torn)
    wrong = [label for label, r in rows(calm).items() if found[label]["digest"] != r["digest"]]
    wrong += [label for label, r in found.items() if r["status"] != "computed"]
    assert upkeep_finds_nothing(torn / "cache")
    row(
        "workers killed mid-tile",
        2,
        [],
        wrong,
        len(found),
        len(found),
        f"{kills} workers died, {tiles} tiles were done",
    )


def upkeep_finds_nothing(cache):
    from rille.pipeline.engine.store import maintenance

    return maintenance.verify(Store(cache))[1] == []
