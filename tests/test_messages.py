"""Messages: each error has a code of its own, literal in the source, and the documents quote it with that code."""

from __future__ import annotations

import ast
import pickle
import re
from collections import defaultdict
from pathlib import Path

import pytest

from pipeline.cli import main
from pipeline.store import GoneError

ROOT = Path(__file__).resolve().parent.parent
SOURCES = sorted(path for name in ("pipeline", "stages", "datasets") for path in (ROOT / name).rglob("*.py"))
CODE = re.compile(r"RIL-\d{3}")


def error_classes(trees: list[ast.Module]) -> set[str]:
    """Names of RilleError and of every class below it."""
    found = {"RilleError"}
    classes = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    while True:
        more = {c.name for c in classes if any(ast.unparse(base) in found for base in c.bases)} - found
        if not more:
            return found
        found |= more


def coded(call: ast.Call) -> bool:
    """Whether the first argument is a literal code, or one that a caller or another error gives."""
    first = ast.unparse(call.args[0]) if call.args else ""
    literal = isinstance(call.args[0], ast.Constant) and CODE.fullmatch(str(call.args[0].value)) if call.args else None
    return bool(literal) or first == "code" or first.endswith(".code")


def without_code(tree: ast.Module, classes: set[str]) -> list[int]:
    """Lines where an error is made whose first argument is no code."""
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and ast.unparse(node.func) in classes]
    return [call.lineno for call in calls if not coded(call)]


def codes(tree: ast.Module) -> list[str]:
    """Every literal that is a code."""
    return [n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and CODE.fullmatch(str(n.value))]


TREES = {path: ast.parse(path.read_text(encoding="utf-8")) for path in SOURCES}
CLASSES = error_classes(list(TREES.values()))


def test_every_error_has_a_literal_code() -> None:
    assert {"InputError", "GoneError", "MemoryRefusedError"} <= CLASSES
    bad = [f"{p.relative_to(ROOT)}:{line}" for p, tree in TREES.items() for line in without_code(tree, CLASSES)]
    assert not bad, f"give a code that is free as first argument: {bad}"


def test_no_code_is_used_twice() -> None:
    places = defaultdict(list)
    for path, tree in TREES.items():
        for code in codes(tree):
            places[code].append(str(path.relative_to(ROOT)))
    assert len(places) > 250
    assert not {code: where for code, where in places.items() if len(where) > 1}


def test_the_checks_themselves_see_an_error_without_a_code() -> None:
    tree = ast.parse("class A(InputError): ...\ndef f(code):\n    raise A('RIL-12', 'x')\n    raise A(code, 'y')\n")
    classes = error_classes([*TREES.values(), tree])
    assert without_code(tree, classes) == [3]


def test_an_error_keeps_its_code_between_processes_and_with_a_place() -> None:
    error = GoneError("RIL-123", "it has gone", remedy="run again")
    for same in (pickle.loads(pickle.dumps(error)), error.at("merge/0")):
        assert (type(same), same.code, same.remedy) == (GoneError, "RIL-123", "run again")
    assert str(error.at("merge/0")) == "merge/0: it has gone: run again"


@pytest.mark.parametrize(
    ("argv", "code", "status"),
    [(["reconstruct", "nothing-of-this-name"], "RIL-", 2), (["reconstruct", "--no-such-option"], "RIL-001", 2)],
)
def test_the_command_line_prints_the_code(
    argv: list[str], code: str, status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(argv)
    assert ended.value.code == status
    line = capsys.readouterr().err
    assert line.startswith(f"rille: error {code}")
    assert line.count("\n") == 1


def test_an_error_of_the_program_itself_has_a_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("datasets.registry.catalogue", broken)
    with pytest.raises(SystemExit) as ended:
        main(["datasets"])
    assert ended.value.code == 1
    assert capsys.readouterr().err.startswith("rille: error RIL-999: ZeroDivisionError: division by zero (run again")


def test_the_documents_quote_codes_that_there_are() -> None:
    quoted = {
        code
        for page in (ROOT / "docs").glob("*.md")
        for code in re.findall(r"^rille: error (\S+):", page.read_text(), re.M)
    }
    assert len(quoted) > 20
    assert quoted <= {code for tree in TREES.values() for code in codes(tree)}
