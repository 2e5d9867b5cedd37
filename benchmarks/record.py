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
import time
from datetime import UTC, datetime
from pathlib import Path

HERE = Path(__file__).resolve().parent
PAGES = HERE.parent / "docs" / "measured"


def main(name: str, *arguments: str) -> int:
    """Run ``benchmarks/NAME.py``; its exit code."""
    command = [sys.executable, str(HERE / f"{name}.py"), *arguments]
    said, begun = [], (time.monotonic(), seconds_of_others())
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            print(line, end="", flush=True)
            said.append(line)
    if process.returncode == 0:
        cores = (seconds_of_others() - begun[1]) / (time.monotonic() - begun[0])
        PAGES.mkdir(exist_ok=True)
        (PAGES / f"{name}.md").write_text(page(name, arguments, "".join(said), cores), encoding="utf-8")
    return process.returncode


def page(name: str, arguments: tuple[str, ...], said: str, others: float) -> str:
    """The page of one benchmark; ``others``: cores that other programs kept busy meanwhile."""
    folder = os.environ.get("RILLE_DATA")
    said = said.replace(folder, "$RILLE_DATA") if folder else said
    words = ["make bench", f"ONLY={name}"] + ([f"ARGS={shlex.quote(' '.join(arguments))}"] if arguments else [])
    when = datetime.now(UTC).strftime("%Y-%m-%d")
    return (
        f"# {name}\n\n`{' '.join(words)}` on {when} at commit {commit()}, on {machine()}, "
        f"of which other programs kept {max(others, 0):.1f} busy:\n\n"
        f"```text\n{said.strip()}\n```\n"
    )


def seconds_of_others() -> float:
    """Processor time that programs other than this one's have taken so far."""
    own = os.times()
    stat = Path("/proc/stat")
    if not stat.exists():
        return 0.0
    user, nice, system, _idle, _waiting, irq, softirq = map(int, stat.read_text().split()[1:8])
    busy = (user + nice + system + irq + softirq) / os.sysconf("SC_CLK_TCK")
    return busy - own.user - own.system - own.children_user - own.children_system


def commit() -> str:
    """Short name of the commit, and whether the tree differs from it."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=HERE, capture_output=True, text=True, check=True).stdout.strip()

    changed = git("status", "--porcelain", "--untracked-files=no", "--", "*.py")
    return git("rev-parse", "--short", "HEAD") + (" with changes" if changed else "")


def machine() -> str:
    """Processor, version of Python and number of cores."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{models[0] if models else platform.machine()}, Python {platform.python_version()}, {os.cpu_count()} cores"


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
