"""Digest of the code behind a module: what can change a result changes it, what cannot does not."""

from __future__ import annotations

import ast
import re
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from rille.pipeline.engine import keys

FILES = {
    "__init__.py": '"""Package."""\n',
    "main.py": '"""Main."""\nimport numpy\nfrom own_toy.near import half\n'
    'def run(x):\n    """Run."""\n    return half(x)\n',
    "near.py": "def half(x):\n    from .deep import inner\n    return inner.third(x) / 2\n",
    "deep/__init__.py": "",
    "deep/inner.py": "from ..sibling import LIMIT\ndef third(x):\n    return min(x / 3, LIMIT)\n",
    "sibling.py": 'LIMIT = 5\n"""Greatest value."""\n',
    "typed.py": "X = 1\n",
    "stranger.py": "Y = 1\n",
}

CACHED = (
    keys._read,
    keys._file,
    keys._roots,
    keys.module_digests,
    keys.code_digest,
)


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Gives ``change(file, old, new)``, which edits and returns the digest as a new process would see it."""
    root = tmp_path / "own_toy"
    for name, text in FILES.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)

    def change(name="main.py", old="", new=""):
        text = (root / name).read_text()
        assert old in text
        (root / name).write_text(text.replace(old, new) if old else text + new)
        for cached in CACHED:
            cached.cache_clear()
        return keys.code_digest("own_toy.main")

    yield change
    for cached in CACHED:
        cached.cache_clear()
    assert not any(name.startswith("own_toy.") for name in sys.modules), "digesting must not import"


def test_reaches_helpers_at_any_depth_and_no_strangers(package):
    package()
    assert set(keys.module_digests("own_toy.main")) == {
        "own_toy", "own_toy.main", "own_toy.near", "own_toy.deep", "own_toy.deep.inner", "own_toy.sibling",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("main.py", "", "\n# a comment\n"),
        ("main.py", '"""Run."""', '"""Runs it, with other words."""'),
        ("main.py", '    """Run."""\n', ""),
        ("main.py", "return half(x)", "return (  half( x ) )"),
        ("__init__.py", '"""Package."""', '"""Other."""'),
        ("sibling.py", "5", "5  # metres"),
        ("sibling.py", "Greatest", "Largest"),
        ("stranger.py", "1", "2"),
        ("main.py", "", "\nfrom typing import TYPE_CHECKING\n"),
    ],
)
def test_what_cannot_change_a_result(package, name, old, new):
    before = package()
    after = package(name, old, new)
    assert (after == before) == ("TYPE_CHECKING" not in new), "an import that runs counts, all else does not"


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("main.py", "half(x)", "half(x + 0)"),
        ("near.py", "/ 2", "/ 2.0"),
        ("deep/inner.py", "x / 3", "x / 4"),
        ("sibling.py", "5", "6"),
        ("deep/__init__.py", "", "SWITCH = 1\n"),
        ("main.py", "", "\nimport own_toy.stranger\n"),
    ],
)
def test_what_can_change_a_result(package, name, old, new):
    before = package()
    assert package(name, old, new) != before
    if old:
        assert package(name, new, old) == before


def test_imports_for_type_checkers_do_not_count(package):
    before = package("main.py", "import numpy\n", "from typing import TYPE_CHECKING\nimport numpy\n")
    assert package("main.py", "import numpy\n", "import numpy\nif TYPE_CHECKING:\n    import own_toy.typed\n") == before


def test_a_running_process_keeps_what_it_read(package, tmp_path):
    before = package()
    (tmp_path / "own_toy" / "sibling.py").write_text("LIMIT = 7\n")
    assert keys.code_digest("own_toy.main") == before


def test_every_stage_reaches_the_declarations():
    assert {
        "rille.stages",
        "rille.stages.core.declare",
        "rille.stages.odometry.keyframes",
        "rille.stages.core.errors",
    } <= set(keys.module_digests("rille.stages.odometry.keyframes"))
    assert not any(name.startswith("rille.pipeline") for name in keys.module_digests("rille.stages.odometry.keyframes"))


def modules():
    """Own modules by name, without those of the pipeline."""
    root = Path(__file__).parents[3]
    return {
        f"rille.{'.'.join(path.relative_to(root).with_suffix('').parts)}": path.read_text(encoding="utf-8")
        for room in ("stages", "datasets")
        for path in (root / room).rglob("*.py")
        if path.name != "__init__.py"
    }


def test_an_edit_of_the_planner_compiles_no_kernel_of_another_room():
    kernels = [name for name, text in modules().items() if re.search(r"@kernel|@njit", text)]
    others = [name for name in kernels if not name.startswith(("rille.stages.planning", "rille.stages.driving"))]
    assert len(others) > 20
    for name in others:
        assert not any(".planning" in reached for reached in keys.module_digests(name)), name


def test_what_walks_the_whole_sequence_hangs_on_no_matcher():
    for name in ("steps", "keyframes", "frame_screening"):
        reached = keys.module_digests(f"rille.stages.odometry.{name}")
        assert not any(".hfvm" in module for module in reached), name


def test_no_stage_loads_code_or_tables_that_its_digest_does_not_see():
    """Modules by computed names, files beside the code: the digest knows of neither."""
    hidden = re.compile(r"\b(import_module|__import__|importlib\.resources|exec|eval)\(|__file__")
    reached = {
        module
        for name, text in modules().items()
        if re.search(r"^(STAGE = |@stage\()", text, re.MULTILINE)
        for module in keys.module_digests(name)
    }
    found = {name for name, text in modules().items() if name in reached and hidden.search(text)}
    # the one asks for the declaration of the images that it changes, whose values are its input; the other reads C
    # sources, whose bytes count
    assert found <= {"rille.datasets.images.misalign", "rille.stages.hfvm.native.build"}
    assert len(reached) > 150


def test_an_unknown_module_is_named():
    with pytest.raises(ModuleNotFoundError, match=r"stages\.nowhere"):
        keys.code_digest("rille.stages.nowhere")


@pytest.fixture
def memory(tmp_path, monkeypatch):
    """``memory()``: what a new process finds in the file of the memory, from then on in use."""

    def reread():
        found = keys._Memory(tmp_path / "cache" / "sources.json")
        monkeypatch.setattr(keys, "_memory", lambda: found)
        return found

    reread()
    return reread


def test_what_was_found_in_sources_is_remembered_by_their_bytes(package, memory, monkeypatch):
    first, edited = package(), package("sibling.py", "5", "6")
    keys.remember()
    monkeypatch.setattr(keys.ast, "parse", lambda _: pytest.fail("a file was parsed again"))
    memory()
    assert package() == edited
    assert package("sibling.py", "6", "5") == first


def test_one_source_is_parsed_at_a_time(package, memory, monkeypatch, tmp_path):
    """Python 3.11 fails where two threads make syntax trees at once."""
    parse, under_way, most = ast.parse, [], []

    def slow(*given):
        under_way.append(given)
        most.append(len(under_way))
        time.sleep(0.01)
        under_way.pop()
        return parse(*given)

    monkeypatch.setattr(keys.ast, "parse", slow)
    files = [tmp_path / "own_toy" / name for name in FILES]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda path: keys._read(f"own_toy.{path.stem}", path), files))
    assert len(most) > 4
    assert max(most) == 1


def test_a_damaged_memory_of_sources_is_none(package, memory, tmp_path):
    file = tmp_path / "cache" / "sources.json"
    first = package()
    keys.remember()
    whole = file.read_bytes()
    for damaged in (b"", whole[:-20], b"[]", b"{}", whole.replace(b"own_toy.near.half", b"own_toy.near.hall")):
        file.write_bytes(damaged)
        assert memory().known == {}
        assert package() == first
    file.write_bytes(whole)
    assert memory().known


def test_poses_of_a_segment_do_not_depend_on_what_judges_all_segments():
    room = "rille.stages.odometry.resection"
    assert f"{room}.intrinsics" not in keys.module_digests(f"{room}.resect")
