"""A long sequence of real images, from the command to the report: memory over time, tasks that take long, files.

``python benchmarks/long_street.py [--frames 2000] [--jobs 2] [--folder KEPT]``. ``RILLE_DATA`` names a folder with
``kitti06_51``.

The street's 51 frames, reduced to 320 x 96 pixels, are repeated forwards and backwards, with their true poses. The run
is ``rille reconstruct`` with its defaults, in a process of its own, from an empty cache. Every second the memory of the
client (which holds dask's scheduler) and of the workers is read. Each figure stands beside its limit.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil

WIDTH, HEIGHT = 320, 96

TASK = 5.0
"""Seconds that a task may take."""

FLAT = 1.1
"""Memory at the end of the run against that in its middle."""

FILES = 4
"""Files an artifact."""

PAGE = 5e6
"""Bytes of the report's page."""


@dataclass(frozen=True)
class Sample:
    """Seconds since the start; resident bytes of the client and of the greatest worker."""

    at: float
    client: int
    worker: int


def street(source: Path, folder: Path, frames: int) -> Path:
    """Write the long street as a folder in KITTI's layout; each small image once, the rest are links to it."""
    small: dict[tuple[str, int], Path] = {}
    names = sorted(path.name for path in (source / "image_l").iterdir())
    there = [*range(len(names)), *range(len(names) - 2, 0, -1)]
    for camera in ("image_l", "image_r"):
        (folder / camera).mkdir(parents=True)
        for number in range(frames):
            original = there[number % len(there)]
            to = folder / camera / f"{number:06d}.png"
            if (camera, original) in small:
                to.hardlink_to(small[camera, original])
                continue
            image = cv2.imread(str(source / camera / names[original]), cv2.IMREAD_GRAYSCALE)
            if image is None:
                sys.exit(f"{source / camera / names[original]} is no image")
            rows, cols = image.shape
            cv2.imwrite(str(to), cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA))
            small[camera, original] = to
    scale = np.diag([WIDTH / cols, HEIGHT / rows, 1.0])
    centre = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])  # pixel centres are integers, edges are scaled
    change = centre @ scale @ np.linalg.inv(centre)
    given = np.loadtxt(source / "calib.txt").reshape(2, 3, 4)
    np.savetxt(folder / "calib.txt", (change @ given).reshape(2, 12))
    poses = (source / "poses.txt").read_text().splitlines()
    (folder / "poses.txt").write_text("".join(f"{poses[there[n % len(there)]]}\n" for n in range(frames)))
    return folder


def watched(command: list[str], folder: Path) -> tuple[int, float, list[Sample]]:
    """Run a command; its exit code, seconds, and a sample each second."""
    begin, samples = time.monotonic(), list[Sample]()
    with (folder / "said.txt").open("w") as said:
        process = subprocess.Popen(command, cwd=folder, stdout=said, stderr=subprocess.STDOUT)
        client = psutil.Process(process.pid)
        while process.poll() is None:
            with suppress(psutil.Error):  # it ends as we look
                workers = [resident(child) for child in client.children(recursive=True)]
                samples.append(Sample(time.monotonic() - begin, client.memory_info().rss, max(workers, default=0)))
            time.sleep(1.0)
    return process.returncode, time.monotonic() - begin, samples


def resident(process: psutil.Process) -> int:
    """Resident bytes of a process; none of one that has ended."""
    try:
        return int(process.memory_info().rss)
    except psutil.Error:
        return 0


def verdict(kept: bool) -> str:
    """Word of a line with a limit."""
    return "kept" if kept else "NOT KEPT"


