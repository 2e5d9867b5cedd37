"""Each line that the documents quote from the program is made of the program's own words."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = [p for p in sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]) if "_build" not in p.parts]
QUOTED = [(page.name, line) for page in PAGES for line in page.read_text().splitlines() if line.startswith("rille: ")]

SHORTEST = 6
"""Characters of a piece of text in the sources that counts."""

VARIABLE = 4
"""Plain words in a row that may be filled in by the program (a name, an error of the system)."""


@cache
def _pieces() -> tuple[str, ...]:
    """Constant text in the sources, parts of f-strings too; docstrings say nothing to a user."""
    found: set[str] = set()
    for package in ("pipeline", "datasets", "stages"):
        for path in (ROOT / package).rglob("*.py"):
            tree = ast.parse(path.read_text())
            told = {
                id(node.body[0].value)
                for node in ast.walk(tree)
                if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and isinstance(node.body[0], ast.Expr)
            }
            found |= {
                node.value
                for node in ast.walk(tree)
                if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in told
            }
    return tuple(piece for piece in found if len(piece) >= SHORTEST)


def strange(line: str) -> int:
    """Plain words in the longest stretch of a line that stands nowhere in the sources."""
    own = bytearray(len(line))
    for piece in _pieces():
        at = line.find(piece)
        while at >= 0:
            own[at : at + len(piece)] = b"\1" * len(piece)
            at = line.find(piece, at + 1)
    left = "".join("\n" if known else letter for letter, known in zip(line, own, strict=True))
    return max(len(re.findall(r"(?<![\w./'-])[A-Za-z]{3,}(?![\w./'-])", run)) for run in left.split("\n"))


def test_there_are_lines_to_look_at() -> None:
    assert len(QUOTED) > 25


@pytest.mark.parametrize(("page", "line"), QUOTED)
def test_a_quoted_line_is_what_the_program_says(page: str, line: str) -> None:
    assert strange(line) <= VARIABLE, f"{page} quotes words that no source has"


def test_other_words_are_noticed() -> None:
    assert strange("rille: numbers/0: there is not enough room on this disk: make room on it") > VARIABLE


def test_a_quoted_error_has_a_code_that_there_is() -> None:
    quoted = {code for _, line in QUOTED for code in re.findall(r"^rille: error (\S+): ", line)}
    assert len(quoted) > 20
    assert quoted <= set(_pieces())
