"""Every kind of file damaged in every way, disks that fill up at every step, disks that may not be written."""

from __future__ import annotations

import errno
import json
import os
import random
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from torn import chain, look
from torn.faults import Faults

from rille.pipeline.engine import run as driver
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.store import artifact, maintenance
from rille.pipeline.engine.store.artifact import artifact_path
from rille.pipeline.engine.store.base import NonDeterministicError, Store, StoreError
from rille.stages.core.declare import NoParams

WAYS = {
    "truncate": lambda data, rng: data[: rng.randrange(len(data))],
    "empty": lambda data, rng: b"",
    "zeros": lambda data, rng: bytes(len(data)),
    "delete": None,
    "flip": lambda data, rng: _flipped(data, rng.randrange(8 * len(data))),
}

KINDS = {
    "manifest": "manifest.json",
    "group": "zarr.json",
    "array": "values/zarr.json",
    "chunk": "values/c.0.0",
    "other chunk": "mask/c.0.0",
    "directory": "directory",
    "label": "hints/-/keys-.json",
}
"""Members of an artifact's file, and what is beside the artifacts."""
HINTS = ("label",)
READ = ("manifest", "chunk")
"""Kinds that a task which reads ``values`` sees."""


def _flipped(data, bit):
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


SMALL = 3
"""Frames of the chain here: everything is done very often."""


@pytest.fixture(autouse=True)
def _no_waiting_for_the_disk(monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda handle: None)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """The undisturbed run of the small chain, as ``calm``."""
    cache = tmp_path_factory.mktemp("small") / "cache"
    graph, _ = run(cache)
    nodes = {h.label: {"key": h.key} for h in graph.nodes}
    return {"cache": cache, "nodes": nodes, "digests": digests(graph)}


def run(cache, **options):
    graph = Graph()
    force = options.pop("force", ())
    chain.build(graph, frames=SMALL, size=40, **options)
    try:
        result = driver.run(graph, Store(cache), driver.RunOptions(executor="inline", keep_going=True, force=force))
    except StoreError as error:  # refused before anything is computed
        result = driver.Result(failures=[driver.Failure("the cache", "", error)])
    return graph, result


def digests(graph):
    return {h.key: h.ref.digest for h in graph.nodes if h.ref}


def damaged(calm, cache, kind, way, rng):
    """A copy of the undisturbed cache with one file damaged; whether a look-up must see it."""
    shutil.copytree(calm["cache"], cache)
    key = calm["nodes"]["numbers/1"]["key"]
    found = cache.glob(KINDS[kind] if kind in HINTS else artifact_path("numbers", key))
    (path,) = found
    data = path.read_bytes()
    change = WAYS[way]
    if change is None:
        path.unlink()
        return kind not in HINTS
    start, stop = 0, len(data)
    if kind not in HINTS and way in ("zeros", "flip"):
        start, stop = look.span(data, KINDS[kind])
    path.write_bytes(data[:start] + change(data[start:stop], rng) + data[stop:])
    return kind not in HINTS and (kind == "manifest" or path.stat().st_size != len(data))


def readable(path):
    """Whether an archive gives what a task reads that reads ``values``."""
    try:
        with artifact.opened(str(path)) as file:
            file.member("values/c.0.0", file.size)
    except artifact.BrokenError:
        return False
    return True


