"""Artifacts on disk: round trip, commit, damage of every kind, and clearing up."""

from __future__ import annotations

import errno
import json
import os
import threading
import time
import warnings
import zipfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import google_crc32c
import numpy as np
import pytest
import xarray
import zarr
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy
from raising import raises

from rille.pipeline.commands.options import cache_folder
from rille.pipeline.engine.store import folder, maintenance, manifest, zarr_group
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.output_digest import array_digests, output_digest
from rille.stages.core.declare import Array, Bundle, NoParams, Stage

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


def file_of(cache):
    (path,) = files(cache)
    return path


def span(cache, kind):
    """Where in the file of an artifact a part lies: its manifest, a member, or the directory of the archive."""
    data = file_of(cache).read_bytes()
    size = manifest.length(data)
    if kind in ("manifest", "directory"):
        return (0, size) if kind == "manifest" else (data.rindex(b"PK\x01\x02"), len(data))
    start, length, _ = manifest.unframe(data[:size])["files"][kind]
    return start, start + length


def patch(cache, kind, change):
    """Rewrite a part of the file, of the same size."""
    start, stop = span(cache, kind)
    data = bytearray(file_of(cache).read_bytes())
    data[start:stop] = change(bytes(data[start:stop]))
    file_of(cache).write_bytes(data)


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


def test_xarray_opens_it(cache):
    ref = commit(cache)
    for way in (Store(cache).path(ref), zarr.storage.ZipStore(cache / ref.path, mode="r")):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            data = xarray.open_zarr(way)
        assert data["elevation"].dims == ("row", "col")
        assert data["elevation"].attrs["units"] == "m"
        assert data["elevation"].attrs["long_name"] == "elevation of the cell"
        assert data["level_0"].dims == ("row_0", "col_0")
        np.testing.assert_array_equal(data["elevation"].values, bundle()["elevation"])


def test_an_artifact_is_one_file_that_any_reader_of_zip_files_finds_sound(cache):
    ref = commit(cache)
    assert len(files(cache)) == 1
    with zipfile.ZipFile(cache / ref.path) as archive:
        assert archive.testzip() is None
        assert {"zarr.json", "elevation/zarr.json", "elevation/c.0.0"} <= set(archive.namelist())
        assert {m.compress_type for m in archive.infolist()} == {zipfile.ZIP_STORED}
    assert ref.stored == (cache / ref.path).stat().st_size


def test_equal_arrays_make_equal_archives(tmp_path):
    made = []
    for name, provenance in (("a", {"host": "x"}), ("b", {"host": "another"})):
        ref = Store(tmp_path / name).commit(STAGE, KEY, bundle(), provenance=provenance)
        data = (tmp_path / name / ref.path).read_bytes()
        made.append(data[manifest.length(data) :])
    assert made[0] == made[1]


def test_a_manifest_may_be_long(cache):
    ref = commit(cache, many=list(range(20_000)))
    assert manifest.length((cache / ref.path).read_bytes()) > 2 * manifest.FIRST
    assert Store(cache).lookup("toy", KEY) == ref
    assert Store(cache).open(ref)["count"] == 3


def test_what_another_run_has_put_there_meanwhile_is_not_taken_for_ours(cache):
    ref = commit(cache)
    file_of(cache).unlink()
    commit(cache, value=2.0)
    with raises("RIL-572", "toy"):
        Store(cache).open(ref)


def test_arrays_are_read_on_access_only(cache):
    read = Store(cache).open(commit(cache))
    file_of(cache).unlink()
    with raises("RIL-504", "missing"):
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


def test_only_numbers_are_stored():
    for array in (np.array([1j]), np.array(["a"]), np.array([None])):
        with pytest.raises(TypeError, match="array a is"):
            array_digests({"a": array})


@pytest.mark.parametrize(
    "meta",
    [{"a": {1: 2}}, {"a": np.float32(1)}, {"a": {1}}, {"a": frozenset()}],
)
def test_meta_must_be_json(cache, meta):
    with pytest.raises(TypeError, match=r"result\.meta\.a|type (frozen)?set is not JSON"):
        commit(cache, **meta)
    assert not cache.exists() or not files(cache)


