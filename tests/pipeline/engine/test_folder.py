"""Artifacts on disk: round trip, commit, damage of every kind, and clearing up."""

from __future__ import annotations

import errno
import os
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy
from raising import raises

from pipeline.engine.store import artifact, maintenance, s3_maintenance
from pipeline.engine.store import folder as store
from pipeline.engine.store.artifact import array_digests, output_digest
from pipeline.engine.store.folder import Store
from stages.core.declare import Array, Bundle, NoParams, Stage

STAGE = Stage(
    name="toy",
    version=1,
    summary="",
    params=NoParams,
    inputs=(),
    outputs=(
        Array("elevation", ("row", "col"), "float32", "m", "elevation of the cell", nodata="nan", frame="world"),
        Array("flag", ("row", "col"), "bool", "1", "flag"),
        Array("count", (), "int64", "1", "count"),
        Array("level_*", ("row", "col"), "uint16", "1", "level"),
    ),
    run=lambda params, args, inputs: Bundle({}, {}),
)
KEY = "ab" * 32


def bundle(value=1.0, **meta):
    elevation = np.full((5, 7), value, dtype=np.float32)
    elevation[0] = np.nan
    elevation[1] = -0.0
    return Bundle(
        {
            "elevation": elevation,
            "flag": elevation > 0,
            "count": np.array(3),
            "level_0": np.arange(12, dtype=">u2").reshape(3, 4),
            "level_1": np.zeros((0, 2), dtype=np.uint16),
        },
        {"lattice": {"cell": 0.1, "rows": 5}, "none": None, "list": [1, 2.5], **meta},
    )


def commit(cache, **kwargs):
    return Store(cache).commit(STAGE, KEY, bundle(**kwargs), label="toy/1", provenance={"params": {"a": 1}})


def files(cache):
    return sorted(p for p in (cache / "artifacts").rglob("*") if p.is_file())


def test_round_trip_keeps_every_bit_and_the_digest(cache):
    ref = commit(cache)
    there = Store(cache).lookup("toy", KEY)
    assert there == ref
    read = Store(cache).open(ref)
    assert list(read.arrays) == ["count", "elevation", "flag", "level_0", "level_1"]
    for name, array in bundle().arrays.items():
        assert read[name].shape == array.shape
        assert read[name].dtype == array.dtype.newbyteorder("<")
        np.testing.assert_array_equal(read[name], array)
    assert np.signbit(read["elevation"][1]).all(), "an all -0.0 row is not the fill value"
    assert read.meta == bundle().meta
    assert output_digest(array_digests(read.arrays), read.meta) == ref.digest
    assert maintenance.verify(Store(cache)) == (1, [])


def test_xarray_reads_the_folder(cache):
    ref = commit(cache)
    with xarray.open_zarr(Store(cache).path(ref), consolidated=False) as data:
        assert data["elevation"].dims == ("row", "col")
        assert data["elevation"].attrs["units"] == "m"
        assert data["elevation"].attrs["long_name"] == "elevation of the cell"
        assert data["level_0"].dims == ("row_0", "col_0")
        np.testing.assert_array_equal(data["elevation"].values, bundle()["elevation"])


def test_arrays_are_read_on_access_only(cache):
    read = Store(cache).open(commit(cache))
    chunk = next(p for p in files(cache) if "elevation/c." in p.as_posix())
    chunk.unlink()
    assert read["count"] == 3
    with raises("RIL-504"):
        read["elevation"]
    with pytest.raises(KeyError, match=r"no array 'height', only count"):
        read["height"]


@given(st_numpy.arrays(np.float32, (3,), elements=st.floats(width=32)))
def test_digest_ignores_layout_and_nan_payload_only(values):
    digest = array_digests({"a": values})
    payload = values.copy()
    payload.view(np.uint32)[np.isnan(values)] ^= 1
    assert array_digests({"a": payload.astype(">f4")}) == digest
    assert array_digests({"a": np.repeat(values, 2)[::2]}) == digest
    assert array_digests({"a": values.astype(np.float64)}) != digest
    assert array_digests({"a": values[:, None]}) != digest
    other = values.copy()
    other.view(np.uint32)[1] ^= 1 << 31
    assert (array_digests({"a": other}) != digest) or np.isnan(values[1])


