"""Trials of the obstacle monitor: a stone as high as a wheel's radius is laid on a leg after its ground was mapped."""

from __future__ import annotations

import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from driving.beds import config_of, prepared
from driving.ratios import share


def settings_of(k: int) -> list[str]:
    """Parameters of a trial: bed, and where the stone is laid."""
    rng = np.random.default_rng([1999, k])
    ahead, aside = 0.24 + 0.10 * rng.random(), 0.05 * (2 * rng.random() - 1)
    return [
        f"mockup.seed={100 + k}", f"rover.seed={100 + k}", "mockup.rock_cover=0.03", "rover.obstacle_leg=0",
        f"rover.obstacle_ahead={ahead:.4f}", f"rover.obstacle_aside={aside:.4f}", "local_planner.max_length=3.0",
        "mockup.bed_width=1.0", "mockup.bed_length=1.2", "drive.goal=[0.0, 0.5]", "drive.around=0.35", "rover.pad=0.2",
    ]  # fmt: skip


def trial(settings: list[str]) -> dict[str, Any]:
    """One leg with a stone on it; figures of the stone."""
    from rille.pipeline.engine.graph import Graph
    from rille.pipeline.engine.run import RunOptions, run
    from rille.pipeline.engine.store.base import Store
    from rille.pipeline.flow.closed_loop import Drive, EndedError, TrueStand
    from rille.pipeline.flow.products import Stop

    class OneLeg(Drive):
        def _look(self, at: TrueStand) -> Stop:
            if self.driven.stops:
                raise EndedError("stops", "one leg is enough")
            return super()._look(at)

    begin = time.perf_counter()
    sequence, layers = prepared(settings)
    graph, folder = Graph(), Path(tempfile.mkdtemp(prefix="obstacles-"))
    try:
        store = Store(folder)
        flow = OneLeg(graph, sequence, config_of(layers))
        graph.flow(flow.steps())
        result = run(graph, store, RunOptions(executor="inline", keep_going=True))
        found = stone(flow, store)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    event = flow.driven.stops[0].event if flow.driven.stops else ""
    errors = [f"{f.label}: {f.error}" for f in result.failures]
    return {"verdict": event, "reason": "", **found, "errors": errors, "seconds": time.perf_counter() - begin}


def stone(flow: Any, store: Any) -> dict[str, Any]:
    """Whether the leg leads over the stone that was laid on it, and where the rover stopped before it."""
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
    stopped = int(np.asarray(driven["frame_at"])[stop.row])
    contact = int(np.argmax(met)) if met.any() else None
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(trail[:, :2, 3], axis=0).T)))
    return {
        "obstacle": {
            "would_touch": contact is not None,
            "seen": stop.event.startswith("obstacle stop"),
            "away_when_stopped": None if contact is None else float(way[contact] - way[stopped]),
            "way": float(way[stopped]),
        }
    }


def trials(rows: list[dict[str, Any]]) -> list[str]:
    """The trials of the obstacle monitor."""
    told = [r["obstacle"] for r in rows if "obstacle" in r and r["obstacle"]["would_touch"]]
    seen = [o for o in told if o["seen"] and o["away_when_stopped"] > 0]
    clear = [r["obstacle"] for r in rows if "obstacle" in r and not r["obstacle"]["would_touch"]]
    free, false = [o["way"] for o in clear], [o for o in clear if o["seen"]]
    away = sorted(1000 * o["away_when_stopped"] for o in seen)
    return [
        f"{len(rows)} trials, {len(told)} in which the leg leads over the obstacle; stopped before contact in "
        f"{len(seen)}: {share(len(seen), len(told))}; way left to it, mm: least {away[0] if away else 0:.0f}, median "
        f"{away[len(away) // 2] if away else 0:.0f}; way driven clear of it {sum(free):.1f} m with {len(false)} stops"
    ]
