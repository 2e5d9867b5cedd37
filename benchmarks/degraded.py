"""Whole runs on degraded sequences: whatever happens to a few pairs, no run ends in an error of the program itself.

``python benchmarks/degraded.py [--only KIND ...] [--scenes N] [--jobs 2]``

Pieces of a street (KITTI 06, half size), of Devon Island, of a flying drone (EuRoC) and simulated beds under 2 to 15 %
of rocks, each degraded in the ten ways below and reconstructed by the command line. Printed for each way: runs by
exit code, those with a trajectory, and errors of the program itself, of which there must be none. A run that is refused
in one line (exit 2) or ends with holes (exit 3) is right here; how right its figures are is measured elsewhere.
Needs the folder that ``RILLE_DATA`` names.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

FRAMES = 8
COVERS = np.linspace(0.02, 0.15, 17)
"""Shares of the simulated beds under rocks."""

LONGEST = 240
"""Seconds of a run, after which it counts as one that hangs."""

INTERNAL = re.compile(r"RIL-999|RIL-534|RIL-577|RIL-581|Traceback")
OWN = "DegenerateError InputError"
"""Errors by which a stage says that its input does not determine its result."""

RILLE = (sys.executable, "-m", "rille.pipeline.cli")


@dataclass
class Pairs:
    """Images of a sequence, in memory."""

    left: list[Image]
    right: list[Image]

    def at(self, frames: Sequence[int], change: Callable[[Image], Image], left: bool = True) -> None:
        """Change both images of some frames, or the right ones alone."""
        for frame in frames:
            for images in (self.left, self.right) if left else (self.right,):
                images[frame] = change(images[frame])


def _shifted(image: Image) -> Image:
    height, width = image.shape[:2]
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), 0.4, 1.0)
    turn[0, 2] += 3
    return np.asarray(cv2.warpAffine(image, turn, (width, height), borderMode=cv2.BORDER_REFLECT), np.uint8)


def _margins(image: Image) -> Image:
    height, width = image.shape[:2]
    cut = np.zeros_like(image)
    middle = slice(height // 4, -height // 4), slice(width // 4, -width // 4)
    cut[middle] = image[middle]
    return cut


def _exposed(image: Image) -> Image:
    return np.clip(image * 2.5, 0, 255).astype(np.uint8)


def _noisy(image: Image) -> Image:
    noise = np.random.default_rng(int(image.sum()) % 2**31).normal(0, 40, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def _dropped(pairs: Pairs) -> None:
    for images in (pairs.left, pairs.right):
        del images[3:5]


def _doubled(pairs: Pairs) -> None:
    for images in (pairs.left, pairs.right):
        images[3], images[6] = images[2], images[5]


def _exchanged(pairs: Pairs) -> None:
    pairs.right[2], pairs.right[4] = pairs.right[4], pairs.right[2]


def _blackened(pairs: Pairs) -> None:
    pairs.at([3], np.zeros_like)
    pairs.at([5], np.zeros_like, left=False)


KINDS: dict[str, Callable[[Pairs], None]] = {
    "dropped": _dropped,
    "black": _blackened,
    "knocked": lambda pairs: pairs.at(range(4, FRAMES), _shifted, left=False),
    "doubled": _doubled,
    "exchanged": _exchanged,
    "blurred": lambda pairs: pairs.at(
        [2, 3, 5], lambda image: np.asarray(cv2.GaussianBlur(image, (0, 0), 6), np.uint8)
    ),
    "cropped": lambda pairs: pairs.at([2, 4], _margins),
    "exposed": lambda pairs: pairs.at([1, 4, 5], _exposed),
    "size": lambda pairs: pairs.at([3], lambda image: np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5), np.uint8)),
    "noise": lambda pairs: pairs.at([2, 3, 4], _noisy),
}


@dataclass(frozen=True)
class Scene:
    """A sequence on disk that ``rille init`` understands: ``left``, ``right`` and what belongs to them."""

    name: str
    folder: Path

    def degraded(self, kind: str, folder: Path) -> None:
        """Write it anew with its images degraded."""
        files = {side: sorted((self.folder / side).iterdir())[:FRAMES] for side in ("left", "right")}
        pairs = Pairs(*([cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files[side]] for side in files))
        KINDS[kind](pairs)
        for side, images in (("left", pairs.left), ("right", pairs.right)):
            (folder / side).mkdir(parents=True)
            for file, image in zip(files[side], images, strict=False):
                cv2.imwrite(str(folder / side / file.with_suffix(".png").name), image)
        for file in self.folder.iterdir():
            if file.is_file() and file.name in ("poses.txt", "times.txt"):  # one line a pair
                (folder / file.name).write_text("".join(file.read_text().splitlines(True)[: len(pairs.left)]))
            elif file.is_file() and file.suffix in (".txt", ".yaml", ".tum"):
                shutil.copy(file, folder)


def _calibration(folder: Path, matrices: NDArray[np.float64]) -> None:
    """Write KITTI's ``calib.txt`` for images of half the size, from projection matrices (2, 3, 4) of the full size."""
    halved = matrices * np.array([[0.5], [0.5], [1.0]])
    lines = (f"P{k}: " + " ".join(f"{x:.9g}" for x in matrix.ravel()) for k, matrix in enumerate(halved))
    (folder / "calib.txt").write_text("\n".join(lines))


