"""Navigation side by side, in one process: Rille in its presets, a plain OpenCV odometry, and COLMAP.

Without arguments: the street ``kitti06_51`` where RILLE_DATA has it, and the short mockup. Any sequence with truth can
be named. All get the same decoded images, one thread and the given calibration. Rille runs the stages that a trajectory
needs (its tracking is all but those of the basic pairs), as for terrain, and with the preset ``navigation``; OpenCV's
odometry goes from frame to frame: semi-global depth, corners, Lucas-Kanade there and back, PnP; COLMAP is the project's
cross-check. Whoever needs rectified or undistorted images pays for making them; reading files is left out for all.
The second table holds Rille's figures against what it is held to, by the other methods of the same run.

Times are of the least of the rounds, which alternate; the first round, which compiles, is not counted. Milliseconds a
frame are all work divided by all frames, so the matching of basic pairs is shared out. COLMAP, by far the slowest, has
one round.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from functools import partial
from pathlib import Path
from typing import Any

HEADINGS = (
    "method",
    "lost",
    "one frame, mm",
    "drift, %",
    "RMSE 20 frames, mm",
    "RMSE, mm",
    "NEES",
    "NEES, mount left out",
    "ms a frame",
    "of processor",
    "tracking",
    "matching",
    "ratio",
)
PRESETS = {"default": [], "navigation": ["keyframes.preset=navigation"]}


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="*", help="names, folders or manifests with truth")
    parser.add_argument("--first", type=int, default=0, help="frame to begin with")
    parser.add_argument("--frames", type=int, help="so many frames only")
    parser.add_argument("--rounds", type=int, default=2, help="timed rounds (default 2)")
    parser.add_argument("--preset", action="append", choices=list(PRESETS), help="may be repeated (default: all)")
    parser.add_argument("--no-colmap", action="store_true", help="leave out COLMAP, which takes minutes")
    parser.add_argument("--set", action="append", default=[], help="a parameter, section.key=value, of Rille's runs")
    parser.add_argument("--json", type=Path, help="write all figures there")
    given = parser.parse_args()
    if given.rounds < 1:
        parser.error("--rounds is at least 1")
    return given


def start_process() -> None:
    """Place of compiled kernels, and one thread each, before NumPy and numba are imported."""
    from rille.pipeline.engine.runtime.environment import SINGLE, prepare_environment

    prepare_environment()
    os.environ.update({f"{name}_NUM_THREADS": "1" for name in SINGLE})
    os.environ["OPENCV_FOR_THREADS_NUM"] = "1"


def say(text: str) -> None:
    print(f"... {text}", file=sys.stderr, flush=True)


def by_default() -> list[str]:
    street = Path(os.environ.get("RILLE_DATA") or "-") / "kitti06_51"
    if not street.is_dir():
        print("RILLE_DATA does not name a folder with kitti06_51: the street is left out")
    return [*([str(street)] if street.is_dir() else []), "mockup-short"]


def compare(name: str, given: argparse.Namespace) -> list[dict[str, Any]]:
    """Figures of every method on one sequence."""
    from odometry import chain, colmap, opencv
    from odometry.measures import claims, judge

    from rille.datasets.registry import open_sequence
    from rille.pipeline.flow import config as configuration

    overrides, _ = configuration.split_dataset(configuration.parse_assignments(given.set))
    sequence = open_sequence(name, overrides)
    if sequence.truth is None:
        raise SystemExit(f"navigation.py: {name} has no truth to be judged by")
    say(f"{name}: images")
    images = chain.Images(
        sequence, range(given.first, min(given.first + (given.frames or sequence.frames), sequence.frames))
    )
    truth = chain.truth(images)

    def rille(preset: str) -> Any:
        return chain.Chain(images, chain.settings(sequence, [*PRESETS[preset], *given.set])).run()

    methods: list[tuple[str, Any, int]] = [("OpenCV odometry", lambda: opencv.Odometry(images).run(), given.rounds)]
    for preset in given.preset or PRESETS:
        methods += [(f"Rille {preset}", partial(rille, preset), given.rounds)]
    if not given.no_colmap:
        methods.append(("COLMAP", lambda: colmap.run(images, chain.settings(sequence, given.set)), 0))
    found: dict[str, dict[str, Any]] = {}
    for number in range(given.rounds + 1):
        for method, run, rounds in methods:
            if number > rounds:
                continue
            say(f"{name}: {method}, round {number}")
            done = run()
            figures = chain.times(done, len(images.frames))
            old = found.get(method)
            if old is None or number == 1 or figures["processor"] < old["processor"]:
                figures |= judge(done.poses, truth)
                if done.covariance is not None:
                    figures |= claims(done.poses, done.covariance, truth)
                found[method] = {"sequence": name, "method": method, **figures}
    return list(found.values())


def table(name: str, frames: int, found: list[dict[str, Any]]) -> None:
    from odometry.limits import lines

    print(f"\n{name}, {frames} frames, one thread each\n")
    print("| " + " | ".join(HEADINGS) + " |")
    print("|---" * len(HEADINGS) + "|")
    for f in found:
        lengths = [1e3 * f["one_frame"], f["drift"], 1e3 * f["rmse_first"], 1e3 * f["rmse"]]
        shown = [f"{v:.3g}" for v in [*lengths, f.get("nees", math.nan), f.get("nees_mounted", math.nan)]]
        shown += [f"{f[key]:.0f}" for key in ("wall", "processor", "tracking", "matching")]
        print(
            f"| {f['method']} | {f['lost']:.0f} | {' | '.join(shown)} | {f['processor'] / found[0]['processor']:.2f} |"
        )
    print("\nratio: of processor time a frame to that of the first row; tracking and matching are processor time, too")
    print("\n| line | figure | limit | |\n|---|---|---|---|")
    for line in lines(name, found):
        print(f"| {line.what} | {line.figure:.3g} | {line.limit:.3g} | {'kept' if line.kept else 'not kept'} |")


def main() -> None:
    given = arguments()
    start_process()
    import cv2

    from rille.stages.core.errors import RilleError

    cv2.setNumThreads(1)
    everything = []
    try:
        for name in given.sequences or by_default():
            found = compare(name, given)
            table(name, int(found[0]["frames"]), found)
            everything += found
    except (RilleError, OSError) as error:
        raise SystemExit(f"navigation.py: {' '.join(str(error).split())}") from None
    if given.json:
        given.json.write_text(json.dumps(everything, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
