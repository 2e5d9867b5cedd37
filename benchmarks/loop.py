"""The closed loop over many beds: does the rover arrive, where does it stand, does it know where it is?

    benchmarks/loop.py                     20 seeds, rock cover 5 and 10 %: the table
    benchmarks/loop.py --reflex 100        an obstacle of one wheel radius laid on the way after its ground was mapped

The goal of each bed is the place nearest to (0, 1) m to which a path exists on the exact map, and where there is room
to turn, at least 0.7 m from the start. Violations are counted by the true placement of the wheels; what is possible,
and the shortest way, is found on the risk map of the exact elevations by the same planner for the same vehicle.
Intervals are Wilson's of 95 %. Runs that ``--out`` holds already are not repeated, so that a benchmark that is
interrupted goes on, and several processes may share the seeds.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

NOMINAL = (0.0, 1.0)
LEAST = 0.7
"""m; of the goal from the start."""
COVERS = (0.05, 0.1)
LONGEST = 1.15
"""Of a way over the shortest one."""


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1:21", help="FIRST:END of the seeds (default 1:21)")
    parser.add_argument("--cover", type=float, action="append", help=f"rock cover; may be repeated (default {COVERS})")
    parser.add_argument("--reflex", type=int, default=0, metavar="N", help="trials of the reflex detection instead")
    parser.add_argument("--first", type=int, default=0, help="number of the first trial")
    parser.add_argument("--set", action="append", default=[], help="a parameter, section.key=value; may be repeated")
    parser.add_argument("--out", type=Path, default=Path("loop.jsonl"), help="one line a run, appended (loop.jsonl)")
    parser.add_argument("--table", action="store_true", help="only print the table of what is there")
    return parser.parse_args()


def drive(settings: list[str]) -> dict[str, Any]:
    """One drive in a store of its own; figures of it."""
    from pipeline import driver
    from pipeline.dag import Graph
    from pipeline.drive import Drive
    from pipeline.store import at

    begin = time.perf_counter()
    sequence, layers = prepared(settings)
    goal = choose_goal(sequence, config_of(layers))
    if goal is None:
        return {"verdict": "not driven", "reason": "", "path_exists": False, "seconds": time.perf_counter() - begin}
    graph, folder = Graph(), Path(tempfile.mkdtemp(prefix="loop-"))
    try:
        store = at(folder)
        flow = Drive(graph, sequence, config_of([*layers, {"drive": {"goal": goal}}]))
        flow.build()
        result = driver.run(graph, store, executor="inline", keep_going=True)
        found = figures(flow, store)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    errors = [f"{f.label}: {f.error}" for f in result.failures]
    return {**found, "goal": goal, "errors": errors, "seconds": time.perf_counter() - begin}


def choose_goal(sequence: Any, config: Any) -> tuple[float, float] | None:
    """The place nearest to the nominal goal that can be driven to on the exact map, and where there is room to turn."""
    import numpy as np
    from exact_bed import ExactBed

    from stages.footing import Footing
    from stages.leg_ground import Ground
    from stages.risk import risk_map

    bed, cell = ExactBed.of(sequence, config, NOMINAL), config.locus.cell_size
    judged = risk_map(bed.elevation, np.zeros_like(bed.elevation), cell, config.vehicle, config.risk)
    footing = Footing.of(judged["risk"], judged["reason"], bed.lattice, config.vehicle)
    start, heading = bed.start()
    ground = Ground(footing, start, heading, config.leg.model_copy(update={"unknown_price": math.inf}))
    _, cost, _ = ground.search(start, cell, whole=True)
    x, y = ground.places()
    far = np.where(np.isfinite(cost).all(axis=0), np.hypot(x - NOMINAL[0], y - NOMINAL[1]), np.inf)
    far[np.hypot(x - start[0], y - start[1]) < LEAST] = np.inf
    best = np.unravel_index(int(np.argmin(far)), far.shape)
    return (float(x[best]), float(y[best])) if np.isfinite(far[best]) else None


def figures(flow: Any, store: Any) -> dict[str, Any]:
    """What became of a drive."""

    verdict, reason = flow.outcome()
    driven = flow.driven
    out: dict[str, Any] = {"verdict": verdict, "reason": reason, "stops": len(driven.stops)}
    out["events"] = [stop.event for stop in driven.stops if stop.event]
    out["reflex_stops"] = sum(event.startswith("reflex") for event in out["events"])
    out["safety_stops"] = sum(event.startswith("safety") for event in out["events"])
    out["images"] = max(flow.true, default=0) + 1
    if driven.check is not None and driven.check.ref is not None:
        check = store.open(driven.check.ref)
        out |= {name: m["value"] for name, m in check.meta["metrics"].items()}
        out |= {name: check.meta[name] for name in ("path_exists", "with_margin")}
    else:
        out["path_exists"] = True  # as far as the choice of the goal knows: a failed drive counts as one
    return out


def trial(settings: list[str]) -> dict[str, Any]:
    """One leg with a stone on it; figures of the stone."""
    from pipeline import driver
    from pipeline.dag import Graph
    from pipeline.drive import Drive
    from pipeline.store import at

    class OneLeg(Drive):
        def _stop(self, *where: Any) -> None:
            if not self.driven.stops:
                super()._stop(*where)

    begin = time.perf_counter()
    sequence, layers = prepared(settings)
    graph, folder = Graph(), Path(tempfile.mkdtemp(prefix="reflex-"))
    try:
        store = at(folder)
        flow = OneLeg(graph, sequence, config_of(layers))
        flow.build()
        result = driver.run(graph, store, executor="inline", keep_going=True)
        found = stone(flow, store)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    event = flow.driven.stops[0].event if flow.driven.stops else ""
    errors = [f"{f.label}: {f.error}" for f in result.failures]
    return {"verdict": event, "reason": "", **found, "errors": errors, "seconds": time.perf_counter() - begin}


def stone(flow: Any, store: Any) -> dict[str, Any]:
    """Whether the leg leads over the stone that was laid on it, and where the rover stopped before it."""
    import numpy as np

    laid = next((h for h in flow.graph.nodes if h.stage == "mockup.obstacle" and h.ref is not None), None)
    stop = flow.driven.stops[0] if flow.driven.stops else None
    if laid is None or stop is None or stop.drive.ref is None or laid.ref.meta["obstacle"] is None or not stop.frames:
        return {}
    driven, vehicle = store.open(stop.drive.ref), flow.config.vehicle
    trail = np.asarray(driven["trail"])
    ahead, right = (trail[:, :2, axis] for axis in (1, 0))
    away = np.asarray(laid.ref.meta["obstacle"]) - trail[:, :2, 3]
    radius = 1.2 * 0.5 * vehicle.wheel_diameter
    met = np.abs((away * ahead).sum(axis=1)) <= vehicle.half_length + radius
    met &= np.abs((away * right).sum(axis=1)) <= vehicle.half_width + radius
    stopped = int(np.asarray(driven["frame_at"])[flow.rows[stop.frames[-1]]])
    contact = int(np.argmax(met)) if met.any() else None
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(trail[:, :2, 3], axis=0).T)))
    return {
        "obstacle": {
            "would_touch": contact is not None,
            "seen": stop.event.startswith("reflex"),
            "away_when_stopped": None if contact is None else float(way[contact] - way[stopped]),
            "way": float(way[stopped]),
        }
    }


def prepared(settings: list[str]) -> tuple[Any, list[dict[str, Any]]]:
    """The sequence and the layers of the configuration."""
    from datasets.registry import open_sequence
    from pipeline import config

    for_dataset, for_stages = config.split_dataset(config.parse_assignments(settings))
    sequence = open_sequence("mockup-loop", for_dataset)
    assert sequence.vehicle is not None
    vehicle = {"vehicle": sequence.vehicle.model_dump()}
    return sequence, [vehicle, config.expand(sequence.defaults), for_stages]


def config_of(layers: list[dict[str, Any]]) -> Any:
    """The configuration of layers."""
    from pipeline import config

    return config.build(*layers)


def wilson(hits: int, n: int) -> str:
    """Share and Wilson's interval of 95 %, per cent."""
    if n == 0:
        return "-"
    z, p = 1.959964, hits / n
    middle, half = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    low, high = (min(max((middle + s * half) / (1 + z * z / n), 0.0), 1.0) for s in (-1, 1))
    return f"{100 * p:.0f} % ({100 * low:.0f}-{100 * high:.0f})"


