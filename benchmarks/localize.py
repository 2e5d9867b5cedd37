"""Localisation of single stops in coarse maps: right, wrong, and ambiguous places, with errors and claimed deviations.

``python benchmarks/localize.py [--seeds 4:9] [--ratios 10 20] [--stops FOLDER]``

A stop is the elevation model of one pair of the mockup; every fifth frame of a bed is one. The map is the exact
elevation of the bed, averaged to so many times wider cells, with errors of 2 mm. The search reaches 2 m and 10 degrees
around a start that is off by up to as much. A place is right within two cells of the map and 2 degrees. Then the same
stops are sought in the map of another bed, where each answer is wrong that is not refused or called ambiguous.

Thresholds were chosen on seeds 1 to 3; the default seeds judge. FOLDER keeps the elevation models.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

import rille
from rille.datasets.mockup import sequence
from rille.datasets.mockup.params import MockupParams, SceneParams
from rille.datasets.mockup.scene import build_scene
from rille.stages.core.errors import RilleError
from rille.stages.geometry.geometry import RigidTransform, from_above, rotation_exp, rotation_log
from rille.stages.geometry.lattice import Lattice
from rille.stages.terrain.map_localization import MapLocalizationParams, Placement, SearchArea, fix
from rille.stages.terrain.relief.grid import Grid

STEP, CELL, ERROR_M = 5, 0.001, 0.002
DISTANCE_M, TURN = 2.0, math.radians(10.0)
KEPT = [0, 1, 2, 5]
"""Of position and rotation: the tilt of the model is no part of the place."""


class Stop(NamedTuple):
    """Elevation model of a pair, and the true pose of its origin on the bed."""

    model: Grid
    pose: RigidTransform


def stop(seed: int, frame: int, folder: Path | None) -> Stop:
    """A stop, from ``folder`` where it is there."""
    path = None if folder is None else folder / f"{seed}_{frame}.npz"
    if path is not None and path.exists():
        kept = np.load(path)
        x, y, z = kept["x"], kept["y"], kept["z"]
    else:
        pair = rille.open("mockup", mockup={"seed": seed})[frame]
        dem = rille.terrain(rille.match(pair.left, pair.right), pair, cell_size=CELL)
        x, y, z = dem.x.values, dem.y.values, dem.elevation.values
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez(path, x=x, y=y, z=z)
    p = MockupParams(seed=seed)
    camera = sequence.body_poses(p)[frame] @ sequence.mount(p, "left")
    # Level: x to the right and y along the optical axis, seen from above.
    ahead = camera.rotation[:, 2]
    turn = rotation_exp([0.0, 0.0, math.atan2(-ahead[0], ahead[1])])
    return Stop(Grid.on(Lattice(float(x[0]), float(y[0]), CELL, *z.shape), z), RigidTransform(turn, camera.translation))


def bed_map(seed: int, ratio: int) -> Grid:
    """The exact elevation of a bed in so many times wider cells, with errors."""
    p = MockupParams(seed=seed)
    scene = build_scene(p.part(SceneParams))
    z, at = np.asarray(scene["height"], np.float64), scene.meta["lattice"]
    rows, cols = (n // ratio for n in z.shape)
    mean = z[: rows * ratio, : cols * ratio].reshape(rows, ratio, cols, ratio).mean(axis=(1, 3))
    mean += ERROR_M * np.random.default_rng([seed, ratio]).standard_normal(mean.shape)
    half, cell = 0.5 * (ratio - 1) * at["cell"], ratio * at["cell"]
    return Grid(mean, np.array([[cell, 0.0, at["x0"] + half], [0.0, -cell, at["y0"] - half]]))


def sought(one: Stop, ground: Grid, rng: np.random.Generator) -> tuple[Placement | None, float]:
    """The place of a stop, None where it is refused, and processor seconds."""
    x, y, heading = from_above(one.pose)
    far, way = DISTANCE_M * math.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * math.pi)
    start = x + far * math.cos(way), y + far * math.sin(way), heading + TURN * rng.uniform(-1.0, 1.0)
    around = SearchArea(*start, DISTANCE_M, TURN)
    begin = time.process_time()
    try:
        found = fix(one.model, ground, around, MapLocalizationParams())
    except RilleError:
        found = None
    return found, time.process_time() - begin


def rows(seeds: range, ratio: int, folder: Path | None, elsewhere: bool) -> Iterator[dict[str, float]]:
    """Figures of each stop."""
    for seed in seeds:
        ground = bed_map(seed + 1000 if elsewhere else seed, ratio)
        for frame in range(0, MockupParams().frames, STEP):
            one = stop(seed, frame, folder)
            found, seconds = sought(one, ground, np.random.default_rng([seed, frame]))
            row = {"seconds": seconds, "answer": float(found is not None and not found.doubt)}
            if found is not None:
                turned = rotation_log(found.pose.rotation @ one.pose.rotation.T)
                error = np.concatenate([found.pose.translation - one.pose.translation, turned])[KEPT]
                row |= {"error": float(np.hypot(*error[:2])), "yaw": abs(math.degrees(error[3]))}
                row["nees"] = float(error @ np.linalg.solve(found.covariance[np.ix_(KEPT, KEPT)], error))
                row["chi2"] = found.figures["other"]["chi2"] if "other" in found.figures else math.inf
                row["right"] = float(row["error"] < 2.0 * ground.cell and row["yaw"] < 2.0)
            yield row


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="4:9", help="of beds, FIRST:END (default 4:9)")
    parser.add_argument("--ratios", type=int, nargs="+", default=[10, 20], help="of the map's cells to the run's")
    parser.add_argument("--stops", type=Path, help="folder that keeps the elevation models")
    given = parser.parse_args()
    seeds = range(*map(int, given.seeds.split(":")))
    print("| map | stops | right | wrong | no answer | error mm | yaw deg | NEES of 4 | chi2 | s |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for elsewhere in (False, True):
        for ratio in given.ratios:
            found = list(rows(seeds, ratio, given.stops, elsewhere))
            answers = [row for row in found if row["answer"]]
            right = [row for row in answers if row["right"]]
            fits = [row for row in found if "error" in row]

            def spread(key: str, of: list[dict[str, float]]) -> str:
                values = [row[key] for row in of]
                return f"{np.median(values):.3g}, {max(values):.3g}" if values else "-"

            for row in right:
                row["error"] *= 1e3
            limit = (max if elsewhere else min)((row["chi2"] for row in fits), default=math.nan)
            nees = f"{np.mean([row['nees'] for row in right]):.1f}" if right else "-"
            print(
                f"| {'another bed, ' if elsewhere else ''}{ratio} x | {len(found)} | {len(right)} | "
                f"{len(answers) - len(right)} | {len(found) - len(answers)} | {spread('error', right)} | "
                f"{spread('yaw', right)} | {nees} | {'<=' if elsewhere else '>='} {limit:.0f} | "
                f"{spread('seconds', found)} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
