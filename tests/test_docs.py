"""The site builds without a warning; what README and docs print is run, or it says why not."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import textwrap
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
PAGES += sorted(p for p in DOCS.rglob("*.md") if not {"_build", "examples"} & set(p.relative_to(DOCS).parts))
LIST = DOCS / "reference/commands-not-run.md"
BLOCK = re.compile(r"(?:^<!-- (not run|needs data): (.*?) -->\n)?^```(sh|python)\n(.*?)^```", re.M | re.S)
FENCE = re.compile(r"^```.*?^```", re.M | re.S)
INLINE = re.compile(r"(`)([\w/]+\.py)`")
EXAMPLES = frozenset[str]()
"""Modules that a page names though they do not exist: those that its reader is to write."""
needs_sphinx = pytest.mark.skipif(find_spec("sphinx_gallery") is None, reason="needs `make docs-fast` once")


class Block(NamedTuple):
    """A block of commands or of Python of a page; ``data`` are folders of RILLE_DATA, ``reason`` why it is not run."""

    language: str
    code: str
    data: tuple[str, ...]
    reason: str


def blocks(page: Path) -> list[Block]:
    return [
        Block(language, code, tuple(words.split()) if mark == "needs data" else (), words if mark == "not run" else "")
        for mark, words, language, code in BLOCK.findall(page.read_text(encoding="utf-8"))
    ]


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def first_line(code: str) -> str:
    return re.sub(r"\s+#.*", "", next(line for line in code.splitlines() if line and not line.startswith("#")))


def not_run() -> str:
    """The page that lists what no test runs."""
    rows = [
        f"| `{name(page)}` | `{first_line(block.code)}` | {block.reason} |"
        for page in PAGES
        for block in blocks(page)
        if block.reason
    ]
    return (
        "# Commands that no test runs\n\n"
        "Tests run all other blocks of commands and of Python in the README and in these pages as they stand.\n\n"
        "| page | block that begins with | why it is not run |\n|---|---|---|\n" + "\n".join(rows) + "\n"
    )


def test_the_dataflow_is_drawn_once() -> None:
    from rille.pipeline.flow import reconstruction

    drawn = re.search(r"^```text\n(image ->.*?)^```", (DOCS / "dataflow.md").read_text(encoding="utf-8"), re.M | re.S)
    assert drawn is not None
    assert textwrap.indent(drawn[1], "    ") in str(reconstruction.__doc__)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_modules_that_a_page_names_are_there(page: Path) -> None:
    folders = ("pipeline", "stages", "datasets", "tests", "benchmarks", "docs", "rille")
    there = [path.relative_to(ROOT).as_posix() for folder in folders for path in (ROOT / folder).rglob("*.py")]
    named = {name for _, name in INLINE.findall(FENCE.sub("", page.read_text(encoding="utf-8")))}
    lost = sorted(name for name in named if not any(("/" + path).endswith("/" + name) for path in there))
    assert not [name for name in lost if name not in EXAMPLES]


def test_the_list_of_what_is_not_run_is_complete() -> None:
    assert LIST.read_text(encoding="utf-8") == not_run(), "make pages"


def run_blocks(page: Path, folder: Path, cache: Path, data: Path | None) -> None:
    """Run the blocks of a page one after the other in a folder, as a reader would."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    env = {**os.environ, "PATH": path, "RILLE_CACHE": str(cache), "MPLBACKEND": "agg"}
    env.pop("RILLE_DATA", None)  # a reader has the folders that the page names, and no more
    for number, block in enumerate(b for b in blocks(page) if not b.reason):
        for wanted in block.data:
            if data is None or not (data / wanted).is_dir():
                pytest.skip(f"RILLE_DATA names no folder with {wanted}")
            if not (folder / wanted).exists():
                (folder / wanted).symlink_to(data / wanted)
        program = folder / f"block{number}.{'py' if block.language == 'python' else 'sh'}"
        guarded = 'if __name__ == "__main__":\n' + "".join(f"    {line}\n" for line in block.code.splitlines())
        program.write_text(guarded if block.language == "python" else block.code)
        command = [sys.executable] if block.language == "python" else ["bash", "-e"]
        done = subprocess.run([*command, str(program)], cwd=folder, env=env, capture_output=True, text=True)
        assert done.returncode == 0, f"{first_line(block.code)}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"


@pytest.fixture(scope="session")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def short(block: Block) -> bool:
    return block.language == "python" and "reconstruct" not in block.code


def runnable(fast: bool) -> list[Path]:
    """Pages with something to run, the README apart, which has its own tests; fast ones have short Python alone."""
    found = {page: [b for b in blocks(page) if not b.reason] for page in PAGES[1:]}
    return [page for page, these in found.items() if these and all(short(b) for b in these) == fast]


@pytest.mark.parametrize("page", runnable(fast=True), ids=name)
def test_what_a_page_prints_runs(page: Path, tmp_path: Path, cache: Path) -> None:
    run_blocks(page, tmp_path, cache, None)


@pytest.mark.slow
@pytest.mark.parametrize("page", runnable(fast=False), ids=name)
def test_what_a_page_prints_runs_slowly(page: Path, tmp_path: Path, cache: Path) -> None:
    where = os.environ.get("RILLE_DATA")
    run_blocks(page, tmp_path, cache, None if where is None else Path(where))


@pytest.mark.slow
@pytest.mark.parametrize("script", sorted((DOCS / "gallery").glob("*.py")), ids=name)
def test_a_script_of_the_gallery_runs(script: Path, tmp_path: Path, cache: Path) -> None:
    env = {**os.environ, "MPLBACKEND": "agg", "RILLE_CACHE": str(cache)}
    done = subprocess.run([sys.executable, script], cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]


def build(tmp_path: Path, **env: str) -> Path:
    out = tmp_path / "html"
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-d", tmp_path / "doctrees", DOCS, out]
    done = subprocess.run(command, env={**os.environ, **env}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
    return out


@needs_sphinx
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    assert (build(tmp_path, RILLE_DOCS_FAST="1") / "index.html").is_file()


@needs_sphinx
@pytest.mark.slow
def test_the_site_builds_and_its_examples_run(tmp_path: Path) -> None:
    out = build(tmp_path)
    assert (out / "index.html").is_file()
    tour = (tmp_path / "jupyter_execute/tutorials/tour.ipynb").read_text(encoding="utf-8")
    assert '"image/png"' in tour, "it was executed"
    assert len(tour) < 2**20
    for script in (DOCS / "gallery").glob("*.py"):
        page = (out / f"examples/{script.stem}.html").read_text(encoding="utf-8")
        assert "sphx-glr-single-img" in page or "sphx-glr-horizontal" in page, script.name
    commands = (out / "reference/command-line.html").read_text(encoding="utf-8")
    assert "rille reconstruct" in commands
    assert "--memory-limit" in commands


if __name__ == "__main__":
    LIST.write_text(not_run(), encoding="utf-8")
