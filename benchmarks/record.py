"""Run a benchmark and keep what it prints as a page of the documentation, with commit, machine and command.

``python benchmarks/record.py NAME [ARGUMENT ...]``, which ``make bench`` calls for each benchmark. A benchmark that
fails leaves the page as it was.
"""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

HERE = Path(__file__).resolve().parent
PAGES = HERE.parent / "docs" / "measured"


def main(name: str, *arguments: str) -> int:
    """Run ``benchmarks/NAME.py``; its exit code."""
    command = [sys.executable, str(HERE / f"{name}.py"), *arguments]
    said = []
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            said.append(line)
    if process.returncode == 0:
        PAGES.mkdir(exist_ok=True)
        (PAGES / f"{name}.md").write_text(page(name, arguments, "".join(said)), encoding="utf-8")
    return process.returncode


def page(name: str, arguments: tuple[str, ...], said: str) -> str:
    """The page of one benchmark."""
    words = ["make bench", f"ONLY={name}"] + ([f"ARGS={shlex.quote(' '.join(arguments))}"] if arguments else [])
    when = datetime.now(UTC).strftime("%Y-%m-%d")
    return (
        f"# {name}\n\n`{' '.join(words)}` on {when} at commit {commit()}, on {machine()}:\n\n"
        f"```text\n{said.strip()}\n```\n"
    )


def commit() -> str:
    """Short name of the commit, and whether the tree differs from it."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=HERE, capture_output=True, text=True, check=True).stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", "*.py")
    return git("rev-parse", "--short", "HEAD") + (" with changes" if changed else "")


def machine() -> str:
    """Processor, number of cores and version of Python."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{models[0] if models else platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