@pytest.mark.parametrize("rounds", [1, pytest.param(12, marks=pytest.mark.slow)])
def test_damage_of_one_file(small, tmp_path, row, rounds):
    """Look-up sees the manifest; a reader sees contents and heals what it reads; ``cache verify`` sees all."""
    for kind in KINDS:
        lost, wrong, recomputed, expected, tries = [], [], 0, 0, 0
        for way in WAYS:
            for turn in range(rounds):
                tries, cache = tries + 1, tmp_path / f"{kind}-{way}-{turn}"
                seen = damaged(small, cache, kind, way, random.Random(turn))
                artifact = kind not in HINTS
                read = kind in READ
                if kind == "directory":  # some of its bytes say nothing, and some name what is read
                    key = small["nodes"]["numbers/1"]["key"]
                    seen = Store(cache).manifest("numbers", key) is None
                    read = not seen and not readable(cache / artifact_path("numbers", key))

                # a run that reads nothing: what the look-up sees is computed again
                graph, result = run(cache)
                wrong += look.wrong(digests(graph), small["digests"])
                recomputed += result.counts["computed"]
                expected += seen

                # a run in which all scales are computed again, and read
                healed = not seen and artifact and read
                graph, result = run(cache, force={"scale"})
                assert result.ok, (kind, way, result.failures)
                wrong += look.wrong(digests(graph), small["digests"])
                recomputed += result.counts["computed"]
                expected += SMALL + healed

                # what nobody reads is found by comparing everything
                _, found = maintenance.verify(Store(cache))
                unseen = artifact and not seen and not healed
                assert len(found) == unseen or (kind == "directory" and unseen), (kind, way, found)
                graph, result = run(cache)
                wrong += look.wrong(digests(graph), small["digests"])
                wrong += look.wrong(look.decoded(cache), small["digests"])
                recomputed += result.counts["computed"]
                expected += len(found)
                lost += sorted(set(small["digests"]) - set(look.published(cache)))
                shutil.rmtree(cache)
        row(f"damage: {kind}", tries, lost, wrong, recomputed, expected, ", ".join(WAYS))


def test_a_damaged_input_that_cannot_be_healed_is_an_error(small, tmp_path, monkeypatch):
    """On a disk that may not be written the damaged one stays; it must not be read for sound."""
    cache = tmp_path / "cache"
    damaged(small, cache, "chunk", "zeros", random.Random(0))
    Faults(monkeypatch, cache, code=errno.EROFS, fail_at=1, onwards=True)
    monkeypatch.setattr(Store, "writable", lambda _: None)  # it has become so just after the run began
    _, result = run(cache, force={"scale"})
    assert not result.ok
    assert any("is damaged" in str(f.error) for f in result.failures)


def steps_of(monkeypatch, cache):
    with monkeypatch.context() as patch:
        faults = Faults(patch, cache)
        run(cache)
    return len(faults.steps)


@pytest.mark.parametrize(("code", "every"), [(errno.ENOSPC, 29), pytest.param(errno.ENOSPC, 1, marks=pytest.mark.slow)])
def test_disk_full_at_a_step(small, tmp_path, row, monkeypatch, code, every):
    total = steps_of(monkeypatch, tmp_path / "counted")
    lost, wrong, recomputed, expected, tries, orphans = [], [], 0, 0, 0, 0
    for onwards in (False, True):
        for step in range(1, total + 1, every):
            tries, cache = tries + 1, tmp_path / f"{step}-{onwards}"
            with monkeypatch.context() as patch:
                faults = Faults(patch, cache, code=code, fail_at=step, onwards=onwards)
                graph, result = run(cache)
            assert faults.fired
            assert all(isinstance(f.error, StoreError) and "No space left" in str(f.error) for f in result.failures)
            found = look.published(cache)
            assert onwards or result.failures or len(found) == len(small["digests"])
            lost += sorted(look.manifests(cache) - set(found)) + sorted({*digests(graph)} - {*found})
            wrong += look.wrong(found, small["digests"])
            cleared = maintenance.gc(Store(cache), found, grace=-1.0)
            orphans += len(cleared.get("", []))
            assert set(cleared) <= {""}
            left = [p for p in cache.rglob("*") if ".tmp" in p.name or ".partial" in p.name]
            assert not left, (faults.steps[step - 1], left)
            graph, result = run(cache)
            wrong += look.wrong(digests(graph), small["digests"])
            recomputed += result.counts["computed"]
            expected += len(small["digests"]) - len(found)
            shutil.rmtree(cache, ignore_errors=True)
    every_one = "each step" if every == 1 else f"each {every}th step"
    remark = f"{orphans} orphans, which gc clears away"
    row(f"disk full at {every_one} of {total}", tries, lost, wrong, recomputed, expected, remark)


QUOTA = """
mount -t tmpfs -o size={size}k tmpfs {cache} || exit 9
{python} -m torn.chain '{{"do": "run", "cache": "{cache}", "out": "{out}"}}'
cp -r {cache}/. {copy}
"""


