"""Several runs on one cache, with clearing up beside them; and the whole chain on a small mockup, killed on its way."""

from __future__ import annotations

import os
import random
import shutil
import time

import pytest
from torn import look

from rille.pipeline.runs import lookup

RUNS = 3


def together(programs, cache, runs, executors, grace, **options):
    """Three runs at once, and one that clears up until they have ended."""
    *three, cleaner = programs(RUNS + 1)
    until = runs / "until"
    runs.mkdir(parents=True, exist_ok=True)
    cleaner.start(do="clear", cache=str(cache), runs=str(runs), until=str(until), grace=grace)
    for i, (program, executor) in enumerate(zip(three, executors, strict=True)):
        file = runs / "seq" / str(i) / "ledger.jsonl"
        program.start(cache=str(cache), executor=executor, ledger=str(file), **options)
    codes = [program.wait() for program in three]
    until.touch()
    codes.append(cleaner.wait())
    assert codes == [0] * (RUNS + 1), [p.log.read_text() for p in programs(RUNS + 1)]
    return [program.found() for program in three], cleaner.found()


EXECUTORS = ("inline", "dask", "inline")


@pytest.mark.parametrize("tries", [1, pytest.param(12, marks=pytest.mark.slow)])
def test_three_runs_on_one_cold_cache_with_clearing_beside(programs, calm, tmp_path, row, tries):
    lost, wrong, computed, sweeps, total = [], [], 0, 0, len(calm["digests"])
    for trial in range(tries):
        cache = tmp_path / f"cache-{trial}"
        found, cleared = together(programs, cache, tmp_path / f"runs-{trial}", EXECUTORS, grace=3600)
        sweeps += cleared["times"]
        assert cleared["removed"] == 0
        for run in found:
            assert run["ok"], [n["why"] for n in run["nodes"].values() if n["digest"] is None]
            computed += sum(n["status"] == "computed" for n in run["nodes"].values())
            wrong += look.wrong({n["key"]: n["digest"] for n in run["nodes"].values()}, calm["digests"])
        wrong += look.wrong(look.decoded(cache), calm["digests"])
        lost += sorted(set(calm["digests"]) ^ set(look.published(cache)))
        assert len(list(cache.glob("artifacts/*/*/*"))) == len(calm["digests"]), "nothing is left over"
        shutil.rmtree(cache)
    expected = range(tries * total, RUNS * tries * total + 1)
    row("three runs on one cold cache, with gc", tries, lost, wrong, computed, expected, f"{sweeps} sweeps of gc")


@pytest.mark.parametrize(
    ("tries", "executors"), [(1, 3 * ("inline",)), pytest.param(12, EXECUTORS, marks=pytest.mark.slow)]
)
def test_clearing_takes_old_artifacts_from_under_runs(programs, calm, tmp_path, row, tries, executors):
    """What no kept run names and nobody used for long is fair game until the moment it is looked up."""
    lost, wrong, computed, removed, total = [], [], 0, 0, len(calm["digests"])
    for trial in range(tries):
        cache, runs = tmp_path / f"cache-{trial}", tmp_path / f"runs-{trial}"
        shutil.copytree(calm["cache"], cache)
        rng = random.Random(trial)
        old = time.time() - 1e6
        for path in cache.glob("artifacts/*/*/*"):
            os.utime(path, (old, old))
        for path in cache.glob("artifacts/scale/*/*"):  # so that some must be computed from what may go
            if rng.random() < 0.7:
                path.unlink()
        found, cleared = together(programs, cache, runs, executors, grace=3600)
        removed += cleared["removed"]
        for run in found:
            assert run["ok"], [n["why"] for n in run["nodes"].values() if n["digest"] is None]
            computed += sum(n["status"] == "computed" for n in run["nodes"].values())
            wrong += look.wrong({n["key"]: n["digest"] for n in run["nodes"].values()}, calm["digests"])
        wrong += look.wrong(look.decoded(cache), calm["digests"])
        named = {key for file in runs.glob("*/*/ledger.jsonl") for key in lookup.used(file.parent)}
        lost += sorted(named - set(look.published(cache)))
        shutil.rmtree(cache)
    expected = range(RUNS * tries * total + 1)
    row("gc of old artifacts beside three runs", tries, lost, wrong, computed, expected, f"{removed} were cleared away")


def test_a_race_finds_a_stage_that_is_not_deterministic(programs, tmp_path, row):
    """Two that commit one key at once: the second is compared, and refused."""
    first, second = programs(2)
    tally = str(tmp_path / "tally")
    for program in (first, second):
        program.start(cache=str(tmp_path / "cache"), sabotage=["random"], tally=tally)
    codes = [first.wait(), second.wait()]
    assert codes == [0, 0]
    whys = [p.found()["nodes"]["saboteur/random"]["why"] for p in (first, second)]
    caught = sum("NonDeterministicError" in why for why in whys)
    row("planted non-deterministic stage, raced", 1, [], [], caught, 1, "detected: compared at the commit")