def over_time(samples: list[Sample]) -> Iterator[str]:
    """Memory in tenths of the run, the median of each, and whether it is flat in the second half."""
    tenths = [part for part in np.array_split(np.arange(len(samples)), 10) if part.size]
    for who in ("client", "worker"):
        every = np.array([getattr(sample, who) for sample in samples], dtype=float) / 1e6
        medians = [float(np.median(every[part])) for part in tenths]
        ratio = medians[-1] / medians[len(medians) // 2]
        yield (
            f"{who:7s} MB by tenths of the run {' '.join(f'{m:.0f}' for m in medians)}, greatest {every.max():.0f}; "
            f"end / middle {ratio:.2f}, limit {FLAT}: {verdict(ratio <= FLAT)}"
        )


def longest_tasks(rows: list[dict[str, Any]]) -> Iterator[str]:
    """The longest task of each stage, seconds without compiling, the longest first."""
    took: dict[str, tuple[float, str]] = {}
    for row in rows:
        if row["status"] == "computed":
            seconds = row["seconds"] - row["compiling"]
            took[row["stage"]] = max(took.get(row["stage"], (0.0, "")), (seconds, row["label"]))
    longest = sorted(took.values(), reverse=True)
    told = ", ".join(f"{label} {seconds:.2f}" for seconds, label in longest[:10])
    yield f"longest tasks, s (each stage's, compiling left out): {told}; limit {TASK}: {verdict(longest[0][0] <= TASK)}"
    peaks = sorted(((r["peak_rss"], r["label"]) for r in rows if r["status"] == "computed"), reverse=True)
    yield f"greatest memory of a worker by the ledger: {peaks[0][0] / 1e6:.0f} MB at {peaks[0][1]}"


def files(cache: Path) -> tuple[int, int, int]:
    """Artifacts, files of their folders, and the entries of the fullest folder."""
    counts: Counter[Path] = Counter()
    artifacts = found = 0
    for at, folders, names in os.walk(cache / "artifacts"):
        counts[Path(at)] = len(folders) + len(names)
        found += len(names)
        artifacts += sum(name.endswith(".zarr.zip") for name in names) + sum(n.endswith(".zarr") for n in folders)
    return artifacts, found, counts.most_common(1)[0][1]


def report(folder: Path, name: str, code: int, wall: float, samples: list[Sample]) -> Iterator[str]:
    """Lines of the figures of a run."""
    from rille.pipeline.engine import events

    run = (folder / "runs" / name / "latest").resolve()
    rows = events.read(run / "ledger.jsonl")
    states = Counter(row["status"] for row in rows)
    told = ", ".join(f"{states[state]} {state}" for state in sorted(states))
    yield f"exit code {code}, {wall:.0f} s, {told}: {verdict(code == 0 and set(states) <= {'computed', 'cached'})}"
    yield from over_time(samples)
    yield from longest_tasks(rows)
    artifacts, found, most = files(folder / "cache")
    kept = verdict(found <= FILES * artifacts)
    yield f"{artifacts} artifacts in {found} files, fullest folder {most} entries; limit {FILES} files each: {kept}"
    page = (run / "report.html").stat().st_size
    yield f"page {page / 1e6:.2f} MB, limit {PAGE / 1e6:.0f}: {verdict(page <= PAGE)}"
    said = json.loads((run / "report.json").read_text())
    yield f"report complete: {said.get('complete')}"


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--folder", type=Path, help="where to work (kept); a temporary one by default")
    parser.add_argument("--set", action="append", default=[], help="as of rille reconstruct")
    given = parser.parse_args()
    source = Path(os.environ.get("RILLE_DATA", "")) / "kitti06_51"
    if not source.is_dir():
        sys.exit("RILLE_DATA does not name a folder with kitti06_51")
    with tempfile.TemporaryDirectory() as temporary:
        folder = (given.folder or Path(temporary)).resolve()
        data = folder / "data" / f"street{given.frames}"
        if not data.exists():
            street(source, data, given.frames)
        command = [sys.executable, "-m", "rille.pipeline.cli", "reconstruct", str(data), "--jobs", str(given.jobs)]
        command += [word for setting in given.set for word in ("--set", setting)]
        command += ["--cache", str(folder / "cache"), "--runs", str(folder / "runs")]
        code, wall, samples = watched(command, folder)
        (folder / "samples.json").write_text(json.dumps([vars(sample) for sample in samples]))
        for line in report(folder, data.name, code, wall, samples):
            print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
