"""Planted errors: which of them the cross-check with COLMAP shows, and what it says where there is none.

    RILLE_DATA=... python benchmarks/planted.py [SEQUENCE] [--frames 20]

The street ``kitti06_51`` where RILLE_DATA has it, or the short mockup; any sequence with truth can be named. COLMAP's
trajectory is compared with the true one as a run compares it with its own. Errors are planted on either side: in the
true trajectory (its scale, the pose of one frame, the heading from a frame on), in the rig that COLMAP is given, and in
the images that it sees (those of one frame shifted, the right ones shifted from a frame on). Columns: frames that are
flagged, and how far both are apart by position, by motion from frame to frame, and in scale.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

COLUMNS = ("planted", "flagged frames", "positions, mm", "motion, mm", "motion, degrees", "scale", "posed")
SHIFT = 6
"""Pixels that images are shifted by."""
SCALE, BASELINE = 1.02, 1.05
TURN_DEG = 0.5
"""Of the rig, or of the heading."""
JUMP = 0.1
"""Share of the mean motion between frames by which one frame's pose is put aside along each axis."""


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", nargs="?", help="name, folder or manifest with truth")
    parser.add_argument("--frames", type=int, default=20, help="the first so many frames (default 20)")
    return parser.parse_args()


def shifted(bundle: Any) -> Any:
    """An image and its mask, moved by :data:`SHIFT` columns and rows."""
    import numpy as np

    return replace(bundle, arrays={n: np.roll(bundle[n], (SHIFT, SHIFT), (0, 1)) for n in ("image", "valid")})


def cases(sequence: str, count: int) -> Iterator[tuple[str, Any, Any]]:
    """Name of each case, our trajectory (frame, 3, 4) and COLMAP's joined one."""
    import numpy as np
    from odometry import colmap
    from odometry.chain import Clock, Images, settings

    from rille.datasets.registry import open_sequence
    from rille.stages.geometry.geometry import Rig, RigidTransform, rotation_exp

    opened = open_sequence(sequence)
    images, config, clock = Images(opened, range(min(count, opened.frames))), settings(opened, []), Clock()
    true = np.array([opened.truth[f].matrix34 for f in images.frames])
    middle = len(true) // 2
    seen = colmap.features(images, clock)

    def check(rig: Rig, seen: Any = seen) -> Any:
        return colmap.joined(seen, rig, config, clock)[0]

    right = check(opened.rig)
    yield "nothing", true, right
    larger = true.copy()
    larger[:, :, 3] *= SCALE
    yield f"scale of ours {SCALE:g}", larger, right
    aside = true.copy()
    aside[middle, :, 3] += JUMP * np.linalg.norm(np.diff(true[:, :, 3], axis=0), axis=1).mean() * np.ones(3)
    yield f"one frame of ours aside ({images.frames[middle]})", aside, right
    turn = RigidTransform(rotation_exp([0.0, np.radians(TURN_DEG), 0.0]), np.zeros(3))
    poses = [RigidTransform.from_matrix(T) for T in true]
    behind = [T if k < middle else poses[middle] @ turn @ poses[middle].inverse() @ T for k, T in enumerate(poses)]
    yield f"heading of ours, from {images.frames[middle]} on", np.array([T.matrix34 for T in behind]), right

    T = opened.rig.T_right_left
    yield (
        f"baseline {BASELINE:g}",
        true,
        check(replace(opened.rig, T_right_left=replace(T, translation=BASELINE * T.translation))),
    )
    for axis, name in enumerate(("pitch", "yaw", "roll")):
        wrong = RigidTransform(rotation_exp(np.radians(TURN_DEG) * np.eye(3)[axis]), np.zeros(3)) @ T
        yield f"rig's {name} {TURN_DEG:g} degrees", true, check(replace(opened.rig, T_right_left=wrong))

    def moved(change: Callable[[int, str], bool]) -> Any:
        some = {key: key for key in images.bundle if change(*key)}
        kept = images.bundle
        images.bundle = {key: shifted(b) if key in some else b for key, b in kept.items()}
        found = colmap.features(images, clock)
        images.bundle = kept
        return found

    yield f"images of {images.frames[middle]} shifted", true, check(opened.rig, moved(lambda f, c: f == middle))
    yield (
        f"right image of {images.frames[middle]} shifted",
        true,
        check(opened.rig, moved(lambda f, c: (f, c) == (middle, "right"))),
    )
    yield (
        f"right images shifted from {images.frames[middle]} on",
        true,
        check(opened.rig, moved(lambda f, c: f >= middle and c == "right")),
    )


def row(name: str, ours: Any, theirs: Any) -> list[str]:
    import numpy as np
    from odometry.chain import STAGES

    from rille.stages.core.declare import Bundle

    stage = STAGES["agreement"]
    trajectory = Bundle({"poses": ours}, {"frames": theirs.meta["frames"]})
    facts = stage.run(stage.params(), {}, {"trajectory": trajectory, "crosscheck": theirs}).meta
    # Too few frames leave figures undefined.
    value = {name: float(np.nan if m["value"] is None else m["value"]) for name, m in facts["metrics"].items()}
    flagged = " ".join(str(item["frame"]) for item in facts["flagged"]) or "-"
    figures = (1e3 * value["rmse"], 1e3 * value["step_rmse"], value["step_rmse_rotation"], value["scale_ratio"])
    return [name, flagged, *(f"{figure:.3g}" for figure in figures[:3]), f"{figures[3]:.4f}", str(facts["compared"])]


def main() -> None:
    given = arguments()
    from rille.pipeline.engine.runtime.environment import SINGLE, prepare_environment

    prepare_environment()
    os.environ.update({f"{name}_NUM_THREADS": "1" for name in SINGLE})
    street = Path(os.environ.get("RILLE_DATA") or "-") / "kitti06_51"
    sequence = given.sequence or (str(street) if street.is_dir() else "mockup-short")
    print(f"{Path(sequence).name}, the first {given.frames} frames\n")
    print("| " + " | ".join(COLUMNS) + " |")
    print("|---" * len(COLUMNS) + "|", flush=True)
    for case in cases(sequence, given.frames):
        print("| " + " | ".join(row(*case)) + " |", flush=True)


if __name__ == "__main__":
    main()
