"""What of a drive's way is owed to perception, and what to ground that is not seen yet: drives without any error.

    benchmarks/exact_loop.py                    20 seeds, rock cover 5 and 10 %
    benchmarks/exact_loop.py --detail 0.5       and all ground in view is seen well enough to drive on

The beds, goals, vehicle and planner of ``benchmarks/loop.py``, but at each stop the map is the exact elevation of what
both cameras had in view so far, at the true pose, and each leg is driven exactly. What remains above the shortest way
is the price of not knowing what lies ahead.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

from driving.beds import COVERS, NOMINAL, choose_goal, config_of, prepared
from driving.ratios import HEADINGS, Ratios

FARTHEST = 0.035
"""m that a pixel covers on the ground where the loop's own models end: most of theirs do between 0.03 and 0.045."""


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1:21", help="FIRST:END of the seeds (default 1:21)")
    parser.add_argument("--cover", type=float, action="append", help=f"rock cover; may be repeated (default {COVERS})")
    parser.add_argument("--detail", type=float, help="drive.detail; default that of the loop")
    parser.add_argument("--set", action="append", default=[], help="a parameter, section.key=value; may be repeated")
    parser.add_argument("--out", type=Path, default=Path("exact-loop.jsonl"), help="one line a run, appended")
    return parser.parse_args()


def drive(sequence: Any, config: Any, goal: tuple[float, float]) -> dict[str, Any]:
    """One drive on exact elevations; figures of it."""
    import numpy as np
    from driving.exact_bed import ExactBed, place_of

    from rille.stages.core.declare import Bundle
    from rille.stages.geometry.geometry import way_length
    from rille.stages.hazard.risk import risk_map
    from rille.stages.planning.local_planner.look import FieldOfView, PlannerMemory
    from rille.stages.planning.local_planner.stage import SeenGround, next_leg, shortest_way
    from rille.stages.terrain.occlusion_bounds import Bounds, ceiling

    bed, vehicle, p = ExactBed.of(sequence, config, goal), config.vehicle, config.local_planner
    fine = vehicle.wheel_diameter / config.drive.detail
    view = FieldOfView.of(sequence.rig, sequence.simulation.T_vehicle_left)
    meta = {"lattice": bed.lattice.to_dict(), "vehicle": vehicle.model_dump(mode="json")}

    def judged(known: Any) -> Bundle:
        z = np.where(known, bed.elevation, np.float32(np.nan))
        return Bundle(risk_map(z, np.zeros_like(z), bed.lattice.cell, vehicle, config.risk), meta)

    T, memory, before = bed.T_world_vehicle, PlannerMemory(), None
    (start, heading), whole = bed.start(), judged(np.isfinite(bed.elevation))
    best, _ = shortest_way(whole, (*start, heading), goal, p)
    far = bed.under(T, sequence.parameters["rover"].pad)
    near, way, stops, follows = far.copy(), 0.0, 0, "drive"
    top = np.full_like(bed.elevation, np.nan)
    while follows != "end" and stops < config.drive.max_stops:
        seen, covers = bed.in_view(T, max(FARTHEST, fine))
        far, now = far | seen, seen & (covers <= fine)
        near |= now
        centre = (T @ sequence.simulation.T_vehicle_left).translation
        top = np.fmin(top, ceiling(np.where(now, bed.elevation, np.float32(np.nan)), bed.lattice, centre))
        known = np.where(near, bed.elevation, np.float32(np.nan))
        bounds = Bounds.of(known, np.zeros_like(known), top)
        maps, follows, (place, heading) = (judged(near), judged(far)), "again", place_of(T)
        while follows == "again":
            leg = next_leg(SeenGround(*maps, bounds), (*place, heading), goal, p, memory, view, before)
            follows = memory.after(leg.verdict, leg.where)
        before = (leg.rest, leg.rest_gear) if len(leg.rest_gear) else None
        T = bed.at(*after(leg, heading))
        stops, way = stops + 1, way + way_length(leg.path)
    verdict = leg.verdict if follows == "end" else "stops"
    return {"verdict": verdict, "reason": leg.reason, "way": way, "shortest_way": best, "stops": stops}


def after(leg: Any, heading: float) -> tuple[tuple[float, float], float]:
    """Where (m) the vehicle stands after a leg that is driven exactly, and its heading (rad)."""
    for a, b, gear in zip(leg.path[:-1], leg.path[1:], leg.gear, strict=True):
        heading = math.atan2(-gear * (b[0] - a[0]), gear * (b[1] - a[1]))
    return (float(leg.path[-1, 0]), float(leg.path[-1, 1])), heading + leg.turn


def table(rows: list[dict[str, Any]]) -> list[str]:
    """The drives by rock cover."""
    lines = [f"| rock cover | drives | reached | {' | '.join(HEADINGS)} |", "|---" * (3 + len(HEADINGS)) + "|"]
    for cover in [*sorted({r["cover"] for r in rows}), None]:
        mine = [r for r in rows if cover in (None, r["cover"]) and r["shortest_way"]]
        reached = [r for r in mine if r["verdict"] == "goal"]
        cells = ["all" if cover is None else f"{100 * cover:.0f} %", str(len(mine)), str(len(reached))]
        cells += Ratios([(r["way"], r["shortest_way"]) for r in reached]).cells()
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def main() -> None:
    """Drive what is not there yet, and print the table."""
    from rille.pipeline.engine.runtime.environment import prepare_environment

    given = arguments()
    prepare_environment()
    from driving.exact_bed import ExactBed

    rows = [json.loads(line) for line in given.out.read_text().splitlines()] if given.out.exists() else []
    done = {(r["seed"], r["cover"]) for r in rows}
    first, end = (int(v) for v in given.seeds.split(":"))
    for seed in range(first, end):
        for cover in given.cover or COVERS:
            if (seed, cover) in done:
                continue
            more = [f"mockup.seed={seed}", f"rover.seed={seed}", f"mockup.rock_cover={cover}", *given.set]
            more += [] if given.detail is None else [f"drive.detail={given.detail}"]
            sequence, layers = prepared(more)
            config = config_of(layers)
            goal = choose_goal(ExactBed.of(sequence, config, NOMINAL), config)
            found = {"verdict": "not driven", "shortest_way": None} if goal is None else drive(sequence, config, goal)
            rows.append({"seed": seed, "cover": cover, **found})
            with given.out.open("a") as file:
                file.write(json.dumps(rows[-1]) + "\n")
            print(f"exact loop, seed {seed}, cover {cover}: {found['verdict']}", flush=True)
    print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
