"""Programs killed and interrupted at random moments; what they published stays, only the rest is computed."""

from __future__ import annotations

import os
import random
import shutil
import signal
import time
from contextlib import suppress

import psutil
import pytest
from torn import look

from rille.pipeline.engine.store import maintenance
from rille.pipeline.engine.store.base import Store

WITHIN = 5.0
"""Seconds that an interrupted program may take to leave; held to where all cases are tried."""

HANGS = 60.0
"""Seconds after which it counts as hanging."""


FEW = 3


def gone(children, within):
    left = psutil.wait_procs(children, timeout=within)[1]
    return not [p for p in left if p.is_running() and p.status() != psutil.STATUS_ZOMBIE]


def statuses(found, status):
    return sum(node["status"] == status for node in found["nodes"].values())


def torment(program, calm, folder, executor, tries, seed):
    """Kill runs on a cache that lives on for a few of them; finish each cache, and compare."""
    rng = random.Random(seed)
    lost, wrong, recomputed, expected, ended, half = [], [], 0, 0, 0, 0
    right, total = calm["digests"], len(calm["digests"])
    cache, known = f"{folder}/cache-0", {}
    begin = time.monotonic()
    program.run(cache=f"{folder}/timed", executor=executor)
    span, first = time.monotonic() - begin, 0.0 if executor == "inline" else 0.4  # workers take their time to start

    def finish():
        nonlocal recomputed, expected, cache
        expected += total - len(known)
        found = program.run(cache=cache, executor="inline")
        recomputed += statuses(found, "computed")
        wrong.extend(look.wrong({n["key"]: n["digest"] for n in found["nodes"].values()}, right))
        wrong.extend(look.wrong(look.decoded(cache), right))
        shutil.rmtree(cache, ignore_errors=True)
        cache = f"{folder}/cache-{int(cache.rpartition('-')[2]) + 1}"
        known.clear()

    for _ in range(tries):
        begin, limit = time.monotonic(), rng.uniform(first, 1.1) * span
        pid = program.start(cache=cache, executor=executor)
        while time.monotonic() - begin < limit and program.running():
            time.sleep(0.001)
        over = not program.running()
        with suppress(ProcessLookupError):  # it has just ended
            os.killpg(pid, signal.SIGKILL)
        program.wait()
        if over:
            ended += 1
            span = 0.5 * span + 0.5 * (time.monotonic() - begin)
        else:
            span = max(span, 0.9 * limit)  # a busy machine is slower than the undisturbed run was
        found = look.published(cache)
        half += 0 < len(found) < total
        if not found:
            span *= 1.05
        lost += sorted(set(known) - set(found)) + sorted(look.manifests(cache) - set(found))
        wrong += look.wrong(found, right)
        known.clear()
        known.update(found)
        if over or rng.random() < 0.4:
            finish()
    finish()
    return lost, wrong, recomputed, expected, f"{half} left a part behind, {ended} had ended"


@pytest.mark.parametrize(
    ("executor", "tries"),
    [
        ("inline", 8),
        pytest.param("inline", 50, marks=pytest.mark.slow),
        pytest.param("dask", 30, marks=pytest.mark.slow),
    ],
)
def test_killed_at_random_moments(programs, calm, tmp_path, row, executor, tries):
    (program,) = programs(1)
    lost, wrong, recomputed, expected, remark = torment(program, calm, tmp_path, executor, tries, seed=tries)
    row(f"SIGKILL of the group, {executor}", tries, lost, wrong, recomputed, expected, remark)


@pytest.mark.parametrize(
    ("executor", "tries"),
    [
        ("inline", 3),
        pytest.param("inline", 20, marks=pytest.mark.slow),
        pytest.param("dask", 20, marks=pytest.mark.slow),
    ],
)
def test_interrupted_at_random_moments(programs, calm, tmp_path, row, executor, tries):
    (program,) = programs(1)
    rng, slowest, lost, wrong, recomputed, expected = random.Random(tries), 0.0, [], [], 0, 0
    within = HANGS
    if tries > FEW:  # others may have the processors
        within = WITHIN * max(1.0, os.getloadavg()[0] / len(os.sched_getaffinity(0)))
    for trial in range(tries):
        cache = tmp_path / str(trial)
        span = 1.2 * calm["seconds"] if executor == "inline" else 5.0
        pid = program.start(cache=str(cache), executor=executor, sleepers=3)
        time.sleep(rng.uniform(0.0, span))
        children = psutil.Process(pid).children(recursive=True)
        os.killpg(pid, signal.SIGINT)
        begin = time.monotonic()
        code, said = program.wait(), program.log.read_text()
        took = time.monotonic() - begin
        slowest = max(slowest, took)
        assert code == 130, f"{code} after {said}"
        assert took < within
        assert said == ""
        assert gone(children, HANGS)
        found = look.published(cache)
        lost += sorted(look.manifests(cache) - set(found))
        resumed = program.run(cache=str(cache))
        recomputed += statuses(resumed, "computed")
        expected += len(set(calm["digests"]) - set(found))
        wrong += look.wrong({n["key"]: n["digest"] for n in resumed["nodes"].values()}, calm["digests"])
    row(f"Ctrl-C, {executor}", tries, lost, wrong, recomputed, expected, f"left within {slowest:.1f} s")