@pytest.mark.parametrize("meta", [{"a": float("nan")}, {"a": [float("inf")]}, {"a": {1: 2}}, {"a": np.float32(1)}])
def test_meta_must_be_json(cache, meta):
    with pytest.raises(TypeError, match=r"meta\.a"):
        commit(cache, **meta)
    assert not cache.exists() or not files(cache)


def test_a_race_publishes_one_and_compares_the_others(cache):
    start = threading.Barrier(6)

    def one(i):
        start.wait()
        return commit(cache)

    with ThreadPoolExecutor(6) as pool:
        refs = list(pool.map(one, range(6)))
    assert len({r.path for r in refs}) == 1
    assert len(list((cache / "artifacts/toy" / KEY[:2] / KEY).iterdir())) == 2, "one manifest, one attempt"


def test_another_result_for_the_same_key_is_an_error_of_its_own(cache):
    first = commit(cache)
    with raises("RIL-577", "toy/1"):
        commit(cache, value=2.0)
    with raises("RIL-577"):
        commit(cache, extra=1)
    assert Store(cache).lookup("toy", KEY) == first
    assert maintenance.verify(Store(cache)) == (1, [])


KINDS = ("manifest.json", "/zarr.json", "elevation/zarr.json", "elevation/c.0.0", "flag/c.0.0")


def find(cache, kind):
    return next(p for p in files(cache) if p.as_posix().endswith(kind))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("how", ["truncate", "empty", "delete", "lengthen"])
def test_damage_that_changes_a_size_is_a_miss_and_heals(cache, kind, how):
    ref = commit(cache)
    path = find(cache, kind)
    data = path.read_bytes()
    if how == "delete":
        path.unlink()
    else:
        path.write_bytes({"truncate": data[:-1], "empty": b"", "lengthen": data + b" "}[how])
    assert Store(cache).lookup("toy", KEY) is None
    assert len(list((cache / "quarantine").glob("*"))) == (0 if (kind, how) == ("manifest.json", "delete") else 1)
    again = commit(cache)
    assert (again.digest, again.path == ref.path) == (ref.digest, False)
    assert maintenance.verify(Store(cache)) == (1, [])


@pytest.mark.parametrize("kind", KINDS)
def test_any_flipped_bit_is_found_by_verify(cache, kind):
    rng = np.random.default_rng(3)
    for _ in range(4):
        digest = commit(cache).digest
        path = find(cache, kind)
        data = bytearray(path.read_bytes())
        at = rng.integers(len(data))
        data[at] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        sound, found = maintenance.verify(Store(cache))
        assert sound == 0
        assert [d.key for d in found] == [KEY]
        assert Store(cache).lookup("toy", KEY) is None
        assert commit(cache).digest == digest
        assert maintenance.verify(Store(cache)) == (1, [])


@pytest.mark.parametrize("kind", ["elevation/zarr.json", "elevation/c.0.0"])
def test_a_flipped_bit_never_reaches_a_reader(cache, kind):
    rng = np.random.default_rng(4)
    for _ in range(6):
        ref = commit(cache)
        path = find(cache, kind)
        data = bytearray(path.read_bytes())
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        with raises("RIL-504", "toy/1"):
            Store(cache).open(ref)["elevation"]
        assert Store(cache).lookup("toy", KEY) is None


@pytest.mark.parametrize(("old", "new"), [(b"5,", b"4,"), (b'"units": "m"', b'"units": "k"')])
def test_a_description_that_is_plausible_but_wrong_never_reaches_a_reader(cache, old, new):
    ref = commit(cache)
    path = find(cache, "elevation/zarr.json")
    assert old in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(old, new, 1))
    with raises("RIL-504"):
        Store(cache).open(ref)["elevation"]


def test_an_attempt_that_fails_leaves_nothing(cache, monkeypatch):
    def full(folder, files):
        artifact.spill(folder, files)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(store, "spill", full)
    with raises("RIL-574"):
        commit(cache)
    assert files(cache) == []


