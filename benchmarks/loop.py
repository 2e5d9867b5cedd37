"""The closed loop over many beds: does the rover arrive, where does it stand, does it know where it is?

    benchmarks/loop.py                     20 seeds, rock cover 5 and 10 %: the table
    benchmarks/loop.py --obstacles 100    a stone of one wheel radius laid on the path after its ground was mapped

The goal of each bed is the place nearest to (0, 1) m to which a path exists on the exact map, and where there is room
to turn, at least 0.7 m from the start. Violations are counted by the true placement of the wheels, of drives that
failed, too. Ways are compared with two shortest ones: by own measures, on the risk map of the exact elevations by the
same planner for the same vehicle, which says what is possible, too; and by the limits alone, over all places where the
wheels on the exact ground keep to the vehicle's limits (``driving/limits.py``).
Intervals are of 95 %, Wilson's of shares and resampled ones of lengths. Runs that ``--out`` holds already are not
repeated, so that a benchmark that is interrupted goes on; several processes may share the seeds, each with a file of
its own, which put together are read by ``--table``.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

from driving.beds import COVERS, NOMINAL, choose_goal, config_of, prepared
from driving.ratios import HEADINGS, Ratios, share

LIMITS = "shortest_within_limits"


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1:21", help="FIRST:END of the seeds (default 1:21)")
    parser.add_argument("--cover", type=float, action="append", help=f"rock cover; may be repeated (default {COVERS})")
    parser.add_argument("--obstacles", type=int, default=0, metavar="N", help="trials of the obstacle monitor instead")
    parser.add_argument("--first", type=int, default=0, help="number of the first trial")
    parser.add_argument("--set", action="append", default=[], help="a parameter, section.key=value; may be repeated")
    parser.add_argument("--out", type=Path, default=Path("loop.jsonl"), help="one line a run, appended (loop.jsonl)")
    parser.add_argument("--table", action="store_true", help="only print the table of those that are there")
    return parser.parse_args()


def drive(settings: list[str]) -> dict[str, Any]:
    """One drive in a store of its own; figures of it."""
    from driving.exact_bed import ExactBed
    from driving.limits import shortest_within_limits

    from rille.pipeline.engine.graph import Graph
    from rille.pipeline.engine.run import RunOptions, run
    from rille.pipeline.engine.store.base import Store
    from rille.pipeline.flow.closed_loop import Drive

    begin = time.perf_counter()
    sequence, layers = prepared(settings)
    config = config_of(layers)
    bed = ExactBed.of(sequence, config, NOMINAL)
    goal = choose_goal(bed, config)
    if goal is None:
        return {"verdict": "not driven", "reason": "", "path_exists": False, "seconds": time.perf_counter() - begin}
    graph, folder = Graph(), Path(tempfile.mkdtemp(prefix="loop-"))
    try:
        store = Store(folder)
        flow = Drive(graph, sequence, config_of([*layers, {"drive": {"goal": goal}}]))
        graph.flow(flow.steps())
        result = run(graph, store, RunOptions(executor="inline", keep_going=True))
        found = figures(flow, store)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    errors = [f"{f.label}: {f.error}" for f in result.failures]
    seconds = time.perf_counter() - begin
    least = shortest_within_limits(bed, goal)
    return {**found, "goal": goal, "shortest_within_limits": least, "errors": errors, "seconds": seconds}


def figures(flow: Any, store: Any) -> dict[str, Any]:
    """What became of a drive."""

    verdict, reason = flow.outcome()
    driven = flow.driven
    out: dict[str, Any] = {"verdict": verdict, "reason": reason, "stops": len(driven.stops)}
    out["events"] = [stop.event for stop in driven.stops if stop.event]
    out["obstacle_stops"] = sum(event.startswith("obstacle stop") for event in out["events"])
    out["safety_stops"] = sum(event.startswith("safety") for event in out["events"])
    out["images"] = max(flow.true, default=0) + 1
    if driven.check is not None and driven.check.ref is not None:
        check = store.open(driven.check.ref)
        out |= {name: m["value"] for name, m in check.meta["metrics"].items()}
        out |= {name: check.meta[name] for name in ("path_exists", "with_margin")}
    if out.get("path_exists") is None:
        out["path_exists"] = True  # as far as the choice of the goal knows: a failed drive counts as one
    return out


def table(rows: list[dict[str, Any]]) -> list[str]:
    """The drives by rock cover and all together, and what was worst on all of them."""
    heads = ["rock cover", "beds", "with a path", "goal reached", "drives with a violation", "drift, median, worst"]
    heads += [f"{h} ({by})" for by in ("own measures", "limits alone") for h in HEADINGS]
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for cover in [*sorted({r["cover"] for r in rows}), None]:
        mine = [r for r in rows if cover in (None, r["cover"])]
        judged = [r for r in mine if "clearance_violations" in r]
        possible = [r for r in mine if r.get("path_exists", True)]
        reached = [r for r in possible if r["verdict"] == "goal" and "path_length" in r]
        broken = [r for r in judged if any(r[f"{k}_violations"] for k in ("clearance", "tilt", "step"))]
        drift = sorted(100 * r["localisation_share"] for r in judged if r["verdict"] == "goal")
        cells = ["all" if cover is None else f"{100 * cover:.0f} %", str(len(mine)), str(len(possible))]
        cells += [f"{len(reached)}: {share(len(reached), len(possible))}"]
        cells += [f"{len(broken)}: {share(len(broken), len(judged))}"]
        cells += [f"{median(drift):.2f}, {drift[-1]:.2f} %" if drift else "-"]
        cells += Ratios([(r["path_length"], r["shortest_length"]) for r in reached]).cells()
        cells += Ratios([(r["path_length"], r[LIMITS]) for r in reached if r.get(LIMITS)]).cells()
        lines.append(f"| {' | '.join(cells)} |")
    return [*lines, *worst(rows)]


def worst(rows: list[dict[str, Any]]) -> list[str]:
    """What the wheels truly met on all drives."""
    judged = [r for r in rows if "clearance_violations" in r]
    if not judged:
        return []
    return [
        f"{sum(r['placements'] for r in judged)} placements of the wheels: least clearance "
        f"{1e3 * min(r['least_clearance'] for r in judged):.1f} mm, greatest edge under a wheel "
        f"{1e3 * max(r['greatest_step'] for r in judged):.1f} mm, greatest tilt "
        f"{max(r['greatest_tilt'] for r in judged):.1f} degrees",
        f"{sum(r['path_length'] for r in judged):.1f} m driven "
        f"with {sum(r['obstacle_stops'] for r in judged)} obstacle stops, "
        f"{sum(r['seconds'] for r in judged) / len(judged):.0f} s a drive",
    ]


def main() -> None:
    """Run what is not there yet, and print the table."""
    from rille.pipeline.engine.runtime.environment import SINGLE, prepare_environment

    given = arguments()
    prepare_environment()
    os.environ.update({f"{name}_NUM_THREADS": "1" for name in SINGLE})
    rows = [json.loads(line) for line in given.out.read_text().splitlines()] if given.out.exists() else []
    done = {r["name"] for r in rows}
    run, work = drive, list[tuple[str, dict[str, Any], list[str]]]()
    if given.obstacles:
        from driving.obstacles import settings_of, trial

        run = trial
        work = [(f"obstacles-{k}", {"trial": k}, settings_of(k)) for k in range(given.first, given.obstacles)]
    else:
        first, end = (int(v) for v in given.seeds.split(":"))
        for seed in range(first, end):
            for cover in given.cover or COVERS:
                more = [f"mockup.seed={seed}", f"rover.seed={seed}", f"mockup.rock_cover={cover}"]
                work.append((f"loop-{cover}-{seed}", {"seed": seed, "cover": cover}, more))
    for name, facts, settings in [] if given.table else work:
        if name in done:
            continue
        row = {"name": name, **facts, **run([*settings, *given.set])}
        rows.append(row)
        with given.out.open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(f"{name}: {row['verdict']} {row['reason']} ({row['seconds']:.0f} s)", flush=True)
    asked = {name for name, _, _ in work}
    rows = [r for r in rows if r["name"] in asked]
    if given.obstacles:
        from driving.obstacles import trials

        print("\n".join(trials(rows)))
    else:
        print("\n".join(table(rows)))


if __name__ == "__main__":
    main()
