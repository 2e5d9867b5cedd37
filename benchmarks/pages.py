"""Size of reports, and seconds until they are open: of the mockup, a street of 200 frames, and a simulated drive.

``python benchmarks/pages.py [RUN_FOLDER ...]``. The street is that of KITTI 06 in the folder that ``RILLE_DATA`` names,
at half the size, forth and back until there are 200 frames. Each page is opened from disk in a browser of its own,
:data:`TIMES` times; the median counts. Fails where one is larger than 5 MB, or takes a second or more: until its text
is there (DOMContentLoaded), all of it is loaded, or the map is drawn.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "pipeline"))
from toys.browser import Browser

TIMES, MOST_MB, MOST_SECONDS, FRAMES = 5, 5.0, 1.0, 200
OPENED = """(() => {
  const page = performance.getEntriesByType('navigation')[0], map = performance.getEntriesByName('map')[0];
  return [page.domContentLoadedEventEnd, page.loadEventEnd, map.startTime].map((ms) => ms / 1000);
})()"""


def street(folder: Path) -> Path:
    """Make the sequence of 200 frames in a new folder."""
    given = Path(os.environ["RILLE_DATA"]) / "kitti06_51"
    there = len(list((given / "image_l").iterdir()))
    period = 2 * (there - 1)
    order = [min(i % period, period - i % period) for i in range(FRAMES)]
    for side in ("image_l", "image_r"):
        (folder / side).mkdir(parents=True)
        files = sorted((given / side).iterdir())
        for number, frame in enumerate(order):
            image = cv2.imread(str(files[frame]), cv2.IMREAD_UNCHANGED)
            even = image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2]
            half = cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(folder / side / f"{number:06d}.png"), half)
    lines = []
    for line in (given / "calib.txt").read_text().splitlines():
        name, P = line.split()[:-12], [float(word) for word in line.split()[-12:]]
        for k in (0, 3, 5, 7):
            P[k] *= 0.5
        for k in (2, 6):  # half as large a pixel has its centre elsewhere
            P[k] = 0.5 * (P[k] + 0.5) - 0.5
        lines.append(" ".join([*name, *map(repr, P)]))
    (folder / "calib.txt").write_text("\n".join(lines) + "\n")
    return folder


def runs(folder: Path) -> list[Path]:
    """Compute the three runs, or find them in the cache; their folders."""
    commands = (
        ("reconstruct", "mockup"),
        ("reconstruct", str(street(folder / f"street{FRAMES}"))),
        ("drive", "mockup-loop"),
    )
    found = []
    for command in commands:
        said = subprocess.run(
            [str(Path(sys.executable).with_name("rille")), *command, "--quiet", "--runs", str(folder / "runs")],
            stdout=subprocess.PIPE,
            text=True,
            check=False,
        )
        if said.returncode not in (0, 3):
            raise SystemExit(f"rille {' '.join(command)} failed")
        found.append(Path(said.stdout.split("\n")[-2].split("  ")[0]).parent)
    return found


def opening(page: Path) -> list[float]:
    """Median seconds until the text is there, all is loaded, and the map is drawn."""
    rows = []
    for _ in range(TIMES):
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
            browser = Browser(str(shutil.which("chromium")), Path(profile))
            with contextlib.closing(browser):
                browser.open(page)
                rows.append(browser.run(OPENED))
    return [statistics.median(column) for column in zip(*rows, strict=True)]


def main() -> int:
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        print("| run | MB | text, s | loaded, s | map, s |\n|---|---|---|---|---|")
        for run in map(Path, sys.argv[1:]) if sys.argv[1:] else runs(Path(folder)):
            page = run.resolve() / "report.html"
            size, seconds = page.stat().st_size / 1e6, opening(page)
            failed += size > MOST_MB or max(seconds) >= MOST_SECONDS
            print(f"| {page.parents[1].name} | {size:.2f} | {' | '.join(f'{s:.2f}' for s in seconds)} |", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
