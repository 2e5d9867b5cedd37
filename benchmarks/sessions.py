"""Two sessions of one bed, between which stones were moved: are the sessions registered, and the moved stones found?

    python benchmarks/sessions.py [--seeds 1 2 3]

The mockup's bed is driven twice. Between the drives every second stone between 30 and 60 mm is moved by 10 mm, the sun
goes on by 15 degrees, and the second drive begins elsewhere, with another step; so each run has a world frame of its
own. ``rille compare-dem AFTER BEFORE --align place --changes`` is then judged against the exact bed: by how much the
found motion errs (mean over the compared cells, in cells), how many of the sides of moved stones, where the bed rose or
fell and both models know it, are listed, and how many listed patches lie where the bed did not change. Nothing was
chosen with these beds.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import scipy
from scipy.spatial.transform import Rotation

MOVE_M = 0.010
SIZES_M = (0.03, 0.06)
NEAR_M = 0.012
"""Between the middle of what rose or fell at one side of a stone and that of the patch that is listed for it."""

FEWEST = 25
"""Compared cells of a side, a square centimetre: what less of is seen cannot be found."""

CHANGED_M = 0.001
"""Least change of the bed that a patch may be listed for."""

BED: dict[str, Any] = {"frames": 17, "bed_length": 1.6, "bed_width": 1.4}
AFTER: dict[str, Any] = {"sun_azimuth_deg": 15.0, "sideways": 0.012, "forward": 0.032, "frames": 17}
SETTINGS = ("crosscheck.enabled=false", "keyframes.rule=stride", "keyframes.stride=4", "locus.cell_size=0.002")


def moved_stones(seed: int, moves: list[np.ndarray]) -> Any:
    """A stand-in for ``terrain._scattered`` that moves every second stone of the sizes, and lists the moves (4,): x and
    y in the bed before and after, metres."""
    from rille.datasets.mockup import terrain

    original = terrain._scattered

    def scattered(p: Any, area: float) -> Iterator[Any]:
        # Called for the drawn bed and for the exact one: the same moves.
        rng, medium = np.random.default_rng(seed), 0
        for rock in original(p, area):
            if SIZES_M[0] <= rock.diameter < SIZES_M[1]:
                medium += 1
                if medium % 2:
                    way = rng.uniform(0, 2 * np.pi)
                    step = MOVE_M * np.array([np.cos(way), np.sin(way)])
                    shares = [place + step / [p.bed_width, p.bed_length] for place in rock.places]
                    x, y = (next(iter(rock.places)) - [0.5, 1.0]) * [p.bed_width, -p.bed_length]
                    moves.append(np.array([x, y, x + step[0], y - step[1]]))
                    rock = rock._replace(places=shares)
            yield rock

    return scattered


class Session:
    """One drive: the exact ``scene``, the run's ``folder``, and ``T_bed_world`` (4, 4) from its world to the bed."""

    def __init__(self, name: str, place: Path, parameters: dict[str, Any], stones: Any = None) -> None:
        from rille.datasets.mockup import terrain
        from rille.datasets.mockup.params import MockupParams, SceneParams
        from rille.datasets.mockup.scene import build_scene
        from rille.datasets.mockup.sequence import mockup
        from rille.pipeline.commands.sequences.datasets import export_dataset

        p, original = MockupParams(**parameters), terrain._scattered
        given = tuple(f"mockup.{key}={value}" for key, value in parameters.items())
        try:
            terrain._scattered = stones or original
            # A cache of its own: that stones were moved enters no key.
            if not (place / name).exists():
                export_dataset("mockup", place / name, assignments=given, cache=str(place / f"cache-{name}"))
            self.scene = build_scene(p.part(SceneParams))
        finally:
            terrain._scattered = original
        settings = [word for setting in SETTINGS for word in ("--set", setting)]
        rille("reconstruct", place / name, "--quiet", *settings, "--runs", place / "runs", "--cache", place / "cache")
        self.folder = place / "runs" / name / "latest"
        first, pose = np.eye(4), np.eye(4)
        first[:3] = np.reshape(mockup(p).truth[0].to_list(), (3, 4))
        pose[:3] = np.loadtxt(self.folder / "trajectory.kitti")[0].reshape(3, 4)
        self.T_bed_world = first @ np.linalg.inv(pose)

    def heights(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Exact heights of the bed at places of the bed frame, metres; NaN beside it."""
        at = self.scene.meta["lattice"]
        rows, cols = (at["y0"] - y) / at["cell"], (x - at["x0"]) / at["cell"]
        height = np.asarray(self.scene["height"], np.float64)
        return scipy.ndimage.map_coordinates(height, [rows, cols], order=1, cval=np.nan)


def rille(*words: Any) -> None:
    subprocess.run(
        [sys.executable, "-m", "rille.pipeline.cli", *map(str, words)], check=True, stdout=subprocess.DEVNULL
    )


def motion_found(found: dict[str, Any], points: np.ndarray) -> np.ndarray:
    """Points (n, 3) of the later world in that of the earlier one, as the command moved them."""
    turn = np.array(found["place"]["motion_of_a"])
    placed = np.column_stack([points[:, :2] @ turn[:, :2].T + turn[:, 2], points[:, 2]])
    fine, centre = found["alignment"]["motion_of_a"], np.array(found["alignment"]["centre_m"])
    vector = np.radians([fine[f"about_{axis}_deg"] for axis in "xyz"])
    shift = np.array([fine[f"{axis}_m"] for axis in "xyz"])
    return Rotation.from_rotvec(vector).apply(placed - centre) + centre + shift


def judge(seed: int, place: Path) -> str:
    """A line of figures of one bed."""
    moves: list[np.ndarray] = []
    before = Session("before", place, {"seed": seed, **BED})
    after = Session("after", place, {"seed": seed, **BED, **AFTER}, moved_stones(seed, moves))
    rille(
        "compare-dem", "after", "before", "--align", "place", "--changes", "--runs", place / "runs", "-o", place / "is"
    )
    found = json.loads((place / "is.json").read_text())
    with rasterio.open(place / "is.tif") as file:
        known, to_world = np.isfinite(file.read(1)), np.reshape(file.transform[:6], (2, 3))
        cell = abs(file.transform.a)
    with rasterio.open(before.folder / "dem.tif") as file:
        elevation = file.read(1)
    known &= np.isfinite(elevation)

    def in_bed(points: np.ndarray) -> np.ndarray:
        return points @ before.T_bed_world[:3, :3].T + before.T_bed_world[:3, 3]

    # Compared cells, the earlier model's, in the bed, where its world need not be upright; and in the world of
    # the later run, from which the found motion leads back.
    rows, cols = np.nonzero(known)
    xy = np.column_stack([cols + 0.5, rows + 0.5]) @ to_world[:, :2].T + to_world[:, 2]
    ground = np.column_stack([xy, elevation[known]])
    at = in_bed(ground)
    later = np.linalg.inv(after.T_bed_world)
    error = motion_found(found, at @ later[:3, :3].T + later[:3, 3]) - ground
    shift = np.hypot(*error[:, :2].T).mean() / cell

    change = after.heights(*at[:, :2].T) - before.heights(*at[:, :2].T)
    tree = scipy.spatial.cKDTree(at[:, :2])
    patches = found["changes"]["patches"]
    listed = np.array([[p["x_m"], p["y_m"]] for p in patches]).reshape(-1, 2)
    middles = at[scipy.spatial.cKDTree(xy).query(listed)[1], :2]
    volumes = np.array([p["volume_m3"] for p in patches])
    sides, ratios, stones, found_stones = 0, list[float](), 0, 0
    for move in np.unique(moves, axis=0):
        about = tree.query_ball_point(move.reshape(2, 2), 0.5 * SIZES_M[1] + MOVE_M)
        near = np.unique(np.concatenate(about).astype(int))
        known_sides, found_sides = sides, len(ratios)
        for sign in (1, -1):
            part = near[sign * change[near] > CHANGED_M]
            if len(part) < FEWEST:
                continue
            sides += 1
            middle = np.average(at[part, :2], axis=0, weights=np.abs(change[part]))
            fits = (sign * volumes > 0) & (np.hypot(*(middles - middle).T) < NEAR_M)
            if fits.any():
                ratios.append(abs(volumes[fits].sum()) / (np.abs(change[part]).sum() * cell**2))
        stones, found_stones = stones + (sides > known_sides), found_stones + (len(ratios) > found_sides)
    changed = np.abs(change) > CHANGED_M
    false = sum(not changed[tree.query_ball_point(xy, NEAR_M)].any() for xy in middles)
    return (
        f"seed {seed}: registered ({found['place']['by']}) within {shift:.2f} cells of {1e3 * cell:.0f} mm, "
        f"{known.sum()} compared; {found_stones} of {stones} moved stones found, {len(ratios)} of {sides} sides, "
        f"their volumes {np.median(ratios) if ratios else np.nan:.2f} of the exact ones (median); "
        f"{len(patches)} listed, {false} where nothing changed"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=[1, 2, 3])
    parser.add_argument("--keep", type=Path, help="folder for beds and runs, which is kept")
    options = parser.parse_args()
    for seed in options.seeds:
        with tempfile.TemporaryDirectory() as folder:
            print(judge(seed, (options.keep or Path(folder)) / str(seed)), flush=True)


if __name__ == "__main__":
    main()