def _render(folder: Path, seed: int, cover: float) -> None:
    """Render a bed of the simulator, a share ``cover`` of it under rocks."""
    choices = {"rock_cover": f"{cover:.4f}", "seed": str(seed + 1), "frames": str(FRAMES)}
    words = [word for key, value in choices.items() for word in ("--set", f"mockup.{key}={value}")]
    command = [*RILLE, "datasets", "export", "mockup-short", str(folder), *words, "--cache", f"{folder}-cache"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def scenes(root: Path, count: int, jobs: int) -> list[Scene]:
    """Write the first ``count`` sequences that are degraded."""
    data = Path(os.environ.get("RILLE_DATA") or sys.exit("RILLE_DATA must name the folder of the real sequences"))
    street, desert = root / "street", root / "desert"
    known = [Scene("street", street), Scene("desert", desert), Scene("drone", data / "euroc_moving")]
    for folder, source, names, first in (
        (street, "kitti06_51", "image_{0[0]}", 20),
        (desert, "devon_island", "{0}", 0),
    ):
        for side in ("left", "right"):
            (folder / side).mkdir(parents=True)
            for file in sorted((data / source / names.format(side)).glob("*.png"))[first : first + FRAMES]:
                image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
                half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
                cv2.imwrite(str(folder / side / file.name), half)
    _calibration(street, np.loadtxt(data / "kitti06_51" / "calib.txt").reshape(2, 3, 4))
    focal, centre, baseline = 969.0, (635.139, 463.537), 0.234
    lens = np.array([[focal, 0, centre[0], 0], [0, focal, centre[1], 0], [0, 0, 1, 0]])
    shift = np.zeros((3, 4))
    shift[0, 3] = -focal * baseline
    _calibration(desert, np.stack([lens, lens + shift]))
    beds = [(root / f"bed{k:02d}", k, cover) for k, cover in enumerate(COVERS[: max(count - len(known), 0)])]
    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(lambda bed: _render(*bed), beds))
    known += [Scene(folder.name, folder) for folder, _, _ in beds]
    return known[:count]


def run(scene: Scene, kind: str, root: Path) -> tuple[str, bool, str, float]:
    """Exit code in words, whether a trajectory was delivered, the last line printed, and the seconds it took."""
    folder, begin = root / f"{scene.name}-{kind}", time.monotonic()
    scene.degraded(kind, folder)
    words = ["--set", "hfvm.preset=fast", "--executor", "inline", "--progress", "quiet", "--keep-going"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "RILLE_CACHE": str(folder / "cache")}
    said, code = "", 0
    for command in (
        [*RILLE, "init", ".", "-o", "m.toml"],
        [*RILLE, "reconstruct", "m.toml", "--runs", "runs", *words],
    ):
        try:
            done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LONGEST)
        except subprocess.TimeoutExpired:
            return "hangs", False, f"more than {LONGEST} s", LONGEST
        said, code = said + done.stderr + done.stdout, done.returncode
        if code:
            break
    internal = [line for line in said.splitlines() if INTERNAL.search(line)]
    for file in folder.glob("runs/*/*/ledger.jsonl"):
        tasks = (json.loads(line) for line in file.read_text().splitlines())
        failed = (task for task in tasks if task.get("error"))
        internal += [f"{task['label']}: {task['reason']}" for task in failed if task["error"]["type"] not in OWN]
    posed = any(file.stat().st_size for file in folder.glob("runs/*/*/trajectory.tum"))
    shutil.rmtree(folder)
    return (
        "internal" if internal else str(code),
        posed,
        (internal or said.splitlines() or [""])[-1],
        time.monotonic() - begin,
    )


def main() -> int:
    """Print the table; 1 if any run ended in an error of the program itself, or hung."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=list(KINDS), choices=list(KINDS), metavar="KIND")
    parser.add_argument("--scenes", type=int, default=3 + len(COVERS))
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    table: dict[str, Counter[str]] = defaultdict(Counter)
    with tempfile.TemporaryDirectory(prefix="rille-degraded-") as at:
        root = Path(at)
        cases = [(scene, kind) for scene in scenes(root, options.scenes, options.jobs) for kind in options.only]
        with ThreadPoolExecutor(options.jobs) as pool:
            results = pool.map(lambda case: run(case[0], case[1], root), cases)
            for (scene, kind), (ended, posed, line, seconds) in zip(cases, results, strict=True):
                table[kind].update({ended: 1, "trajectory": int(posed)})
                shown = "trajectory" if posed else "-"
                line = f"{scene.name:12s} {kind:10s} {ended:8s} {shown:10s} {seconds:5.0f} s  {line[:160]}"
                print(line, file=sys.stderr, flush=True)
    columns = ("0", "3", "2", "1", "trajectory", "internal", "hangs")
    print(f"{'damage':12s}" + "".join(f"{name:>12s}" for name in columns))
    for kind, counts in table.items():
        print(f"{kind:12s}" + "".join(f"{counts[name]:12d}" for name in columns))
    bad = sum(counts["internal"] + counts["hangs"] for counts in table.values())
    print(f"\n{len(cases)} runs, {bad} errors of the program itself")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
