"""Lost frames: is a trajectory that bridges them right within its stated sigmas, or broken and said to be?

    RILLE_DATA=... python benchmarks/gaps.py                     the table, for ten places on the street
    RILLE_DATA=... python benchmarks/gaps.py --gap 5 --place 10  one of them

Of ``kitti06_51``, 1, 2, 3, 5 and 8 pairs in a row are black, or ten have their sides exchanged, at ten places each.
Each case is a window of frames with three good ones on either side, from images to trajectory. The error over it is
the distance between the true and the found position of the first frame behind it, in the camera frame of the last one
before; the stated sigma is the root of what the position's covariance grows by over it. Rules of acceptance were chosen
with the first, third ... place (``chosen``); the others judge (``judged``).
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

GAPS = (1, 2, 3, 5, 8)
SWAPPED = 10
PLACES = range(4, 41, 4)
"""First lost frame."""

GOOD = 3
"""Frames before and behind a gap."""

TOLERATED = 3.0
"""Stated sigmas within which a bridge is right."""


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gap", type=int, help="black pairs in a row; 0: ten exchanged ones (default: all)")
    parser.add_argument("--place", type=int, help="first lost frame (default: all)")
    return parser.parse_args()


def spoil(good: Path, folder: Path, first: int, gap: int) -> int:
    """Copy a sequence with ``gap`` black pairs, or ten exchanged ones (0), from a frame on; how many are spoilt."""
    import cv2

    shutil.copytree(good, folder, copy_function=shutil.copyfile)
    folder.chmod(0o755)
    for side in ("image_l", "image_r"):
        (folder / side).chmod(0o755)
    count = gap or SWAPPED
    for frame in range(first, first + count):
        left, right = (folder / side / f"{frame:06d}.png" for side in ("image_l", "image_r"))
        if gap:
            for path in (left, right):
                cv2.imwrite(str(path), np.zeros_like(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)))
        else:
            kept = left.read_bytes()
            left.write_bytes(right.read_bytes())
            right.write_bytes(kept)
    return count


def trajectory_of(sequence: Any, frames: tuple[int, ...], cache: Path, settings: dict[str, Any] | None = None) -> Any:
    """The trajectory of some frames of a sequence, without elevation models; None where there is none."""
    from rille.pipeline.engine.graph import Graph, Handle
    from rille.pipeline.engine.run import RunOptions, run
    from rille.pipeline.engine.store.base import Store
    from rille.pipeline.flow import config
    from rille.pipeline.flow.closed_loop import dataflow

    class Odometry(Graph):
        """Leaves out elevation models, truth, and what would follow from them."""

        def node(self, stage: Any, *args: Any, **more: Any) -> Handle:  # type: ignore[override]
            handle = super().node(stage, *args, **more)
            if handle.stage in ("locus", "accuracy") or any(h not in self.nodes for h in handle.upstream()):
                self.nodes.remove(handle)
            return handle

    graph, store = Odometry(), Store(cache)
    chosen = config.build({"crosscheck": {"enabled": False}, **(settings or {})})
    products, _ = dataflow(graph, sequence, chosen, frames)
    run(graph, store, RunOptions(executor="inline"))
    handle = products.trajectory
    return None if handle is None or handle.ref is None else store.open(handle.ref)


def judge(found: Any, truth: Any, before: int, behind: int, first: int) -> dict[str, Any]:
    """What became of a bridge: ``error`` and ``sigma`` in metres, or in how many ``pieces`` the trajectory is."""
    pieces = len(found.meta["pieces"])
    a, b = before - first, behind - first
    piece = np.asarray(found["piece"])
    if piece[a] < 0 or piece[a] != piece[b]:
        return {"pieces": pieces}
    poses, covariance = (np.asarray(found[name], np.float64) for name in ("poses", "covariance"))
    step = poses[a, :, :3].T @ (poses[b, :, 3] - poses[a, :, 3])
    true = truth[before, :, :3].T @ (truth[behind, :, 3] - truth[before, :, 3])
    grown = np.trace(covariance[b, :3, :3]) - np.trace(covariance[a, :3, :3])
    return {"error": float(np.linalg.norm(step - true)), "sigma": float(np.sqrt(max(grown, 1e-12))), "pieces": pieces}


def case(good: Path, truth: Any, gap: int, place: int, cache: Path) -> dict[str, Any]:
    """One row."""
    from rille.datasets.registry import open_sequence

    with tempfile.TemporaryDirectory(prefix="gaps-") as scratch:
        folder = Path(scratch) / "street"
        behind = place + spoil(good, folder, place, gap)
        frames = tuple(range(place - GOOD, behind + GOOD))
        found = trajectory_of(open_sequence(str(folder)), frames, cache)
        return {"pieces": 0} if found is None else judge(found, truth, place - 1, behind, frames[0])


def words(row: dict[str, Any]) -> str:
    if "error" not in row:
        return f"{row['pieces']} pieces" if row["pieces"] else "no trajectory"
    ratio = row["error"] / row["sigma"]
    return f"{row['error']:.3f} m, {ratio:.1f} sigma" + (" WRONG" if ratio > TOLERATED else "")


def main() -> int:
    import os

    from rille.pipeline.engine.runtime.environment import prepare_environment

    given = arguments()
    prepare_environment()
    good = Path(os.environ["RILLE_DATA"]) / "kitti06_51"
    truth = np.loadtxt(good / "poses.txt").reshape(-1, 3, 4)
    wrong, tried = {"chosen": 0, "judged": 0}, {"chosen": 0, "judged": 0}
    with tempfile.TemporaryDirectory(prefix="gaps-cache-") as cache:
        for gap in (*GAPS, 0) if given.gap is None else (given.gap,):
            last = len(truth) - GOOD - (gap or SWAPPED)
            for number, place in enumerate(PLACES):
                if given.place not in (None, place) or place > last:
                    continue
                row = case(good, truth, gap, place, Path(cache))
                half = "judged" if number % 2 else "chosen"
                tried[half] += 1
                wrong[half] += "WRONG" in words(row)
                what = f"{gap} black" if gap else f"{SWAPPED} exchanged"
                print(f"{what:13s} from {place:2d}  {half}  {words(row)}", flush=True)
    for half, count in tried.items():
        print(f"{half}: {wrong[half]} of {count} wrong and not said to be")
    return int(any(wrong.values()))


if __name__ == "__main__":
    sys.exit(main())
