"""Hazards judged against the exact elevations: false safe, false hazard, unknown, and whether p_hazard is a
probability.

python benchmarks/hazards.py [--seeds 20] [--cover 0.05 0.1 0.2] [--preset default] [--scenes FOLDER]
                             [--json FILE] [--picture FILE]

Each scene is one simulated stereo pair: a seed, a rock cover and one of the slopes, which take turns. Every way to
classes is judged cell by cell against the risk map of the exact elevations with the same vehicle and no standard
deviation:

* rille: matched and reconstructed as a run does with this ``terrain.preset``, judged with default parameters; the
  inclinometer errs by 0.2 degrees about each axis;
* perfect pose: the same with the exact vertical;
* perfect DEM: exact elevations on the cells that it has, with no standard deviation: what the ragged map alone costs;
* SGBM + blend: OpenCV's rectification and semi-global matching, median height of a cell's points, and the usual blend
  of slope and roughness, (slope / limit + roughness / limit + step / limit) / 3 of a plane fitted in the vehicle's
  size, hazardous where it exceeds 0.5 (as traversability maps do); no standard deviation, unknown where nothing is
  known.

'false safe' are truly hazardous cells called safe, 'enterable hazard' those called safe or caution, 'false hazard'
cells called hazard that are not: shares of the observed cells, those that are not unknown, with Wilson's 95 % interval
over scenes' cells thinned to one a vehicle length (cells are not independent). 'missed' is the share of the truly
hazardous cells that are called safe or caution.

Of each scene a path is planned on the map of 'rille' and on that of 'perfect DEM', over as many rows as are connected,
and compared with the shortest way between its ends on the map of the exact elevations, where all is known.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from driving.ratios import HEADINGS, Ratios, wilson
from matching import say, start_process, table

SLOPES = (0.0, 5.0, 10.0, -5.0)
EDGES = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0)
COUNTS = ("all", "observed", "truly hazardous", "safe", "caution", "false safe", "enterable hazard", "false hazard")
PLANNED = ("rille", "perfect DEM")
GOALS = {"false safe": 0.002, "false hazard": 0.05}


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="scenes of each cover (default 20)")
    parser.add_argument("--first", type=int, default=1, help="first seed (default 1; 101 to 106 set the constants)")
    parser.add_argument("--cover", type=float, nargs="+", default=[0.05, 0.1, 0.2], help="rock covers")
    parser.add_argument("--preset", choices=("default", "accurate"), default="default", help="of the terrain")
    parser.add_argument("--scenes", type=Path, help="keep simulated pairs there, so that a run that ended goes on")
    parser.add_argument("--json", type=Path, help="write all figures there, by scene")
    parser.add_argument("--picture", type=Path, help="draw the curve of p_hazard there, e.g. docs/hazards.png")
    return parser.parse_args()


def judge(scene: Any, exact: Any, found: Any) -> dict[str, Any]:
    """Counts of cells, and of p_hazard's bins: how many, their mean probability and how many are truly hazardous."""
    import numpy as np

    from rille.stages.hazard.risk import CAUTION, HAZARDOUS, SAFE, UNKNOWN

    risk, truth = found["risk"], scene.crop(exact["risk"])
    observed = (risk != UNKNOWN) & (truth != UNKNOWN)
    bad = observed & (truth == HAZARDOUS)
    masks = (
        np.ones_like(observed), observed, bad, observed & (risk == SAFE), observed & (risk == CAUTION),
        bad & (risk == SAFE), bad & (risk <= CAUTION), observed & ~bad & (risk == HAZARDOUS),
    )  # fmt: skip
    out: dict[str, Any] = {name: int(mask.sum()) for name, mask in zip(COUNTS, masks, strict=True)}
    if "p_hazard" in found:
        p, y = found["p_hazard"][observed], bad[observed]
        k = np.clip(np.digitize(p, EDGES) - 1, 0, len(EDGES) - 2)
        bins = [(int((k == i).sum()), float(p[k == i].sum()), int(y[k == i].sum())) for i in range(len(EDGES) - 1)]
        out["bins"] = bins
    return out


def path_of(scene: Any, exact: Any, found: Any) -> dict[str, Any]:
    """Length of a path over a map, the shortest between its ends over the exact one, and what it truly crosses."""
    from rille.stages.evaluation.path_check import path_check, shortest
    from rille.stages.planning.path import find_path

    path = find_path(found, scene.lattice, scene.vehicle, stretch=True)
    true = shortest(path.xyz, exact, scene.wide, scene.vehicle)
    crossed = path_check(path.xyz, exact["risk"], scene.wide)
    values = {name: m["value"] for name, m in (true | crossed).items()}
    return {"planner": path.planner, "ground": path.ground, **values}


def one(seed: int, cover: float, slope: float, folder: Path | None, preset: str) -> dict[str, Any]:
    """All ways on one scene."""
    import numpy as np
    from hazard.blend import blend
    from hazard.scenes import CELL, kept

    from rille.stages.hazard.risk import risk_map

    scene = kept(folder, seed, cover, slope, preset)
    exact = risk_map(scene.exact, np.zeros_like(scene.exact), CELL, scene.vehicle)
    known = np.isfinite(scene.posed)
    perfect = np.where(known, scene.crop(scene.exact), np.float32(np.nan))
    ways = {
        "rille": risk_map(scene.elevation, scene.elevation_std, CELL, scene.vehicle),
        "perfect pose": risk_map(scene.posed, scene.posed_std, CELL, scene.vehicle),
        "perfect DEM": risk_map(perfect, np.zeros_like(perfect), CELL, scene.vehicle),
        "SGBM + blend": blend(scene),
    }
    error = (scene.posed - scene.crop(scene.exact))[known]
    facts = {"seed": seed, "cover": cover, "slope_deg": slope, "rmse_m": float(np.sqrt(np.nanmean(error**2)))}
    paths = {name: path_of(scene, exact, ways[name]) for name in PLANNED}
    return facts | {"ways": {name: judge(scene, exact, found) for name, found in ways.items()}, "paths": paths}