def test_an_undefined_fact_is_none_before_and_after_the_commit(cache):
    undefined = {"a": float("nan"), "b": [1.0, float("inf")], "c": [{"d": (np.float64("-inf"), 2)}]}
    defined = {"a": None, "b": [1.0, None], "c": [{"d": [None, 2]}]}
    assert Bundle({}, undefined).meta == defined
    read = Store(cache).open(commit(cache, **undefined)).meta
    assert {name: read[name] for name in undefined} == defined


def test_a_race_publishes_one_and_compares_the_others(cache):
    start = threading.Barrier(6)

    def one(i):
        start.wait()
        return commit(cache)

    with ThreadPoolExecutor(6) as pool:
        refs = list(pool.map(one, range(6)))
    assert len({r.path for r in refs}) == 1
    assert len(files(cache)) == 1, "the losers have cleared up"


def test_another_result_for_the_same_key_is_an_error_of_its_own(cache):
    first = commit(cache)
    with raises("RIL-577", "toy/1", "elevation"):
        commit(cache, value=2.0)
    with raises("RIL-577", "meta"):
        commit(cache, extra=1)
    assert Store(cache).lookup("toy", KEY) == first
    assert maintenance.verify(Store(cache)) == (1, [])


def test_an_artifact_that_goes_and_comes_again_between_two_looks_is_no_other_result(cache, monkeypatch):
    ref, store = commit(cache), Store(cache)
    path, gone, look = cache / ref.path, cache / "elsewhere", store.lookup

    def meanwhile(*args, **options):
        path.rename(gone)
        try:
            return look(*args, **options)
        finally:
            gone.rename(path)
            monkeypatch.setattr(store, "lookup", look)

    monkeypatch.setattr(store, "lookup", meanwhile)
    assert store.commit(STAGE, KEY, bundle()) == ref


KINDS = ("manifest", "zarr.json", "elevation/zarr.json", "elevation/c.0.0", "flag/c.0.0", "directory")


@pytest.mark.parametrize("how", ["truncate", "empty", "delete", "lengthen"])
def test_damage_that_changes_the_size_is_a_miss_and_heals(cache, how):
    ref = commit(cache)
    path = file_of(cache)
    data = path.read_bytes()
    if how == "delete":
        path.unlink()
    else:
        path.write_bytes({"truncate": data[:-1], "empty": b"", "lengthen": data + b" "}[how])
    assert Store(cache).lookup("toy", KEY) is None
    assert len(list((cache / "quarantine").glob("*.txt"))) == (how != "delete")
    assert commit(cache) == ref
    assert maintenance.verify(Store(cache)) == (1, [])


@pytest.mark.parametrize("kind", KINDS)
def test_any_flipped_bit_is_found_by_verify(cache, kind):
    rng = np.random.default_rng(3)
    for _ in range(4):
        digest = commit(cache).digest
        patch(cache, kind, lambda data: flipped(data, rng))
        sound, found = maintenance.verify(Store(cache))
        assert sound == 0
        assert [d.key for d in found] == [KEY]
        assert Store(cache).lookup("toy", KEY) is None
        assert commit(cache).digest == digest
        assert maintenance.verify(Store(cache)) == (1, [])


def flipped(data, rng):
    at = rng.integers(len(data))
    return data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :]


@pytest.mark.parametrize("kind", ["elevation/zarr.json", "elevation/c.0.0"])
def test_a_flipped_bit_never_reaches_a_reader(cache, kind):
    rng = np.random.default_rng(4)
    for _ in range(6):
        ref = commit(cache)
        patch(cache, kind, lambda data: flipped(data, rng))
        with raises("RIL-504", "toy/1"):
            Store(cache).open(ref)["elevation"]
        assert Store(cache).lookup("toy", KEY) is None


