"""Artifacts on disk: what is written, how it is read, and what hostile or refused files do.

What damage, removal, clearing up and other processes do in any order is in ``test_store_machine.py``.
"""

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

import numpy as np
import pytest
import xarray
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy
from raising import raises

from rille.pipeline.engine.store import arrays, artifact, maintenance
from rille.pipeline.engine.store.arrays import array_digests, output_digest
from rille.pipeline.engine.store.base import Store
from rille.pipeline.runs.options import cache_folder
from rille.stages.core.declare import Array, Bundle, NoParams, Stage

STAGE = Stage(
    name="toy",
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


def rewrite(path, changes, **options):
    """Write an artifact anew with other members, as somebody would who can compute checksums."""
    with zipfile.ZipFile(path) as old:
        members = {name: old.read(name) for name in old.namelist()}
    with zipfile.ZipFile(path, "w", **options) as new:
        for name, content in (members | changes).items():
            new.writestr(name, content)


def forge(path, change):
    """Change the manifest, its checksum right."""
    with zipfile.ZipFile(path) as old:
        made = json.loads(old.read(artifact.MANIFEST))
    change(made)
    rewrite(path, {artifact.MANIFEST: json.dumps(made)})


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
    for way in (f"zip::{cache / ref.path}", zarr.storage.ZipStore(cache / ref.path, mode="r")):
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
        assert {m.date_time for m in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}, "equal results make equal files"
        assert json.loads(archive.read("manifest.json"))["digest"] == ref.digest


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
    with pytest.raises(KeyError, match="height"):
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


BAD = {"dtype": "<f4", "shape": [1], "chunks": [1], "sha256": ""}


@pytest.mark.parametrize(
    "change",
    [
        {"stage": "scale"},
        {"key": "j" * 64},
        {"arrays": None},
        {"arrays": {"flag": BAD | {"shape": [10**6, 10**6], "chunks": [1, 1]}}},
        {"arrays": {"flag": BAD | {"shape": ["9" * 5000]}}},
        {"arrays": {"flag": BAD | {"chunks": [10**9]}}},
        {"arrays": {"flag": BAD | {"chunks": [0]}}},
        {"arrays": {"flag": BAD | {"chunks": [1, 1]}}},
        {"arrays": {"flag": BAD | {"dtype": "|O8"}}},
        {"arrays": {"flag": BAD | {"dtype": "<f99"}}},
        {"arrays": {"../../x": BAD}},
        {"meta": None},
        {"label": ["a"]},
    ],
)
def test_a_manifest_that_is_wrong_by_intent_counts_as_damaged(cache, change):
    commit(cache)
    forge(file_of(cache), lambda made: made.update(change))
    assert Store(cache).lookup("toy", KEY) is None
    assert files(cache) == [], "it was set aside"


@pytest.mark.parametrize("text", [b"[" * 100_000, b'{"path": ' * 50_000, b"[]", b"1" * 5000, b"", b"\xff"])
def test_a_manifest_that_is_no_object_is_damaged(cache, text):
    commit(cache)
    rewrite(file_of(cache), {artifact.MANIFEST: text})
    assert Store(cache).lookup("toy", KEY) is None


def fifo(path):
    path.unlink()
    os.mkfifo(path)


def directory_of_gigabytes(path):
    """A directory that is the whole of a sparse file of 3 GB, in the first record of which all is well."""
    data = path.read_bytes()
    end = zipfile.ZipFile(path).start_dir
    size = 3_000_000_000
    with path.open("r+b") as file:
        file.seek(end + size)
        file.write(data[-22:-10] + size.to_bytes(4, "little") + data[-6:])


@pytest.mark.parametrize("way", [fifo, directory_of_gigabytes, lambda path: (path.unlink(), path.mkdir())])
def test_what_no_archive_is_neither_blocks_nor_fills_the_memory(cache, way):
    ref = commit(cache)
    way(file_of(cache))
    began = time.process_time()
    assert Store(cache).lookup("toy", KEY) is None
    assert time.process_time() - began < 1.0
    assert commit(cache) == ref


@pytest.mark.parametrize("name", ["elevation/c.0.0", artifact.MANIFEST])
def test_a_member_that_might_unpack_to_any_size_is_refused(cache, name):
    ref = commit(cache)
    content = zipfile.ZipFile(file_of(cache)).read(name)
    rewrite(file_of(cache), {name: content + b" " * 100_000_000}, compression=zipfile.ZIP_DEFLATED)
    assert file_of(cache).stat().st_size < 200_000
    assert Store(cache).lookup("toy", KEY) is None
    assert commit(cache) == ref
    rewrite(file_of(cache), {name: content * 1000})
    with raises("RIL-504") if name == "elevation/c.0.0" else raises("RIL-572"):
        Store(cache).open(ref)["elevation"]


def test_a_chunk_never_unpacks_to_another_size(cache):
    ref = commit(cache)
    rewrite(file_of(cache), {"elevation/c.0.0": arrays.codec().encode(np.zeros((5, 8), np.float32))})
    with raises("RIL-504", "another size"):
        Store(cache).open(ref)["elevation"]
    commit(cache)
    rewrite(file_of(cache), {"elevation/c.0.0": bytes([2, 1, 1, 4, 140, 0, 0, 0]) + b"\xff" * 20})
    with raises("RIL-504"):
        Store(cache).open(ref)["elevation"]


def test_verify_finds_content_that_was_not_computed(cache):
    store, other, moved = Store(cache), "ab" + "c" * 62, "ab" + "d" * 62
    sound, forged = (store.commit(STAGE, key, bundle()) for key in (KEY, other))
    (cache / sound.path.replace(KEY, moved)).write_bytes((cache / sound.path).read_bytes())
    forge(cache / forged.path, lambda made: made["meta"].update(none=1))
    assert store.lookup("toy", other) is not None
    count, damages = maintenance.verify(store)
    assert (count, len(damages)) == (1, 2)
    assert files(cache) == [cache / sound.path]


@pytest.mark.parametrize("entry", [{"code": [1]}, {"inputs": 7}, {"env": {"numpy": 1}}])
def test_an_artifact_that_does_not_say_where_it_comes_from_is_set_aside(cache, entry):
    """Words on why a task is computed are made of it: they would end the run."""
    commit(cache)
    forge(file_of(cache), lambda made: made["provenance"].update(entry))
    assert Store(cache).lookup("toy", KEY) is None
    assert files(cache) == []


def test_an_attempt_that_fails_leaves_nothing(cache, monkeypatch):
    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with raises("RIL-575", "No space left"):
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
    assert "it stays" in maintenance.verify(Store(cache))[1][0]
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
        with raises("RIL-575", "Not a directory"):
            use()


def test_the_file_is_on_the_disk_before_it_can_be_seen(cache, monkeypatch):
    log = []
    synced, link = os.fsync, os.link
    monkeypatch.setattr(os, "fsync", lambda fd: (log.append(os.readlink(f"/proc/self/fd/{fd}")), synced(fd)))
    monkeypatch.setattr(os, "link", lambda a, b: (log.append("link"), link(a, b)))
    commit(cache)
    temporary, linked = log
    assert Path(temporary).name.startswith(".tmp-")
    assert linked == "link"


@pytest.mark.parametrize("use", [True, False])
def test_clearing_up_spares_what_a_run_has_found_and_a_plan_protects_nothing(cache, use):
    ref = commit(cache)
    os.utime(cache / ref.path, (1.0, 1.0))
    assert Store(cache).lookup("toy", KEY, use=use) == ref
    maintenance.gc(Store(cache), set())
    assert (Store(cache).lookup("toy", KEY) == ref) is use


def test_a_run_does_not_find_what_clearing_up_is_removing(cache, monkeypatch):
    ref = commit(cache)
    os.utime(cache / ref.path, (1.0, 1.0))
    touch = os.utime

    def late(path, *args):
        maintenance.gc(Store(cache), set())
        touch(path, *args)

    monkeypatch.setattr(os, "utime", late)
    assert Store(cache).lookup("toy", KEY) is None


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
    assert arrays.CHUNK == 1024
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
    files, _ = arrays.encode(stage, Bundle({"values": values}, {}))
    stored = {}
    zarr.create_array(
        zarr.storage.MemoryStore(stored),
        name="values",
        shape=shape,
        dtype=dtype,
        chunks=tuple(max(min(n, arrays.CHUNK), 1) for n in shape),
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


def test_of_a_window_only_the_chunks_are_read_that_it_touches(cache, monkeypatch):
    elevation = np.random.default_rng(0).random((2500, 1100), np.float32)
    ref = Store(cache).commit(STAGE, KEY, Bundle({"elevation": elevation, "flag": np.zeros((2, 2), bool)}, {}))
    opened, names = Store(cache).open(ref).arrays, []
    member = artifact.Archive.member
    monkeypatch.setattr(artifact.Archive, "member", lambda self, *args: names.append(args[0]) or member(self, *args))
    part = opened.raster("elevation")[1000:1040, 5:9]
    np.testing.assert_array_equal(part, elevation[1000:1040, 5:9])
    assert names == ["elevation/c.0.0", "elevation/c.1.0"]
    file_of(cache).unlink()
    with raises("RIL-504", "missing"):
        opened.raster("elevation")[2400:2500, 1030:1040]


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_a_window_is_that_of_the_array(tmp_path_factory, data):
    cache = tmp_path_factory.mktemp("windows")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        patch.setattr(arrays, "CHUNK", 4)
        shape = data.draw(st_numpy.array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=11))
        values = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
        read = Store(cache).open(Store(cache).commit(STAGE, KEY, Bundle({"elevation": values}, {}))).arrays
    for _ in range(4):
        window = tuple(slice(*sorted(data.draw(st.tuples(*[st.integers(0, n)] * 2)))) for n in shape)
        raster = read.raster("elevation")
        assert raster.shape == shape
        np.testing.assert_array_equal(raster[window], values[window])
    np.testing.assert_array_equal(read["elevation"], values)


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
