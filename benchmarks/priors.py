"""Other sensors beside the camera: what they gain, also over lost pairs, and whether wrong ones are noticed.

    RILLE_DATA=... python benchmarks/priors.py street          the table for the street
    python benchmarks/priors.py mockup --seed 2                for a simulated drive

Sensors are simulated from the truth, which serves nothing else here but judging: GNSS with 0.5 m (of the mockup, which
is 1.4 m long, 5 mm) a coordinate, once a frame, of a frame turned by a radian; dead reckoning with 2 % of the way and
0.3 degrees a metre (mockup: 5 degrees), of each step and of all, in space and, as by wheels, on a plane; the vertical
with 0.5 degrees. Pairs in the middle are lost. Then the sensors are wrong: turned by 10 degrees, with exchanged axes,
0.2 s late, 2 m off over a fifth of the drive or through a wrong lever arm (mockup: 0.2 m).

Thresholds were chosen with chains that ``tests/stages/odometry/test_adjust.py`` simulates and with the mockup; the
street judges. One cache serves all rows: only ``adjust`` runs anew.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np

LOST = (0, 5, 8, 20)
"""Pairs that are lost in the middle."""


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", choices=("street", "mockup"))
    parser.add_argument("--seed", type=int, default=1, help="of the mockup and of the sensors")
    parser.add_argument("--cache", type=Path, help="folder of results to keep")
    parser.add_argument("--lost", type=int, nargs="*", default=LOST, help="numbers of lost pairs")
    return parser.parse_args()


@dataclass(frozen=True)
class Simulated:
    """Sensors of a drive: true poses of the left camera, times, s, and how good the sensors are."""

    truth: list[Any]
    times: np.ndarray
    gnss: float
    turn: float
    seed: int

    def _late(self, late: float) -> list[Any]:
        """True poses of moments that are earlier."""
        from rille.stages.geometry.geometry import RigidTransform
        from rille.stages.odometry.resection.sensors import resampled

        poses = resampled(np.array([T.matrix34 for T in self.truth]), self.times, -late)
        return [RigidTransform.from_matrix(T) if np.isfinite(T).all() else None for T in poses]

    def odometry(self, late: float = 0.0, mount: Any = None) -> dict[str, Any]:
        """Dead reckoning, as fields of a sequence; ``mount``: a matrix (3, 3) that its axes are changed by."""
        from rille.stages.geometry.geometry import RigidTransform, rotation_exp

        rng = np.random.default_rng(self.seed)
        scale, drift = 0.02 * rng.standard_normal(), self.turn * rng.standard_normal(3)
        poses, last, now = list[Any](), None, RigidTransform.identity()
        for true in self._late(late):
            if true is not None and last is not None:
                step = last.inverse() @ true
                way = float(np.linalg.norm(step.translation))
                turned = rotation_exp(way * (drift + self.turn * rng.standard_normal(3)))
                off = scale * step.translation + 0.02 * way * rng.standard_normal(3)
                now = now @ RigidTransform(step.rotation @ turned, step.translation + off)
            last = true
            poses.append(None if true is None else now)
        if mount is not None:
            M = np.array(mount)
            poses = [T and RigidTransform(M.T @ T.rotation @ M, M.T @ T.translation) for T in poses]
        return {"odometry": tuple(poses), "priors": {"odometry": {"drift": 0.02, "turn": self.turn}}}

    def wheels(self) -> dict[str, Any]:
        """Dead reckoning on a plane, which knows neither slopes nor tilts, of a body in the camera's place."""
        from rille.stages.geometry.geometry import RigidTransform, rotation_exp, rotation_log

        up = self.truth[0].rotation.T @ self.up(0)
        ahead = np.array([0.0, 0.0, 1.0]) - up[2] * up
        ahead /= np.linalg.norm(ahead)
        T_body_left = RigidTransform(np.array([ahead, np.cross(up, ahead), up]), np.zeros(3))
        body, rng = [T @ T_body_left.inverse() for T in self.truth], np.random.default_rng(self.seed)
        scale, drift, now = 0.02 * rng.standard_normal(), self.turn * rng.standard_normal(), RigidTransform.identity()
        poses = [now @ T_body_left]
        for a, b in pairwise(body):
            step = a.inverse() @ b
            way = float(np.linalg.norm(step.translation))
            off = (1.0 + scale) * step.translation + 0.02 * way * rng.standard_normal(3)
            heading = rotation_log(step.rotation)[2] + way * (drift + self.turn * rng.standard_normal())
            now = now @ RigidTransform(rotation_exp([0.0, 0.0, heading]), off * [1.0, 1.0, 0.0])
            poses.append(now @ T_body_left)
        stated = {"drift": 0.02, "turn": self.turn, "up": up.tolist(), "origin": [0.0, 0.0, 0.0]}
        return {"odometry": tuple(poses), "priors": {"odometry": stated}}

    def positions(
        self, late: float = 0.0, lever: float = 0.0, jump: float = 0.0, mirrored: bool = False
    ) -> dict[str, Any]:
        """GNSS, as fields of a sequence; ``lever``, m, is its arm to the right that nobody states."""
        from rille.stages.geometry.geometry import rotation_exp

        rng = np.random.default_rng(self.seed)
        there = [T and T.translation + T.rotation @ [lever, 0.0, 0.0] for T in self._late(late)]
        rows = [k for k, place in enumerate(there) if place is not None]
        # The true frame's z need not be up: the street's is a camera's.
        up = np.array([self.up(k) for k in range(len(self.truth))]).mean(0)
        axis = np.cross(up, [0.0, 0.0, 1.0])
        upright = rotation_exp(axis / max(np.linalg.norm(axis), 1e-12) * np.arccos(np.clip(up[2], -1.0, 1.0)))
        points = np.array([there[k] for k in rows]) @ (rotation_exp([0.0, 0.0, 1.0]) @ upright).T
        points += self.gnss * rng.standard_normal(points.shape)
        points[2 * len(rows) // 5 : 3 * len(rows) // 5, 0] += jump
        points = points[:, [1, 0, 2]] if mirrored else points
        given = {"positions": points.tolist(), "times": self.times[rows].tolist(), "sigma": [self.gnss] * 3}
        return {"priors": {"positions": {**given, "lever": [0.0, 0.0, 0.0]}}}

    def up(self, frame: int) -> np.ndarray:
        """Up in the true frame: that of the first camera of the street, which is level to a degree."""
        R = self.truth[0].rotation
        return np.array([0.0, 0.0, 1.0]) if abs(R[2, 2]) < 0.9 else R @ [0.0, -1.0, 0.0]


def solved(sequence: Any, frames: tuple[int, ...], cache: Path) -> Any:
    """The trajectory of a sequence, without elevation models; None where there is none."""
    from gaps import trajectory_of

    return trajectory_of(sequence, frames, cache, {"keyframes": {"preset": "navigation"}})


def judged(found: Any, truth: list[Any]) -> str:
    """Errors of a trajectory against truth, laid on each other at the first frame, and its covariances."""
    from rille.stages.geometry.geometry import RigidTransform, rotation_log
    from rille.stages.odometry.resection.trajectory import world_poses

    poses, covariance = world_poses(found), np.asarray(found["covariance"])
    rows = np.flatnonzero(np.isfinite(poses).all((1, 2)))
    first = RigidTransform.from_matrix(poses[rows[0]]) @ truth[rows[0]].inverse()
    errors, steps = [], []
    for k, row in enumerate(rows):
        true = first @ truth[row]
        errors.append([*(poses[row, :, 3] - true.translation), *rotation_log(poses[row, :, :3] @ true.rotation.T)])
        if k and rows[k - 1] == row - 1:
            own = poses[row - 1, :, :3].T @ (poses[row, :, 3] - poses[row - 1, :, 3])
            steps.append(np.linalg.norm(own - (truth[row - 1].inverse() @ truth[row]).translation))
    e = np.array(errors)
    way = float(np.linalg.norm(np.diff([T.translation for T in truth[rows[0] : rows[-1] + 1]], axis=0), axis=1).sum())
    nees = np.mean([x @ np.linalg.solve(covariance[r], x) for x, r in zip(e[1:], rows[1:], strict=True)]) / 6
    away = np.linalg.norm(e[:, :3], axis=1)
    return (
        f"{len(found.meta['pieces'])} pieces, {len(rows):2d} frames, drift {100 * away[-1] / way:6.2f} %, RMS "
        f"{np.sqrt((away**2).mean()):8.4f} m, one frame {1000 * np.mean(steps):7.3f} mm, NEES {nees:8.2f}, "
        f"excess {found.meta.get('excess', 1.0):2.0f}"
    )


def cases(sensors: Simulated, off: float) -> dict[str, Callable[[], dict[str, Any]]]:
    """Sensors by name; ``off``, m, is how far positions are wrong."""
    from rille.stages.geometry.geometry import rotation_exp

    turned, swapped = rotation_exp([0.0, np.deg2rad(10.0), 0.0]), [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    return {
        "odometry": sensors.odometry,
        "wheels": sensors.wheels,
        "GNSS": sensors.positions,
        "wrong: odometry 10 degrees": lambda: sensors.odometry(mount=turned),
        "wrong: odometry x, y exchanged": lambda: sensors.odometry(mount=swapped),
        "wrong: odometry z, x, y": lambda: sensors.odometry(mount=np.roll(np.eye(3), 1, 0)),
        "wrong: odometry 0.2 s": lambda: sensors.odometry(late=0.2),
        "wrong: GNSS x, y exchanged": lambda: sensors.positions(mirrored=True),
        "wrong: GNSS 0.2 s": lambda: sensors.positions(late=0.2),
        f"wrong: GNSS {off:g} m, a fifth": lambda: sensors.positions(jump=off),
        f"wrong: GNSS lever arm {off:g} m": lambda: sensors.positions(lever=off),
    }


def main() -> int:
    from rille.datasets.registry import open_sequence
    from rille.pipeline.engine.runtime.environment import prepare_environment

    given = arguments()
    prepare_environment()
    if given.sequence == "street":
        sequence = open_sequence(str(Path(os.environ["RILLE_DATA"]) / "kitti06_51"))
        quality, off = (0.5, np.deg2rad(0.3)), 2.0
    else:
        settings = {"frames": 31, "image_width": 285, "image_height": 260, "focal_length": 300, "seed": given.seed}
        sequence = open_sequence("mockup", {"mockup": settings | {"jitter_deg": 4.0}})
        quality, off = (0.005, np.deg2rad(5.0)), 0.2
    truth, frames = list(sequence.truth), tuple(range(sequence.frames))
    times = np.array(sequence.times if sequence.times is not None else 0.1 * np.arange(sequence.frames))
    sequence = replace(sequence, times=tuple(times.tolist()))
    sensors = Simulated(truth, times, *quality, given.seed)
    with tempfile.TemporaryDirectory(prefix="priors-cache-") as scratch:
        cache = given.cache or Path(scratch)
        for count in given.lost:
            first = (sequence.frames - count) // 2
            lost = dict.fromkeys(range(first, first + count), "simulated")
            here = replace(sequence, lost=lost)
            rows: dict[str, Callable[[], dict[str, Any]]] = {"camera alone": dict}
            for name, make in (rows | cases(sensors, off)).items():
                if name.startswith("wrong") and count:
                    continue
                found = solved(replace(here, **make()), frames, cache)
                print(f"{count:2d} lost, {name:32s} {judged(found, truth)}", flush=True)
                for line in found.meta["warnings"] if found is not None else ():
                    if line.startswith("["):
                        print(f"    {line}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
