"""Undisturbed runs to compare with, programs to torment, and the table at the end."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
PLACES = [str(HERE), str(HERE.parent / "pipeline"), str(HERE.parent.parent)]
for place in PLACES[:2]:
    if place not in sys.path:
        sys.path.insert(0, place)

HEADINGS = ("case", "tries", "lost", "wrong", "recomputed", "expected", "remark")


@pytest.fixture
def row(request: pytest.FixtureRequest):
    """Notes a line of the table, and asserts what must hold of every one."""

    def note(case: str, tries: int, lost: list, wrong: list, recomputed: int, expected: int | range, remark="") -> None:
        span = expected if isinstance(expected, range) else range(expected, expected + 1)
        words = f"{span[0]}..{span[-1]}" if len(span) > 1 else str(span[0])
        request.node.user_properties.append(
            ("torture", [case, tries, len(lost), len(wrong), recomputed, words, str(remark)])
        )
        assert not lost, f"{case}: lost {lost}"
        assert not wrong, f"{case}: wrong {wrong}"
        assert recomputed in span, f"{case}: recomputed {recomputed} instead of {words}"

    return note


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """The table of what was tried and what came of it."""
    reports = [r for kind in ("passed", "failed") for r in terminalreporter.stats.get(kind, ())]
    rows = [[str(v) for v in value] for r in reports for name, value in r.user_properties if name == "torture"]
    if not rows:
        return
    widths = [max(len(line[k]) for line in [list(HEADINGS), *rows]) for k in range(len(HEADINGS))]
    terminalreporter.section("torture of the engine")
    for line in [list(HEADINGS), *rows]:
        cells = [c.ljust(w) if k in (0, 6) else c.rjust(w) for k, (c, w) in enumerate(zip(line, widths, strict=True))]
        terminalreporter.write_line("  ".join(cells).rstrip())


@dataclass
class Program:
    """A process that forks one tormented program at a time."""

    process: subprocess.Popen
    folder: Path
    pid: int = 0

    def start(self, **task: Any) -> int:
        """Begin; gives the process id, which is also that of the group."""
        self.out, self.log = self.folder / "out.json", self.folder / "log.txt"
        self.out.unlink(missing_ok=True)
        task = {"do": "run", **task, "out": str(self.out), "log": str(self.log)}
        self.process.stdin.write(json.dumps(task) + "\n")
        self.process.stdin.flush()
        self.pid = int(self.process.stdout.readline())
        return self.pid

    def wait(self) -> int:
        """Its exit code, or minus its signal."""
        return int(self.process.stdout.readline())

    def running(self) -> bool:
        """Whether it has not left what it found yet."""
        return not self.out.exists()

    def found(self) -> dict[str, Any]:
        """What it left."""
        return json.loads(self.out.read_text())

    def run(self, **task: Any) -> dict[str, Any]:
        """All of it."""
        self.start(**task)
        assert self.wait() == 0, self.log.read_text()
        return self.found()


@pytest.fixture(scope="session")
def programs(tmp_path_factory: pytest.TempPathFactory):
    """``programs(n)`` gives n of them; they are kept for all tests."""
    made: list[Program] = []
    from rille.pipeline.engine.runtime.environment import worker_environment

    folder = tmp_path_factory.mktemp("programs")
    environment = {**os.environ, **worker_environment(), "PYTHONPATH": os.pathsep.join(PLACES)}

    def give(count: int) -> list[Program]:
        while len(made) < count:
            place = folder / str(len(made))
            place.mkdir()
            process = subprocess.Popen(
                [sys.executable, "-m", "torn.zygote"],
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            made.append(Program(process, place))
        return made[:count]

    yield give
    for program in made:
        program.process.stdin.close()
        program.process.wait(10)


@pytest.fixture(scope="session")
def calm(programs, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The undisturbed run: its cache, digests by key, and nodes by label."""
    import time

    (program,) = programs(1)
    cache = tmp_path_factory.mktemp("calm") / "cache"
    program.run(cache=str(cache.with_name("warm-up")))
    begin = time.monotonic()
    nodes = program.run(cache=str(cache))["nodes"]
    assert {n["status"] for n in nodes.values()} == {"computed"}
    return {
        "cache": cache,
        "nodes": nodes,
        "digests": {n["key"]: n["digest"] for n in nodes.values()},
        "labels": {label: n["digest"] for label, n in nodes.items()},
        "seconds": time.monotonic() - begin,
    }
