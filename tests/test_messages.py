"""Messages: errors carry their code, the command line prints it, and a page lists them.

``make pages`` writes the page anew.
"""

from __future__ import annotations

import ast
import pickle
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from rille.pipeline.cli import main
from rille.pipeline.engine.store.base import GoneError

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "messages.md"
CODE = re.compile(r"RIL-\d{3}")
HEAD = """# Messages

Every error has a code that stays when its words change: `rille: error RIL-214: what, where: what to change`. Here an
ellipsis stands for what the program fills in. 001-099 command line and configuration, 100-299 input, 300-499 stages,
500-599 engine and store, 600-639 outputs, 640-709 findings of `rille check` and warnings, 710-998 what came later;
RIL-999 is an error of the program itself.

| code | message | what to change |
|---|---|---|
"""


def texts(scope: ast.Module | ast.FunctionDef) -> list[tuple[str, ast.Assign]]:
    """Assignments of a module or function to one name each, no parameter, in order of their lines."""
    nodes, given = (scope.body, []) if isinstance(scope, ast.Module) else (ast.walk(scope), scope.args.args)
    found = [node for node in nodes if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)]
    named = [(node.targets[0].id, node) for node in sorted(found, key=lambda node: node.lineno)]
    return [(name, node) for name, node in named if name not in [one.arg for one in given]]


def words(node: ast.expr | None, names: Mapping[str, ast.expr]) -> str:
    """Text of an expression; an ellipsis for what is filled in."""
    if isinstance(node, ast.Name) and isinstance(names.get(node.id), ast.Constant | ast.JoinedStr):
        return words(names[node.id], names)
    if isinstance(node, ast.FormattedValue) and isinstance(node.value, ast.Name):
        return words(node.value, names)
    if isinstance(node, ast.Constant):
        return str(node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(words(part, names) for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return words(node.left, names) + words(node.right, names)
    return "" if node is None else "…"


def messages(tree: ast.Module) -> Iterator[tuple[str, str, str]]:
    """Code, message and remedy of each call whose first argument is a code."""
    scopes = [tree, *(node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))]
    named: dict[ast.AST, list[tuple[str, ast.Assign]]] = {}  # each node's by its innermost function: the last one
    for scope in scopes:
        named |= dict.fromkeys(ast.walk(scope), texts(scope))
    for call in ast.walk(tree):
        if not isinstance(call, ast.Call) or len(call.args) < 2:
            continue
        names = {name: found.value for name, found in (*named[tree], *named[call]) if found.lineno < call.lineno}
        code, *told = call.args
        if not isinstance(code, ast.Constant) or not CODE.fullmatch(str(code.value)):
            continue
        remedy = next((k.value for k in call.keywords if k.arg == "remedy"), None)
        if isinstance(call.func, ast.Attribute) and call.func.attr == "error":  # code, key, what, remedy
            yield str(code.value), f"…: {words(told[0], names)} {words(told[1], names)}", words((*told, None)[2], names)
        else:
            yield str(code.value), words(told[0], names), words(remedy, names)


def page() -> str:
    """The page of all messages, in order of their codes."""
    found = []
    for path in sorted(p for name in ("pipeline", "stages", "datasets") for p in (ROOT / name).rglob("*.py")):
        found += list(messages(ast.parse(path.read_text(encoding="utf-8"))))
    rows = [" | ".join(" ".join(text.replace("|", "\\|").split()) for text in row) for row in sorted(found)]
    return HEAD + "".join(f"| {row} |\n" for row in rows)


def test_the_page_lists_every_message() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "make pages"


def test_an_error_keeps_its_code_between_processes_and_with_a_place() -> None:
    error = GoneError("RIL-123", "it has gone", remedy="run again")
    for same in (pickle.loads(pickle.dumps(error)), error.at("merge/0")):
        assert (type(same), same.code, same.remedy) == (GoneError, "RIL-123", "run again")
    assert str(error.at("merge/0")).startswith("merge/0: ")


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

    monkeypatch.setattr("rille.datasets.registry.catalogue", broken)
    with pytest.raises(SystemExit) as ended:
        main(["datasets"])
    assert ended.value.code == 1
    assert capsys.readouterr().err.startswith("rille: error RIL-999: ZeroDivisionError: division by zero (run again")


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