def table(rows: list[dict[str, Any]]) -> list[str]:
    """The runs by rock cover."""
    lines = [
        "| rock cover | runs | path exists | of these reached | runs with a violation | drift, median, worst "
        f"| way / shortest, median, worst | at most {LONGEST:g} | reflex stops | way, m | s a loop |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for cover in sorted({r["cover"] for r in rows}):
        mine = [r for r in rows if r["cover"] == cover]
        judged = [r for r in mine if "clearance_violations" in r]
        possible = [r for r in mine if r.get("path_exists", True)]
        reached = [r for r in possible if r["verdict"] == "goal" and "way" in r]
        broken = [r for r in judged if any(r[f"{k}_violations"] for k in ("clearance", "tilt", "step"))]
        drift = sorted(100 * r["localisation_share"] for r in judged if r["verdict"] == "goal")
        ratio = sorted(r["way"] / r["shortest_way"] for r in reached)
        way = sum(r["way"] for r in judged)
        seconds = sum(r["seconds"] for r in mine) / len(mine)
        cells = [f"{100 * cover:.0f} %", str(len(mine)), str(len(possible))]
        cells += [f"{len(reached)}: {wilson(len(reached), len(possible))}"]
        cells += [f"{len(broken)}: {wilson(len(broken), len(judged))}", f"{_middle(drift)} %", _middle(ratio)]
        cells += [wilson(sum(r <= LONGEST for r in ratio), len(ratio))]
        cells += [str(sum(r["reflex_stops"] for r in judged)), f"{way:.1f}", f"{seconds:.0f}"]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _middle(values: list[float]) -> str:
    return f"{values[len(values) // 2]:.2f}, {values[-1]:.2f}" if values else "-"


def trials(rows: list[dict[str, Any]]) -> list[str]:
    """The trials of the reflex."""
    told = [r["obstacle"] for r in rows if "obstacle" in r and r["obstacle"]["would_touch"]]
    seen = [o for o in told if o["seen"] and o["away_when_stopped"] > 0]
    clear = [r["obstacle"] for r in rows if "obstacle" in r and not r["obstacle"]["would_touch"]]
    free, false = [o["way"] for o in clear], [o for o in clear if o["seen"]]
    away = sorted(1000 * o["away_when_stopped"] for o in seen)
    return [
        f"{len(rows)} trials, {len(told)} in which the leg leads over the obstacle; stopped before contact in "
        f"{len(seen)}: {wilson(len(seen), len(told))}; way left to it, mm: least {away[0] if away else 0:.0f}, median "
        f"{away[len(away) // 2] if away else 0:.0f}; way driven clear of it {sum(free):.1f} m with {len(false)} stops"
    ]


def main() -> None:
    """Run what is not there yet, and print the table."""
    from pipeline.commands.options import cache_folder
    from pipeline.environment import SINGLE, prepare_environment

    given = arguments()
    prepare_environment(cache_folder(None))
    os.environ.update({f"{name}_NUM_THREADS": "1" for name in SINGLE})
    rows = [json.loads(line) for line in given.out.read_text().splitlines()] if given.out.exists() else []
    done = {r["name"] for r in rows}
    work: list[tuple[str, dict[str, Any], list[str]]] = []
    if given.reflex:
        import numpy as np

        for k in range(given.first, given.reflex):
            rng = np.random.default_rng([1999, k])
            ahead, aside = 0.24 + 0.10 * rng.random(), 0.05 * (2 * rng.random() - 1)
            more = [f"mockup.seed={100 + k}", f"rover.seed={100 + k}", "mockup.rock_cover=0.03", "rover.obstacle_leg=0"]
            more += [f"rover.obstacle_ahead={ahead:.4f}", f"rover.obstacle_aside={aside:.4f}", "leg.length=3.0"]
            more += ["mockup.bed_width=1.0", "mockup.bed_length=1.2", "drive.goal=[0.0, 0.5]", "drive.around=0.35"]
            work.append((f"reflex-{k}", {"trial": k}, [*more, "rover.pad=0.2"]))
    else:
        first, end = (int(v) for v in given.seeds.split(":"))
        for seed in range(first, end):
            for cover in given.cover or COVERS:
                more = [f"mockup.seed={seed}", f"rover.seed={seed}", f"mockup.rock_cover={cover}"]
                work.append((f"loop-{cover}-{seed}", {"seed": seed, "cover": cover}, more))
    for name, facts, settings in [] if given.table else work:
        if name in done:
            continue
        row = {"name": name, **facts, **(trial if given.reflex else drive)([*settings, *given.set])}
        rows.append(row)
        with given.out.open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(f"{name}: {row['verdict']} {row['reason']} ({row['seconds']:.0f} s)", flush=True)
    kind = "reflex" if given.reflex else "loop"
    rows = [r for r in rows if r["name"].startswith(kind)]
    print("\n".join(trials(rows) if given.reflex else table(rows)))


if __name__ == "__main__":
    main()
