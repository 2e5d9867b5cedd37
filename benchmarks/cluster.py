"""Where a sequence of up to 100 000 frames breaks: arithmetic on what was measured, no measurement of its own.

``python benchmarks/cluster.py [--frames 2000 10000 100000] [--workers 64] [--task 0.25]``

Each figure of :class:`Measured` says what it was measured on; all grow with the frames in proportion, which was looked
at between 200 and 2000 frames. The table names the first limit that each length meets.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass


@dataclass(frozen=True)
class Measured:
    """Figures of the street at 320 x 96, forwards and backwards to 2000 frames, if nothing else is said."""

    tasks: float = 10.1
    """Tasks a frame; every third frame is a basic pair."""
    client: float = 4.7e3
    """Bytes a node at the end of a cold run: 284 MB of 20 360 nodes; idle stages (benchmarks/scale.py) take 2.0e3."""
    start: float = 190e6
    """Bytes of a client that has done nothing."""
    plan: float = 0.2e-3
    """Seconds a node that is found in the cache."""
    scheduler: float = 1.5e-3
    """Seconds of processor a task, of dask's scheduler and the client (97 860 nodes of benchmarks/scale.py)."""
    stored: float = 95e3
    """Bytes an artifact."""
    scan: float = 1.5e-3
    """Seconds a frame of the slowest tasks that read the whole sequence: ``keyframes``, ``trajectory``."""


LIMITS = (
    ("client", "the client holds more than 4 GB"),
    ("scan", "one task takes more than a minute: keyframes and trajectory go through all frames"),
    ("scheduler", "the scheduler has less time for a task than it needs: more workers gain nothing"),
)


def rows(frames: int, workers: int, task: float, m: Measured) -> Iterator[tuple[str, str]]:
    """Name and value of each figure, and the limits that are met."""
    nodes = frames * m.tasks
    client = m.start + nodes * m.client
    supply = m.scheduler * workers / task  # share of the scheduler's time
    met = {
        "client": client > 4e9,
        "scan": frames * m.scan > 60,
        "scheduler": supply > 1,
    }
    yield "tasks, and objects of the store", f"{nodes:,.0f}"
    yield "store", f"{nodes * m.stored / 1e9:.1f} GB"
    yield "client", f"{client / 1e9:.2f} GB"
    yield "planning, all cached", f"{nodes * m.plan:.0f} s"
    yield "slowest task of the whole sequence", f"{frames * m.scan:.0f} s"
    yield f"scheduler, of its time with {workers} workers", f"{100 * supply:.0f} %"
    yield "workers that it can keep busy", f"{task / m.scheduler:.0f}"
    yield "least wall time", f"{max(nodes * task / workers, nodes * m.scheduler) / 60:.0f} min"
    yield "limits met", "; ".join(words for name, words in LIMITS if met[name]) or "none"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[2_000, 10_000, 100_000])
    parser.add_argument("--workers", type=int, default=64)
    parser.add_argument("--task", type=float, default=0.25, help="mean seconds of a task")
    given = parser.parse_args()
    for frames in given.frames:
        print(f"{frames:,} frames")
        for name, value in rows(frames, given.workers, given.task, Measured()):
            print(f"  {name:45s} {value}")


if __name__ == "__main__":
    main()