def total(scenes: list[dict[str, Any]], way: str) -> dict[str, float]:
    return {name: sum(s["ways"][way][name] for s in scenes) for name in COUNTS}


def show(scenes: list[dict[str, Any]], covers: list[float]) -> None:
    from rille.stages.hazard.vehicle import Vehicle  # noqa: F401  (the package must import before the tables)

    thin = 100 * 80  # cells of a footprint: what errs together
    headings = ["cover", "way", "scenes", "observed", "safe", "caution", "false safe, %", "95 %", "enterable hazard, %",
                "false hazard, %", "95 %"]  # fmt: skip
    rows = []
    for cover in [*covers, None]:
        mine = [s for s in scenes if cover is None or s["cover"] == cover]
        for way in mine[0]["ways"]:
            t = total(mine, way)
            n = max(t["observed"], 1)
            low, high = wilson(t["false safe"] / thin, n / thin)
            low2, high2 = wilson(t["false hazard"] / thin, n / thin)
            rows.append(
                ["all" if cover is None else f"{100 * cover:.0f} %", way, len(mine), t["observed"] / t["all"],
                 t["safe"] / n, t["caution"] / n, 100 * t["false safe"] / n, f"{100 * low:.2f}-{100 * high:.2f}",
                 100 * t["enterable hazard"] / n, 100 * t["false hazard"] / n, f"{100 * low2:.2f}-{100 * high2:.2f}"]
            )  # fmt: skip
    table("Classes against the exact elevations", headings, rows)


def show_paths(scenes: list[dict[str, Any]], covers: list[float]) -> None:
    """Length of paths over the shortest."""
    headings = ["cover", "map", "scenes", "path", "of rows", "length, m", *HEADINGS, "hazardous of crossed cells, %"]
    rows = []
    for cover in [*covers, None]:
        mine = [s for s in scenes if cover is None or s["cover"] == cover]
        for way in PLANNED:
            found = [s["paths"][way] for s in mine if s["paths"][way].get("path_length") is not None]
            best = [p for p in found if p["length_ratio"] is not None]
            ratios = Ratios([(p["length_ratio"] * p["shortest_length"], p["shortest_length"]) for p in best])
            crossed = sum(p["crossed_cells"] for p in found)
            rows.append(
                ["all" if cover is None else f"{100 * cover:.0f} %", way, len(mine), len(found),
                 sum(p["planner"] == "rows" for p in found), sum(p["path_length"] for p in found),
                 *ratios.cells(), 100 * sum(p["hazard_cells"] for p in found) / max(crossed, 1)]
            )  # fmt: skip
    table("Paths against the shortest on the exact map", headings, rows)


def calibration(scenes: list[dict[str, Any]]) -> list[tuple[float, float, int]]:
    """Mean probability, observed share and number of cells of each bin that has cells."""
    bins = [s["ways"]["rille"]["bins"] for s in scenes]
    out = []
    for k in range(len(EDGES) - 1):
        n, p, y = (sum(b[k][i] for b in bins) for i in range(3))
        if n:
            out.append((p / n, y / n, n))
    return out


def draw(curve: list[tuple[float, float, int]], path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, ax = plt.subplots(figsize=(4.6, 4.2), layout="constrained")
    ax.plot([0, 1], [0, 1], color="0.6", linewidth=1)
    p, y, n = zip(*curve, strict=True)
    ax.plot(p, y, marker="o", color="#0b4f8a")
    for a, b, c in zip(p, y, n, strict=True):
        ax.annotate(f"{c / sum(n):.0%}", (a, b), xytext=(5, -9), textcoords="offset points", fontsize=7)
    ax.set_xlabel("p_hazard, mean of the bin")
    ax.set_ylabel("truly hazardous share of its cells")
    figure.savefig(path, dpi=110)


def main() -> int:
    given = arguments()
    start_process(1)
    scenes = []
    for seed in range(given.first, given.first + given.seeds):
        for k, cover in enumerate(given.cover):
            scenes.append(one(seed, cover, SLOPES[(seed + k) % len(SLOPES)], given.scenes, given.preset))
            say(f"seed {seed}, cover {cover:g}: {scenes[-1]['ways']['rille']}"[:150])
            if given.json:
                given.json.write_text(json.dumps({"scenes": scenes}, indent=1) + "\n", encoding="utf-8")
    show(scenes, given.cover)
    show_paths(scenes, given.cover)
    curve = calibration(scenes)
    table("p_hazard", ["mean p", "truly hazardous", "cells"], [list(row) for row in curve])
    if given.picture:
        draw(curve, given.picture)
    t = total(scenes, "rille")
    reached = {name: t[name] / max(t["observed"], 1) <= goal for name, goal in GOALS.items()}
    print("\n" + ", ".join(f"{name} {'reached' if ok else 'NOT reached'}" for name, ok in reached.items()))
    return 0 if all(reached.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