@pytest.mark.parametrize(("old", "new"), [(b"5,", b"4,"), (b'"units": "m"', b'"units": "k"')])
def test_a_description_that_is_plausible_but_wrong_never_reaches_a_reader(cache, old, new):
    ref = commit(cache)
    start, stop = span(cache, "elevation/zarr.json")
    assert old in file_of(cache).read_bytes()[start:stop]
    patch(cache, "elevation/zarr.json", lambda data: data.replace(old, new, 1))
    with raises("RIL-504"):
        Store(cache).open(ref)["elevation"]


def forge(cache, change):
    """Change the manifest as somebody would who can compute its checksum."""
    data = file_of(cache).read_bytes()
    size = manifest.length(data)
    found = json.loads(data[:size])["manifest"]
    change(found)
    file_of(cache).write_bytes(manifest.frame(found) + data[size:])


def test_verify_finds_an_artifact_in_the_place_of_another(cache):
    path = cache / commit(cache).path
    path.with_name(f"ab{'c' * 62}.zarr.zip").write_bytes(path.read_bytes())
    sound, found = maintenance.verify(Store(cache))
    assert (sound, [d.key for d in found]) == (1, ["ab" + "c" * 62])


def test_deep_verification_finds_facts_that_were_not_computed(cache):
    commit(cache)
    forge(cache, lambda found: found["meta"].update(none=1))
    assert maintenance.verify(Store(cache)) == (1, [])
    sound, found = maintenance.verify(Store(cache), deep=True)
    assert (sound, [d.reason for d in found]) == (0, ["the metadata have another digest"])


@pytest.mark.parametrize("about", [{"shape": [10**6, 10**6]}, {"dtype": "<f99"}, {"dtype": "|O8"}])
def test_a_forged_manifest_that_claims_what_no_archive_holds_is_a_miss(cache, about):
    commit(cache)
    forge(cache, lambda found: found["arrays"]["elevation"].update(about))
    assert Store(cache).lookup("toy", KEY) is None


@pytest.mark.parametrize(
    "change",
    [
        {"stage": "scale"},
        {"key": "j" * 64},
        {"files": {"../../x": [0, 1, "00000000"]}},
        {"files": {"flag/c.0.0": [0, "1", "00000000"]}},
        {"files": {"flag/c.0.0": [0, 10**9, "00000000"]}},
        {"files": {"flag/c.0.0": [-5, 5, "00000000"]}},
        {"archive": None},
        {"arrays": {"flag": {"dtype": "<f8", "shape": ["9" * 5000], "sha256": ""}}},
        {"arrays": {"flag": {"dtype": "|O8", "shape": [1], "sha256": ""}}},
        {"meta": None},
        {"label": ["a"]},
    ],
)
def test_a_manifest_that_is_wrong_by_intent_counts_as_damaged(cache, change):
    """All but the change is right: offsets, size and checksum."""
    commit(cache)
    data = file_of(cache).read_bytes()
    start = manifest.length(data)
    file_of(cache).write_bytes(manifest.frame(json.loads(data[:start])["manifest"] | change) + data[start:])
    assert Store(cache).lookup("toy", KEY) is None
    assert files(cache) == [], "it was set aside"


@pytest.mark.parametrize("text", [b"[" * 100_000, b'{"path": ' * 50_000, b"[]", b"1" * 5000])
def test_a_manifest_that_is_no_object_is_damaged(text):
    line = manifest._HEAD % (google_crc32c.value(text), len(text)) + text + b"}\n"
    with pytest.raises(ValueError):  # noqa: PT011
        manifest.unframe(line)


