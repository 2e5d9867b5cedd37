"""What the native solver is worth: the matcher's processor time with it, and with the reference in numba.

``python benchmarks/kernels.py [--image LEFT RIGHT]``: the street's first pair of RILLE_DATA by default. Each preset
runs in a process of its own, with either solver in turn. It fails if any result differs, or if the reference takes more
than five times as long.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

PRESETS = {"default": 7, "fast": 7, "accurate": 3}
"""Presets, and how often each is run."""
SOLVERS = "native", "reference"
ROUNDS = 3
MOST = 5.0
"""Greatest ratio of the reference's time."""


def measure(name: str, files: list[str]) -> None:
    """Match with one solver; print preset, digest of the result and seconds."""
    import cv2

    from rille.stages.hfvm.native import build

    cv2.setNumThreads(1)
    if name == "reference":
        build.binary, build.compiled = (lambda: Path("/none")), (lambda: None)
    from rille.stages.hfvm.params import HfvmParams
    from rille.stages.hfvm.stage import match

    left, right = (cv2.imread(file, cv2.IMREAD_GRAYSCALE) for file in files)
    for preset, times in PRESETS.items():
        params, seconds = HfvmParams.model_validate({"preset": preset}), []
        for _ in range(times + 1):  # the first one compiles
            begin = time.process_time()
            found: Any = match(left, right, params)
            seconds.append(time.process_time() - begin)
        arrays = found.column_disparity, found.row_disparity, found.validity, found.disparity_std
        digest = hashlib.sha256(b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)).hexdigest()
        print(preset, digest, min(seconds[1:]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--image", nargs=2, help="left and right image")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help=f"of both solvers (default {ROUNDS})")
    parser.add_argument("--solver", help=argparse.SUPPRESS)
    options = parser.parse_args()
    files = options.image
    if files is None:
        street = Path(os.environ.get("RILLE_DATA") or sys.exit("set RILLE_DATA, or give --image")) / "kitti06_51"
        files = [str(min((street / side).iterdir())) for side in ("image_l", "image_r")]
    if options.solver:
        measure(options.solver, files)
        return
    found: dict[tuple[str, str], tuple[str, float]] = {}
    # Round by round, as the machine is not equally fast all the time.
    for name in SOLVERS * options.rounds:
        command = [sys.executable, "-W", "ignore", __file__, "--solver", name, "--image", *files]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        for preset, digest, seconds in map(str.split, done.stdout.splitlines()):
            found[name, preset] = digest, min(float(seconds), found.get((name, preset), ("", math.inf))[1])
    print("| preset | native, s | reference / native | same bits |\n|---|---|---|---|")
    good = True
    for preset in PRESETS:
        (one, fast), (other, slow) = (found[name, preset] for name in SOLVERS)
        good &= one == other and slow <= MOST * fast
        print(f"| {preset} | {fast:.3f} | {slow / fast:.2f} | {'yes' if one == other else 'NO'} |")
    sys.exit(not good)


if __name__ == "__main__":
    main()
