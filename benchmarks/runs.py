"""Whole runs, cold and warm, by the clock: what the user waits for, from the command to its prompt.

``python benchmarks/runs.py [--sequence mockup] [--warm 5]``

A cold run starts with an empty cache and no compiled kernels; warm runs follow, with nothing to compute. Printed are
wall and processor time, and the bound ``1.15 x seconds of stages / workers + 5 s`` of the cold run with ``rille
timing``'s account.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median


def rille(*words: str, environment: dict[str, str]) -> tuple[float, float, str]:
    """Wall and processor time, s, of a command with all that it starts, and what it printed."""
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "rille.pipeline.cli", *words],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    wall, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        sys.exit(f"{' '.join(words)}: exit {done.returncode}\n{done.stderr[-2000:]}")
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return wall, used, done.stdout


def measure(sequence: str, folder: Path, warm: int) -> None:
    """Print one cold run with its account, and some warm ones."""
    where = ["--cache", str(folder / "cache"), "--runs", str(folder / "runs")]
    environment = {**os.environ, "XDG_CACHE_HOME": str(folder)}
    wall, used, text = rille("reconstruct", sequence, *where, environment=environment)
    print(f"cold   {wall:7.2f} s by the clock, {used:7.2f} s of processors: {text.split('  ')[-1].strip()}")
    _, _, account = rille("timing", sequence, "--runs", str(folder / "runs"), environment=environment)
    print("       " + account.strip().replace("\n", "\n       "))
    workers, seconds = re.findall(r" with (\d+) worker", account)[0], account.splitlines()[-1].split()[1]
    bound = 1.15 * float(seconds) / int(workers) + 5.0
    print(f"       command to prompt {wall:.1f} s, bound {bound:.1f} s: {'kept' if wall <= bound else 'NOT KEPT'}")
    runs = [rille("reconstruct", sequence, *where, environment=environment) for _ in range(warm)]
    if any("computed 0," not in text for *_, text in runs):
        sys.exit("a warm run had something to do: " + runs[-1][2])
    walls, useds = [r[0] for r in runs], [r[1] for r in runs]
    print(
        f"warm   {min(walls):.2f} {median(walls):.2f} {max(walls):.2f} s (least, median, greatest of {warm}), "
        f"{median(useds):.2f} s of processors"
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequence", default="mockup")
    parser.add_argument("--warm", type=int, default=5)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        measure(given.sequence, Path(name), given.warm)


if __name__ == "__main__":
    main()
