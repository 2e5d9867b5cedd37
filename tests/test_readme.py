"""The README and the pages: short, no link leads nowhere, and what they print can be run."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
PAGES = [p for p in sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]) if "_build" not in p.parts]


def blocks(language: str) -> list[str]:
    """Blocks of code of the README in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.M | re.S)


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= 120


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_every_link_leads_to_a_file(page: Path) -> None:
    links = re.findall(r"\]\((?!https?:|#)([^)#\s]+)", page.read_text(encoding="utf-8"))
    assert not [link for link in links if not (page.parent / link).exists()]


@pytest.mark.slow
def test_the_python_block_runs(tmp_path: Path) -> None:
    (code,) = blocks("python")
    program = tmp_path / "readme.py"
    program.write_text('if __name__ == "__main__":\n' + "".join(f"    {line}\n" for line in code.splitlines()))
    told = subprocess.run([sys.executable, program], cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    drift, unit = told.split()[-2:]
    assert float(drift) < 1
    assert unit == "m"


@pytest.mark.slow
def test_the_commands_for_own_data_run(tmp_path: Path) -> None:
    (commands,) = [block for block in blocks("sh") if "datasets export" in block]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(["bash", "-e", "-c", commands], cwd=tmp_path, check=True, env={**os.environ, "PATH": path})
    assert (tmp_path / "runs/my_data/latest/report.html").is_file()