DEATHS = ("task", "mkdir:1", "fsync:1", "link:1", "linked:1", "unlink:1")
PUBLISHED = ("linked:1", "unlink:1")
"""When these deaths come, the artifact is there."""


def die(program, calm, cache, tally, row, deaths, executor):
    """Workers that die at their work and in their commit, each once; another one goes on."""
    common = {"cache": str(cache), "sabotage": deaths, "tally": str(tally)}
    found = program.run(executor=executor, **common)
    assert found["ok"], found["nodes"]
    assert {p.name: p.stat().st_size for p in tally.iterdir()} == {
        d.replace(":", "-"): 1 if d in PUBLISHED else 2 for d in deaths
    }, "what was published before the worker died is not computed again"
    again = program.run(**common)
    right = calm["digests"] | {
        n["key"]: n["digest"] for n in found["nodes"].values() if n["key"] not in calm["digests"]
    }
    lost = [label for label, n in again["nodes"].items() if n["status"] != "cached"]
    wrong = [n for n, digest in calm["labels"].items() if found["nodes"][n]["digest"] != digest]
    wrong += look.wrong(look.decoded(cache), right)
    total = len(calm["digests"]) + len(deaths)
    computed = statuses(found, "computed") + statuses(found, "cached")  # published, but the worker could not say so
    where = "tcp" if "://" in executor else executor
    row(f"a worker dies at work, in its commit, {where}", len(deaths), lost, wrong, computed, total, ", ".join(deaths))


@pytest.mark.slow
def test_workers_that_die_at_their_work_and_in_their_commit(programs, calm, tmp_path, row):
    (program,) = programs(1)
    die(program, calm, tmp_path / "cache", tmp_path / "tally", row, DEATHS, "dask")


@pytest.mark.slow
def test_workers_of_a_cluster_that_die(programs, calm, tmp_path, row):
    from hands import by_hand

    (program,) = programs(1)
    with by_hand(tmp_path) as hands:
        for name in ("first", "second"):
            hands.worker(name, nanny="--nanny")
        die(program, calm, tmp_path / "cache", tmp_path / "tally", row, DEATHS, hands.address)


@pytest.mark.slow
def test_poison_takes_a_few_workers_each_and_nothing_else_along(programs, calm, tmp_path, row):
    (program,) = programs(1)
    cache, tally = tmp_path / "cache", tmp_path / "tally"
    poison = ("poison#1", "poison#2", "poison#3")
    found = program.run(cache=str(cache), executor="dask", sabotage=poison, tally=str(tally))
    failed = {label: n["why"] for label, n in found["nodes"].items() if n["status"] == "failed"}
    assert set(failed) == {f"saboteur/{p}" for p in poison}
    assert all(why.startswith("RilleError: 2 worker processes died") for why in failed.values())
    deaths = {p.name: p.stat().st_size for p in tally.iterdir()}
    assert set(deaths) == set(poison)
    assert set(deaths.values()) <= {2, 3, 4}, "two once nothing else ran; before, dask counts deaths by others, too"
    wrong = [n for n, digest in calm["labels"].items() if found["nodes"][n]["digest"] != digest]
    computed = statuses(found, "computed")
    row(
        "poison: a task kills each worker",
        3,
        [],
        wrong,
        computed,
        # what a worker commits just before it dies with a poison is found in the cache when it is tried again
        range(len(calm["digests"]) - len(poison), len(calm["digests"]) + 1),
        f"{sum(deaths.values())} workers died",
    )


@pytest.mark.slow
def test_a_worker_out_of_memory_is_named_with_its_memory(programs, calm, tmp_path, row):
    (program,) = programs(1)
    cache = tmp_path / "cache"
    found = program.run(
        cache=str(cache), executor="dask", sabotage=("memory",), tally=str(tmp_path / "tally"), memory=800_000_000
    )
    hog = found["nodes"]["saboteur/memory"]
    assert hog["status"] == "failed"
    assert "the last was ended at" in hog["why"]
    assert hog["why"].startswith("RilleError: 2 worker processes died")
    wrong = [n for n, digest in calm["labels"].items() if found["nodes"][n]["digest"] != digest]
    computed = statuses(found, "computed")
    row(
        "a worker runs out of memory",
        1,
        [],
        wrong,
        computed,
        len(calm["digests"]),
        hog["why"].split(":", 1)[1].strip(),
    )
    assert maintenance.verify(Store(cache))[1] == []