def test_a_forged_archive_never_makes_an_array_of_another_size(cache, monkeypatch):
    ref = commit(cache)
    data, described = file_of(cache).read_bytes(), zarr_group.encode

    def other(stage, given):
        files, arrays = described(stage, given)
        about = json.loads(files["elevation/zarr.json"]) | {"shape": [10**7, 10**7]}
        return {**files, "elevation/zarr.json": json.dumps(about).encode()}, arrays

    file_of(cache).unlink()
    monkeypatch.setattr("rille.pipeline.engine.store.base.encode", other)
    assert commit(cache).digest == ref.digest
    assert file_of(cache).read_bytes() != data
    monkeypatch.setattr("rille.pipeline.engine.store.lazy_arrays.LazyArrays._one_chunk", lambda *_: None)
    with raises("RIL-504", "two ways"):
        Store(cache).open(ref)["elevation"]


def test_what_another_run_has_put_right_meanwhile_is_not_set_aside(cache):
    """A reader of the damaged file learns of it when a sound one is there again."""
    ref = commit(cache)
    patch(cache, "elevation/c.0.0", lambda data: bytes(len(data)))
    maintenance.verify(Store(cache))
    assert commit(cache) == ref
    Store(cache).set_aside("toy", KEY, {"attempt": "that of the damaged one"}, "reason")
    assert Store(cache).lookup("toy", KEY) == ref


def test_artifacts_of_an_earlier_format_are_said_once_and_cleared(cache, capsys):
    old = cache / "artifacts/toy" / KEY[:2] / KEY
    (old / "a-01").mkdir(parents=True)
    (old / "manifest.json").write_bytes(b"{}")
    (old / "a-01/zarr.json").write_bytes(b"{}")
    store = Store(cache)
    store.survey("s")
    assert capsys.readouterr().err.startswith("rille: warning RIL-985: artifacts of an earlier format")
    assert store.lookup("toy", KEY) is None
    store.writable()
    ref = commit(cache)
    Store(cache).survey("s")
    assert capsys.readouterr().err == ""
    cleared = maintenance.gc(store, {KEY}, grace=-1.0)
    assert (cleared.artifacts, cleared.orphans) == (0, 2)
    assert files(cache) == [cache / ref.path]


def test_an_attempt_that_fails_leaves_nothing(cache, monkeypatch):
    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with raises("RIL-574"):
        commit(cache)
    assert files(cache) == []


def test_a_cache_that_may_not_be_written_is_one_line_and_still_read(cache, monkeypatch):
    ref = commit(cache)

    def refuse(*args, **kwargs):
        raise OSError(errno.EROFS, "Read-only file system")

    os.utime(cache / ref.path, (1.0, 1.0))  # so old that a look-up would touch it
    monkeypatch.setattr(Path, "mkdir", refuse)
    monkeypatch.setattr(os, "rename", refuse)
    monkeypatch.setattr(os, "utime", refuse)
    assert Store(cache).lookup("toy", KEY) == ref
    file_of(cache).write_bytes(b"")
    assert Store(cache).lookup("toy", KEY) is None, "damaged, though it cannot be set aside"
    assert [found.aside for found in maintenance.verify(Store(cache))[1]] == [False]
    with raises("RIL-575") as caught:
        commit(cache)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("url", ["s3://key:hunter2@bucket/x", "gs://bucket/x?secret=hunter2", Path("s3://hunter2/x")])
def test_a_cache_at_a_url_is_refused_in_a_line_that_does_not_repeat_it(tmp_path, monkeypatch, url):
    monkeypatch.chdir(tmp_path)
    with raises("RIL-546", "folder") as refused:
        Store(url)
    assert "hunter2" not in str(refused.value)
    with raises("RIL-546"):
        cache_folder(url)
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_place_of_the_cache_is_said(tmp_path):
    (tmp_path / "file").write_text("")
    for use in (lambda: Store(tmp_path / "file").lookup("toy", KEY), lambda: commit(tmp_path / "file")):
        with raises("RIL-576"):
            use()