@pytest.mark.slow
def test_disk_that_is_really_full(programs, calm, tmp_path, row):
    """A calm file system of its own, where the machine permits one."""
    if subprocess.run(["unshare", "--mount", "true"], capture_output=True, check=False).returncode:
        pytest.skip("no name space of mounts of our own here")
    lost, wrong, recomputed, expected, sizes = [], [], 0, 0, (60, 200, 500, 900)
    for size in sizes:
        cache, copy, out = (tmp_path / f"{what}-{size}" for what in ("cache", "copy", "out"))
        cache.mkdir()
        script = QUOTA.format(size=size, cache=cache, copy=copy, out=out, python=sys.executable)
        env = {**os.environ, "PYTHONPATH": os.pathsep.join(look.PLACES)}
        done = subprocess.run(["unshare", "--mount", "sh", "-c", script], env=env, capture_output=True, text=True)
        assert "Traceback" not in done.stderr, done.stderr
        nodes = json.loads(Path(f"{out}").read_text())["nodes"]
        failed = [n["why"] for n in nodes.values() if n["status"] == "failed"]
        assert failed
        assert all("No space left" in why for why in failed), failed
        found = look.published(copy)
        lost += sorted(look.manifests(copy) - set(found))
        wrong += look.wrong(found, calm["digests"])
        (program,) = programs(1)
        recomputed += sum(n["status"] == "computed" for n in program.run(cache=str(copy))["nodes"].values())
        expected += len(calm["digests"]) - len(found)
        wrong += look.wrong(look.decoded(copy), calm["digests"])
    row("disk really full", len(sizes), lost, wrong, recomputed, expected, f"file systems of {sizes} kB")


def test_read_only_cache(small, tmp_path, row, monkeypatch):
    warm, part = tmp_path / "warm", tmp_path / "part"
    shutil.copytree(small["cache"], warm)
    shutil.copytree(small["cache"], part)
    missing = small["nodes"]["total/1"]["key"]
    (part / artifact_path("total", missing)).unlink()
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    with monkeypatch.context() as patch:
        Faults(patch, tmp_path, code=errno.EROFS, fail_at=1, onwards=True)
        graph, result = run(warm)
        assert result.ok
        lacking, failed = run(part)
    assert [h.label for h in lacking.nodes if h.status == "pending"] == ["total/1"], "nothing was begun"
    assert isinstance(failed.failures[0].error, StoreError)
    assert "cannot be used (Read-only file system)" in str(failed.failures[0].error)
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before
    wrong = look.wrong(digests(graph), small["digests"]) + look.wrong(digests(lacking), small["digests"])
    row("read-only cache", 2, [], wrong, result.counts["computed"], 0, "what is missing is refused in one line")


@pytest.mark.parametrize("seeds", [3, pytest.param(30, marks=pytest.mark.slow)])
def test_shuffled_order(calm, tmp_path, row, seeds):
    wrong, computed = [], 0
    for seed in range(seeds):
        graph = Graph()
        chain.build(graph, shuffle=seed)
        result = driver.run(graph, Store(tmp_path / str(seed)), driver.RunOptions(executor="inline"))
        computed += result.counts["computed"]
        wrong += [h.label for h in graph.nodes if h.ref.digest != calm["labels"][h.label]]
    row("shuffled order of tasks", seeds, [], wrong, computed, seeds * len(calm["digests"]), "inline")


def test_a_stage_that_is_not_deterministic_is_detected(tmp_path, row):
    """When it is forced, when two runs race, and when its damaged artifact is healed within a run."""
    cache, caught = tmp_path / "cache", 0

    def attempt(**options):
        nonlocal caught
        graph = Graph()
        node = graph.node("toys.mischief", "random", NoParams(), {"what": "random"})
        graph.node("torn.reader", "reader", NoParams(), inputs={"values": node})
        result = driver.run(graph, Store(cache), driver.RunOptions(executor="inline", keep_going=True, **options))
        caught += any(isinstance(f.error, NonDeterministicError) for f in result.failures)
        return graph, result

    graph, result = attempt()
    assert result.ok
    digest = graph.nodes[0].ref.digest
    _, result = attempt(force={"mischief"})
    assert caught == 1
    store = Store(cache)
    ref = store.lookup("mischief", graph.nodes[0].key)
    assert ref.digest == digest, "the first one stays"
    path = cache / ref.path
    start, stop = look.span(path.read_bytes(), "value/c.0")
    path.write_bytes(path.read_bytes()[:start] + bytes(stop - start) + path.read_bytes()[stop:])
    _, result = attempt(force={"reader"})
    assert caught == 2
    row("planted non-deterministic stage", 2, [], [], caught, 2, "detected: forced; healed")
