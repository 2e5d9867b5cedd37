"""The estimate of the time left, replayed over ledgers of runs.

    benchmarks/forecast.py LEDGER...               after each tenth of the tasks: estimated over true seconds left
    benchmarks/forecast.py --write LEDGER LEDGER   make pipeline/engine/reference.py: seconds from a run with compiled
                                                   kernels, compiling from one without

The reference is chosen on the mockup; it is judged on other sequences.
"""

from __future__ import annotations

import argparse
import json
import sys
from datetime import date
from pathlib import Path
from types import SimpleNamespace
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

TENTHS = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.9)


def replay(path: Path, jobs: int) -> list[tuple[float, float, float]]:
    """Share of tasks that ended, seconds estimated and true, at each of ``TENTHS``."""
    from rille.pipeline.engine.forecast import Forecast

    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    later = {label for r in rows for label in r.get("expansion", {}).get("nodes", [])}
    tasks = {r["label"]: r for r in rows if "label" in r}
    forecast = Forecast([n for n in tasks if n not in later], None, jobs)
    end = max(t["ended"] for t in tasks.values() if "ended" in t)
    computed = sum("ended" in t for t in tasks.values())
    marks, done, found = list(TENTHS), 0, []
    for row in rows:
        for label in row.get("expansion", {}).get("nodes", []):
            if label in tasks:
                forecast.added(label)
        if "label" not in row:
            continue
        took = {"seconds": row.get("seconds", 0.0), "compiling": row.get("compiling", 0.0)}
        forecast.ended(SimpleNamespace(label=row["label"], status=row["status"], **took))  # type: ignore[arg-type]
        done += "ended" in row
        if marks and done >= marks[0] * computed:
            found.append((marks.pop(0), forecast.left() or 0.0, end - row.get("ended", end)))
    return found


def table(warm: Path, cold: Path) -> dict[str, tuple[float, float, float]]:
    """The reference from two runs of the mockup."""
    from rille.pipeline.engine.forecast import kind

    found: dict[str, tuple[float, float, float]] = {}
    rows = [json.loads(line) for line in warm.read_text(encoding="utf-8").splitlines()]
    first = [json.loads(line) for line in cold.read_text(encoding="utf-8").splitlines()]
    later = {label for r in rows for label in r.get("expansion", {}).get("nodes", [])}
    tasks: list[dict[str, Any]] = [r for r in rows if r.get("stage")]
    opened = sum(t["label"] not in later for t in tasks)
    for name in sorted({kind(t["label"]) for t in tasks}):
        mine = [t for t in tasks if kind(t["label"]) == name]
        seconds = [t["seconds"] - t.get("compiling", 0.0) for t in mine if "seconds" in t]
        compiling = sum(r.get("compiling", 0.0) for r in first if kind(r.get("label", "")) == name)
        mean = sum(seconds) / len(seconds) if seconds else 0.0
        share = sum(t["label"] in later for t in mine) / opened
        found[name] = (round(share, 6), round(mean, 4), round(compiling, 2))
    return found


def write(warm: Path, cold: Path) -> None:
    lines = "".join(f'    "{name}": {values},\n' for name, values in table(warm, cold).items())
    target = Path(__file__).resolve().parents[1] / "pipeline" / "engine" / "reference.py"
    target.write_text(
        f'"""Seconds of the mockup\'s tasks, for runs of which nothing is known yet (benchmarks/forecast.py, '
        f'{date.today()})."""\n\nfrom __future__ import annotations\n\n'
        f"REFERENCE: dict[str, tuple[float, float, float]] = {{\n{lines}}}\n"
        '"""See :data:`rille.pipeline.engine.forecast.Kinds`; one core, images of 570 x 520."""\n',
        encoding="utf-8",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ledgers", type=Path, nargs="+")
    parser.add_argument("--jobs", type=int, default=2, help="workers of those runs")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    if options.write:
        return write(*options.ledgers)
    for path in options.ledgers:
        found = replay(path, options.jobs)
        print(f"{path}: " + "  ".join(f"{mark:.0%} {told / true:.2f}" for mark, told, true in found if true))
    return None


if __name__ == "__main__":
    main()