def test_the_file_is_on_the_disk_before_it_can_be_seen(cache, monkeypatch):
    """The file, then the link, then the folders that have a new entry."""
    log = []
    synced, link = os.fsync, os.link
    monkeypatch.setattr(os, "fsync", lambda fd: (log.append(os.readlink(f"/proc/self/fd/{fd}")), synced(fd)))
    monkeypatch.setattr(os, "link", lambda a, b: (log.append("link"), link(a, b)))
    path = cache / commit(cache).path
    temporary, linked, *after = log
    assert Path(temporary).name.startswith(".tmp-")
    assert linked == "link"
    assert after == [str(path.parent), str(path.parents[1]), str(path.parents[2]), str(path.parents[3])]
    del log[:]
    Store(cache).commit(STAGE, "ab" + "c" * 62, bundle())
    assert log[2:] == [str(path.parent)], "nothing new above"


def test_gc_keeps_what_is_named_or_young(cache):
    ref = commit(cache)
    orphan = cache / "artifacts/toy" / KEY[:2] / ".tmp-00ff"
    orphan.write_bytes(b"123")
    nothing = {"artifacts": 0, "orphans": 0, "bytes": 0, "stages": {}}
    assert vars(maintenance.gc(Store(cache), set())) == nothing, "all is young"
    old = time.time() - 10
    for path in (orphan, cache / ref.path):
        os.utime(path, (old, old))
    cleared = maintenance.gc(Store(cache), {KEY}, grace=5, dry_run=True)
    assert (cleared.artifacts, cleared.orphans, cleared.bytes) == (0, 1, 3)
    assert orphan.exists()
    assert maintenance.gc(Store(cache), {KEY}, grace=5).orphans == 1
    assert Store(cache).lookup("toy", KEY) == ref
    gone = maintenance.gc(Store(cache), set(), grace=5)
    assert (gone.artifacts, gone.orphans) == (1, 0)
    assert gone.bytes > 1000
    assert list((cache / "artifacts").iterdir()) == []


def test_gc_takes_quarantine_and_old_indices_and_nothing_of_others(cache, monkeypatch):
    monkeypatch.setattr(folder, "RACY", 0.0)
    store, ref = Store(cache), commit(cache)
    store.survey("s")
    store.note([ref])
    patch(cache, "flag/c.0.0", lambda data: bytes(len(data)))
    maintenance.verify(store)
    (cache / "notes.txt").write_text("of somebody else")
    every = [path for path in cache.rglob("*") if path.is_file()]
    assert sorted(p.relative_to(cache).parts[0] for p in every) == ["index", "notes.txt", "quarantine", "quarantine"]
    assert maintenance.gc(store, {KEY}).bytes == 0, "all is young"
    for path in every:
        os.utime(path, (1.0, 1.0))
    maintenance.gc(store, {KEY})
    assert [path.name for path in cache.rglob("*") if path.is_file()] == ["notes.txt"]


def test_gc_takes_kernels_that_nothing_uses_but_not_in_a_dry_run(cache, tmp_path, monkeypatch):
    kernel, older = tmp_path / "a.nbc", tmp_path / "older"
    older.mkdir()
    for path in (kernel, older / "b.nbc"):
        path.write_bytes(b"1234")
    monkeypatch.setattr(maintenance.numba_cache, "unused", lambda: [kernel, older])
    for dry_run in (True, False):
        assert maintenance.gc(Store(cache), set(), dry_run=dry_run).bytes == 8
        assert kernel.exists() == older.exists() == dry_run


def test_gc_keeps_what_a_run_used_lately(cache, monkeypatch):
    monkeypatch.setattr(folder, "RACY", 0.0)
    store = Store(cache)
    ref = commit(cache)
    old = time.time() - 10
    os.utime(cache / ref.path, (old, old))
    store.survey("s")
    store.note([ref])
    assert maintenance.gc(store, set(), grace=5).artifacts == 0
    for path in (cache / "index").rglob("*"):
        os.utime(path, (old, old))
    assert maintenance.gc(store, set(), grace=5).artifacts == 1


