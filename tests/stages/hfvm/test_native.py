"""The native solver and its reference give the same integers; the binary is that of the sources, and only that."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rille.pipeline.engine.keys import module_digests
from rille.stages.hfvm.native import build, reference
from rille.stages.hfvm.native.library import Library
from rille.stages.hfvm.native.problem import Field, LevelPair, Map, Smoothing, pack_map
from rille.stages.hfvm.native.reference import FAR

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no compiler")

SIZES = [((1, 1), (1, 1)), ((2, 3), (4, 2)), ((9, 17), (9, 17)), ((31, 46), (28, 60)), ((64, 90), (70, 81))]
"""Rows and columns of the left and of the right image."""


@pytest.fixture(scope="module", params=["", "_v3", "_v4"], ids=["any", "v3", "v4"])
def native(request):
    """The native solver with each instruction set that this processor has."""
    path = build.binary() if build.binary().is_file() else build.compiled()
    library = Library(str(path), request.param)
    if library.variant != request.param:
        pytest.skip("this processor has no such instructions")
    return library


def words(shape, rng, levels=256):
    # Few levels, so that ties occur and their order is tested.
    return rng.integers(0, levels, (*shape, 8)).astype(np.uint8).view(np.uint64)[..., 0]


def some_pair(sizes, rng, mu, levels=6):
    left, right = (words(size, rng, levels) for size in sizes)
    f = np.array([[1e-4, 0.02, 0.1], [0.01, 1e-3, 1.0], [0.03, -1.0, 0.4]]) + rng.normal(0, 1e-3, (3, 3))
    return LevelPair(left, right, f if mu else np.zeros((3, 3)), mu)


def some_maps(shape, rng, reach=4):
    u, v = rng.integers(-reach, reach + 1, shape), rng.integers(-1, 2, shape)
    # Equal ones side by side, as in images.
    u[: shape[0] // 2] = u[: shape[0] // 2, :1]
    return Map(u.astype(np.int16), v.astype(np.int16))


def fields(pair, rng):
    shift, cost = pack_map(*some_maps(pair.left.shape, rng)), rng.integers(0, 900, pair.left.shape).astype(np.int32)
    return Field(shift, cost), Field(shift.copy(), cost.copy())


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("mu", [0.0, 2.0, 6.0])
@pytest.mark.parametrize("reach", [(2, 1), (1, 0), (5, 2)])
def test_search(native, sizes, mu, reach):
    rng = np.random.default_rng(1)
    pair = some_pair(sizes, rng, mu)
    up = some_maps(tuple((n + 1) // 2 for n in sizes[0]), rng, 3)
    found = []
    for solver in (native, reference):
        out = Field(*(np.zeros(sizes[0], np.int32) for _ in range(2)))
        solver.search(pair, up, reach, out)
        found.append(out)
    for a, b in zip(*found, strict=True):
        np.testing.assert_array_equal(a, b)
    assert sizes[0][0] < 9 or (found[0].cost < FAR).mean() > 0.5


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("mu", [0.0, 6.0])
@pytest.mark.parametrize(("rounds", "beside"), [(1, 0), (2, 1), (4, 2)])
def test_propagation(native, sizes, mu, rounds, beside):
    rng = np.random.default_rng(2)
    pair = some_pair(sizes, rng, mu)
    one, other = fields(pair, rng)
    before = one.shift.copy()
    native.propagate(pair, one, Smoothing(4, rounds, beside))
    reference.propagate(pair, other, Smoothing(4, rounds, beside))
    np.testing.assert_array_equal(one.shift, other.shift)
    np.testing.assert_array_equal(one.cost, other.cost)
    assert sizes[0][0] < 9 or (one.shift != before).any()


@pytest.mark.parametrize("sizes", SIZES)
def test_sums(native, sizes):
    rng = np.random.default_rng(3)
    pair = some_pair(sizes, rng, 0.0, 256)
    u, v = some_maps(sizes[0], rng, 2)
    wanted = (rng.random(sizes[0]) < 0.9).astype(np.uint8)
    for a, b in zip(native.sums(pair, u, v, wanted), reference.sums(pair, u, v, wanted), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize("near_sign", [-1, 0, 1])
def test_edges(native, sizes, near_sign):
    rng = np.random.default_rng(4)
    pair = some_pair(sizes, rng, 0.0, 40)
    shift = pack_map(*some_maps(sizes[0], rng, 6))
    grey = rng.integers(60, 90, sizes[0]).astype(np.int16)
    wanted = (rng.random(sizes[0]) < 0.9).astype(np.uint8)
    found = [solver.edges(pair, grey, shift, wanted, near_sign) for solver in (native, reference)]
    np.testing.assert_array_equal(*found)
    assert sizes[0][0] < 30 or (found[0] != shift).any()


@pytest.mark.parametrize("handed", [0, 1])
@pytest.mark.parametrize("sizes", SIZES)
def test_paths(native, sizes, handed):
    rng = np.random.default_rng(5)
    pair = some_pair(sizes, rng, 8.0)
    grey = rng.uniform(0, 255, sizes[0]).astype(np.float32)
    compact = LevelPair(words(sizes[0], rng), words(sizes[1], rng))
    before, half = pack_map(*some_maps(sizes[0], rng)), [(n + 1) // 2 * handed for n in sizes[0]]
    up = pack_map(*(2 * one for one in some_maps(half, rng)))
    found = before.copy(), before.copy()
    for solver, shift in zip((native, reference), found, strict=True):
        solver.paths(pair, compact, up, grey, shift)
    np.testing.assert_array_equal(*found)
    assert sizes[0][0] < 9 or (found[0] != before).any()


def test_arrays_of_other_kinds_are_refused(native):
    pair = some_pair(SIZES[2], np.random.default_rng(6), 0.0)
    u = np.zeros(SIZES[2][0], np.int16)
    with pytest.raises(TypeError):
        native.sums(pair, u.astype(np.int32), u, np.ones(u.shape, np.uint8))
    with pytest.raises(TypeError):
        native.sums(pair, u[:, ::2], u, np.ones(u.shape, np.uint8))


# -- the binary --------------------------------------------------------------------------------------------------------


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """The sources in a folder of their own."""
    for name in build.SOURCES:
        shutil.copy(build.FOLDER / name, tmp_path)
    monkeypatch.setattr(build, "FOLDER", tmp_path)
    monkeypatch.setattr(build, "VARIANTS", {"": ("-DANY_PROCESSOR", "-O0")})
    return tmp_path


def test_a_binary_of_other_sources_is_not_taken_but_replaced(copy):
    first = build.compiled()
    assert first == build.binary()
    assert Library(str(first)).variant == ""
    source = copy / "level.c"
    source.write_text(source.read_text() + "\n/* later */\n")
    assert not build.binary().is_file()
    second = build.compiled()
    assert sorted(copy.glob("*.bin")) == [second]
    assert second != first


def test_without_a_compiler_there_is_no_binary(copy, monkeypatch):
    monkeypatch.setenv("PATH", str(copy / "nothing"))
    assert build.compiled() is None


def test_sources_that_do_not_compile_leave_nothing_behind(copy):
    (copy / "level.c").write_text("int x = ;")
    assert build.compiled() is None
    assert not list(copy.glob("_level*"))


def test_without_a_compiler_the_reference_runs_and_one_warning_says_so(tmp_path):
    code = """
import warnings
from rille.stages.hfvm.native import build
build.binary, build.compiled = lambda: build.FOLDER / "none.bin", lambda: None
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    from rille.stages.hfvm.native import reference, solver
assert solver.solver is reference
print(*(w.message for w in told), sep="\\n")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert done.stdout.count("RIL-") == 1
    assert "cc" in done.stdout


def test_the_binary_comes_from_the_packages_folder_alone(tmp_path):
    (tmp_path / build.binary().name).write_text("not a library")
    code = "from rille.stages.hfvm.native import build; print(build.binary().parent)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert Path(done.stdout.strip()).resolve() == build.FOLDER


def test_tasks_depend_on_the_c_source():
    reached = module_digests("rille.stages.hfvm.stage")
    assert {f"rille.stages.hfvm.native/{name}" for name in build.SOURCES} <= set(reached)
    assert not any("/" in name for name in module_digests("rille.stages.terrain.merge"))