def test_a_cache_that_may_not_be_written_is_one_line_and_still_read(cache, monkeypatch):
    ref = commit(cache)

    def refuse(*args, **kwargs):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(Path, "mkdir", refuse)
    assert Store(cache).lookup("toy", KEY) == ref
    find(cache, "elevation/c.0.0").write_bytes(b"")
    assert Store(cache).lookup("toy", KEY) is None, "damaged, though it cannot be set aside"
    with raises("RIL-575") as caught:
        commit(cache)
    assert "\n" not in str(caught.value)


def test_a_file_in_place_of_the_cache_is_said(tmp_path):
    (tmp_path / "file").write_text("")
    for use in (lambda: Store(tmp_path / "file").lookup("toy", KEY), lambda: commit(tmp_path / "file")):
        with raises("RIL-576"):
            use()


def test_everything_is_on_the_disk_before_the_manifest_is(cache, monkeypatch):
    """Every file, every folder of the attempt, then the link, then the folders above."""
    log = []
    synced, link = os.fsync, os.link

    def linking(a, b):
        if Path(b).name == "manifest.json":
            log.append("link")
        link(a, b)

    monkeypatch.setattr(os, "fsync", lambda fd: (log.append(os.readlink(f"/proc/self/fd/{fd}")), synced(fd)))
    monkeypatch.setattr(os, "link", linking)
    ref = commit(cache)
    before, after = log[: log.index("link")], log[log.index("link") + 1 :]
    attempt = cache / ref.path
    wanted = {str(attempt), *(str(p) for p in attempt.rglob("*"))}
    assert wanted <= set(before)
    assert any(name.endswith(".tmp") for name in before)
    assert {str(attempt.parent), str(attempt.parent.parent)} <= set(after)


def test_gc_keeps_what_is_named_or_young(cache):
    ref = commit(cache)
    orphan = cache / "artifacts/toy" / KEY[:2] / KEY / "a-orphan"
    orphan.mkdir()
    (orphan / "x").write_bytes(b"123")
    assert vars(maintenance.gc(Store(cache), set())) == {"artifacts": 0, "orphans": 0, "bytes": 0, "stages": {}}, (
        "all is young"
    )
    old = time.time() - 10
    for path in (orphan, cache / "artifacts/toy" / KEY[:2] / KEY / "manifest.json"):
        os.utime(path, (old, old))
    cleared = maintenance.gc(Store(cache), {KEY}, grace=5, dry_run=True)
    assert (cleared.artifacts, cleared.orphans, cleared.bytes) == (0, 1, 3)
    assert orphan.exists()
    assert maintenance.gc(Store(cache), {KEY}, grace=5).orphans == 1
    assert Store(cache).lookup("toy", KEY) == ref
    gone = maintenance.gc(Store(cache), set(), grace=5)
    assert (gone.artifacts, gone.orphans) == (1, 0)
    assert gone.bytes > 1000
    assert list((cache / "artifacts/toy" / KEY[:2]).iterdir()) == []


def test_large_arrays_are_chunked(cache):
    rng = np.random.default_rng(0)
    big = rng.normal(size=(artifact.CHUNK + 10, 30)).astype(np.float32)
    ref = Store(cache).commit(STAGE, KEY, Bundle({"elevation": big}, {}))
    assert len([p for p in files(cache) if "/c." in p.as_posix()]) == 2
    np.testing.assert_array_equal(Store(cache).open(ref)["elevation"], big)


def test_chunks_of_nothing_are_files_too(cache):
    nothing = {"elevation": np.full((2, 2), np.nan, np.float32), "flag": np.zeros((2, 2), bool)}
    Store(cache).commit(STAGE, KEY, Bundle(nothing, {}))
    assert len([p for p in files(cache) if "/c." in p.as_posix()]) == 2


@pytest.mark.parametrize("name", ["locus", "mockup.scene"])
def test_the_name_of_a_stage_may_have_a_point(cache, name):
    """On disk and in a bucket: those of the simulator have one."""
    Store(cache).commit(replace(STAGE, name=name), KEY, bundle(), label="here")
    assert Store(cache).lookup(name, KEY) is not None
    assert s3_maintenance.MANIFEST.fullmatch(f"manifests/{name}/{KEY}.json")[1] == name
    assert s3_maintenance.ATTEMPT.match(f"data/{name}/{KEY}/a-0f/zarr.json")[1] == name