def test_a_run_over_an_old_cache_notes_what_it_touched(cache, monkeypatch):
    monkeypatch.setattr(folder, "RACY", 0.0)
    ref = commit(cache)
    old = time.time() - 1e6
    os.utime(cache / ref.path, (old, old))
    first, second = Store(cache), Store(cache)
    first.survey("s")
    first.note([ref])
    second.survey("s")
    found = second.lookup("toy", KEY)
    assert os.stat(cache / ref.path).st_mtime > old
    second.note([found])
    third = Store(cache)
    third.survey("s")
    monkeypatch.setattr(third, "_read_manifest", lambda *_: pytest.fail("the index knows the mark that touching gave"))
    assert third.lookup("toy", KEY) == ref


@pytest.mark.parametrize("use", [True, False])
def test_gc_gives_back_what_a_run_finds_after_it_has_looked(cache, monkeypatch, use):
    """A plan only asks, and protects nothing."""
    ref = commit(cache)
    old = time.time() - 1e6
    os.utime(cache / ref.path, (old, old))
    real = folder.Folder.clear

    def meanwhile(self, items):
        assert Store(cache).lookup("toy", KEY, use=use) == ref
        real(self, items)

    monkeypatch.setattr(folder.Folder, "clear", meanwhile)
    maintenance.gc(Store(cache), set(), grace=3600)
    assert (Store(cache).lookup("toy", KEY) == ref) is use
    assert not list(cache.rglob(".tmp-*"))


def test_a_run_does_not_find_what_gc_is_removing(cache, monkeypatch):
    ref = commit(cache)
    old = time.time() - 1e6
    os.utime(cache / ref.path, (old, old))
    real, found = os.utime, []

    def late(path, *args):
        maintenance.gc(Store(cache), set(), grace=3600)
        found.append(path)
        real(path, *args)

    monkeypatch.setattr(os, "utime", late)
    assert Store(cache).lookup("toy", KEY) is None
    assert len(found) == 1


def chunks(cache):
    return [name for name in zipfile.ZipFile(file_of(cache)).namelist() if "/c." in name]


@pytest.mark.parametrize(
    ("shape", "count"),
    [
        ((1024, 1024), 1),
        ((2000, 500), 1),
        ((1034, 1025), 4),
        ((1034, 1024), 2),
        ((400_000, 3), 2),
        ((3_000, 500), 2),
        ((0, 3), 0),
    ],
)
def test_large_arrays_are_chunked(cache, shape, count):
    assert zarr_group.CHUNK == 1024
    big = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    ref = Store(cache).commit(STAGE, KEY, Bundle({"elevation": big}, {}))
    assert len(chunks(cache)) == count
    assert chunks(cache) == sorted(chunks(cache)), "in one order, that equal arrays make equal archives"
    np.testing.assert_array_equal(Store(cache).open(ref)["elevation"], big)


@pytest.mark.parametrize("shape", [(5,), (1500, 1200), (0, 3)])
@pytest.mark.parametrize("dtype", ["float32", "float64", "int16", "bool"])
def test_an_array_is_stored_as_zarr_stores_it(shape, dtype):
    values = (np.random.default_rng(0).normal(size=shape) * 9).astype(dtype)
    stage = replace(STAGE, outputs=(Array("values", tuple("ab"[: len(shape)]), dtype, "1", "values"),))
    files, _ = zarr_group.encode(stage, Bundle({"values": values}, {}))
    stored = {}
    zarr.create_array(
        zarr.storage.MemoryStore(stored),
        name="values",
        shape=shape,
        dtype=dtype,
        chunks=tuple(max(min(n, zarr_group.CHUNK), 1) for n in shape),
        compressors=zarr.codecs.BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"),
        fill_value=np.nan if values.dtype.kind == "f" else 0,
        dimension_names=tuple("ab"[: len(shape)]),
        chunk_key_encoding={"name": "default", "separator": "."},
        attributes={"units": "1", "long_name": "values"},
        config={"write_empty_chunks": True},
    )[...] = values
    expected = {name: content.to_bytes() for name, content in stored.items() if name.startswith("values/")}
    assert files.keys() - {"zarr.json"} == expected.keys()
    described = [json.loads(found.pop("values/zarr.json")) for found in (files, expected)]
    for found in described:
        found["codecs"][0].pop("configuration", None)  # one byte has no order
    assert described[0] == described[1]
    assert {name: files[name] for name in expected} == expected


@pytest.mark.parametrize("shape", [(7, 5), (3,), (zarr_group.CHUNK, 2), (2, 3, 4)])
@pytest.mark.parametrize("dtype", ["float32", "float64", "int16", "uint8", "bool"])
def test_an_array_of_one_chunk_is_what_zarr_reads(cache, monkeypatch, shape, dtype):
    values = (np.random.default_rng(0).normal(size=shape) * 9).astype(dtype)
    stage = replace(STAGE, outputs=(Array("values", tuple("abc"[: len(shape)]), dtype, "1", "values"),))
    ref = Store(cache).commit(stage, KEY, Bundle({"values": values}, {}))
    by_zarr = zarr.open_group(zarr.storage.ZipStore(file_of(cache), mode="r"), mode="r")["values"][...]
    monkeypatch.setattr(zarr, "open_array", None)
    found = Store(cache).open(ref)
    np.testing.assert_array_equal(found["values"], by_zarr)
    assert found["values"].dtype == values.dtype
    assert found["values"].flags.writeable
    window = (slice(1, 3), *[slice(0, 2)] * (len(shape) - 1))
    np.testing.assert_array_equal(found.part("values", window), values[window])
    assert found.part("values", window).base is None, "a window keeps no more than itself"


def test_of_a_window_only_the_chunks_are_read_that_it_touches(cache, monkeypatch):
    elevation = np.random.default_rng(0).random((2500, 1100), np.float32)
    ref = Store(cache).commit(STAGE, KEY, Bundle({"elevation": elevation, "flag": np.zeros((2, 2), bool)}, {}))
    members, opened, ranges = Store(cache).manifest("toy", KEY)["files"], Store(cache).open(ref).arrays, []
    read = folder.Folder.read

    def noted(self, path, start=0, stop=None):
        ranges.append((start, stop))
        return read(self, path, start, stop)

    monkeypatch.setattr(folder.Folder, "read", noted)
    part = opened.part("elevation", (slice(1000, 1040), slice(5, 9)))
    np.testing.assert_array_equal(part, elevation[1000:1040, 5:9])
    touched = [members[f"elevation/{name}"] for name in ("c.0.0", "c.1.0", "zarr.json")]
    assert sorted(ranges) == sorted((start, start + size) for start, size, _ in touched)
    np.testing.assert_array_equal(opened.raster("elevation")[2499:, 1024:], elevation[2499:, 1024:])
    file_of(cache).unlink()
    with raises("RIL-504", "missing"):
        opened.part("elevation", (slice(2400, 2500), slice(1030, 1040)))


def test_an_array_with_other_codecs_is_read_by_zarr(cache, monkeypatch):
    """As one would be that another version has written."""
    ref = commit(cache)
    monkeypatch.setattr(json, "loads", lambda text, real=json.loads: _with_codecs(real(text), ["bytes", "zstd"]))
    assert Store(cache).open(ref).arrays._one_chunk("elevation") is None


def _with_codecs(found, names):
    return {**found, "codecs": [{"name": name} for name in names]} if "codecs" in found else found


def test_chunks_of_nothing_are_members_too(cache):
    nothing = {"elevation": np.full((2, 2), np.nan, np.float32), "flag": np.zeros((2, 2), bool)}
    Store(cache).commit(STAGE, KEY, Bundle(nothing, {}))
    assert len(chunks(cache)) == 2


@pytest.mark.parametrize("name", ["locus", "mockup.scene"])
def test_the_name_of_a_stage_may_have_a_point(cache, name):
    """Those of the simulator have one."""
    Store(cache).commit(replace(STAGE, name=name), KEY, bundle(), label="here")
    assert Store(cache).lookup(name, KEY) is not None
    assert list(maintenance.artifacts(Store(cache))) == [(name, KEY)]
