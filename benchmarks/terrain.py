"""Locus against triangulating and gridding the same disparities: error at equal completeness, and time.

python benchmarks/terrain.py [--preset default] [--pairs N] [--threads N] [--picture FILE] [--json FILE]

Every method gets the same disparities, masks and limits, and the same cells. A sweep over the limit of back-matching,
the limit of the geometry's error and the share of the least doubtful cells draws each method's curve of error over
completeness; two methods are compared at the completeness that Locus has with its default parameters, or the greatest
that both reach. 'same cells' is the ratio of the RMSE on the cells that both give by default. With true disparities and
with the matcher's own, on every basic pair of the simulator; on Middlebury's motorcycle (where RILLE_DATA has it)
against its true disparity as a surface over a fronto-parallel plane. Times alternate in one process.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from matching import say, start_process, table

GOALS = {"rmse": 0.8, "nmad": 1.0, "p95": 0.7}
WHY = """\
The goals are meant for triangulating and gridding (median in the cell). A mesh interpolates the same disparities
between the same pixels as Locus does: from the disparity alone both have the same errors, and what Locus gains is the
refinement by both images. It takes noise away (RMSE, NMAD) and hardly moves the 95 % bound: the largest errors are
matches that lean on another surface beside occlusions, and noise matched in shadows. Both methods start there from the
same wrong disparity, and refinement moves a cell by a pixel at most."""
TIME_GOAL = 1.5


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", choices=("default", "accurate"), default="default", help="of the matcher")
    parser.add_argument("--pairs", type=int, help="basic pairs of the simulator (default: all)")
    parser.add_argument("--threads", type=int, default=1, help="threads of every method (default 1)")
    parser.add_argument("--rounds", type=int, default=5, help="timed rounds (default 5)")
    parser.add_argument("--picture", type=Path, help="draw the curves there")
    parser.add_argument("--json", type=Path, help="write all figures there")
    return parser.parse_args()


def scenes(pairs: int | None, preset: str) -> Iterator[tuple[str, Any]]:
    """Scenes by the kind of their disparities."""
    from gridding.scenes import mockup, motorcycle

    known = list(mockup(pairs))
    extra = motorcycle()
    if extra is None:
        print("RILLE_DATA does not name a folder with motorcycle: it is left out")
    for scene in [*known, *([extra] if extra else [])]:
        yield "true disparity", scene
        yield "our disparity", scene.matched(preset)


def compare(kind: str, scene: Any, methods: list[Any]) -> list[dict[str, Any]]:
    """Default figures and swept curves of all methods on one scene."""
    from gridding.measures import FIGURES, judge, least, on_the_same_cells, sweep
    from gridding.methods import MAX_BACKMATCH_PX

    limit = MAX_BACKMATCH_PX
    found: list[dict[str, Any]] = []
    first = None
    for method in methods:
        say(f"{scene.name}, {kind}: {method.name}")
        model = method.run(scene, limit, True)
        first = model if first is None else first
        plain = judge(scene, model)
        found.append({"scene": scene.name, "kind": kind, "method": method.name, "default": plain})
        found[-1] |= {"same": on_the_same_cells(scene, first, model), "curve": sweep(scene, method)}
    wanted, curve = found[0]["default"].completeness, found[0]["curve"]
    for mine in found:
        at = min(wanted, max(j.completeness for j in mine["curve"]))
        mine["at"] = at
        for figure in FIGURES:
            ours, theirs = least(curve, figure, at), least(mine["curve"], figure, at)
            mine[f"{figure}_ratio"] = ours / theirs if ours is not None and theirs else None
    return found


def show(title: str, found: list[dict[str, Any]]) -> None:
    rows = []
    for f in found:
        d = f["default"]
        rows.append(
            [f["method"], 1e3 * d.rmse, 1e3 * d.nmad, 1e3 * d.p95, 1e3 * d.bias, d.completeness, f["at"]]
            + [f[f"{k}_ratio"] for k in GOALS]
            + [f["same"]]
        )
    heads = [
        "method",
        "RMSE mm",
        "NMAD mm",
        "95 % mm",
        "bias mm",
        "complete",
        "at",
        "RMSE x",
        "NMAD x",
        "95 % x",
        "same cells",
    ]
    table(title, heads, rows)


def summary(found: list[dict[str, Any]]) -> None:
    """Median and worst ratio of Locus to each other method, over the simulator's pairs."""
    import numpy as np

    rows = []
    for kind in dict.fromkeys(f["kind"] for f in found):
        names = dict.fromkeys(f["method"] for f in found if f["method"] != "Locus")
        for name in names:
            row: list[Any] = [f"{kind}, {name}"]
            for figure, goal in GOALS.items():
                ratios = [
                    f[f"{figure}_ratio"]
                    for f in found
                    if (f["kind"], f["method"]) == (kind, name) and f["scene"].startswith("mockup")
                ]
                known = [r for r in ratios if r is not None]
                middle = float(np.median(known))
                row += [middle, max(known), "yes" if middle <= goal else "no"]
            rows.append(row)
    heads = ["simulator: Locus over"]
    for figure, goal in GOALS.items():
        heads += [f"{figure} median", "worst", f"<= {goal:g}"]
    table("ratios of Locus to the others at equal completeness, over all basic pairs", heads, rows)
    print(f"\n{WHY}")


def times(scene: Any, methods: list[Any], rounds: int, preset: str) -> list[dict[str, Any]]:
    """Least seconds of each step in alternating rounds, and ratios to the pair's matching by the same preset."""
    from gridding import accurate
    from gridding.methods import MAX_BACKMATCH_PX
    from gridding.scenes import match

    ours = scene.matched(preset)
    jobs: dict[str, Callable[[], Any]] = {"matching": lambda: match(scene, preset)}
    jobs |= {m.name: lambda m=m: m.run(ours, MAX_BACKMATCH_PX, True) for m in methods}
    jobs |= accurate.jobs(scene)
    taken: dict[str, list[float]] = {name: [] for name in jobs}
    for job in jobs.values():
        job()
    for _ in range(rounds):
        for name, job in jobs.items():
            start = time.perf_counter()
            job()
            taken[name].append(time.perf_counter() - start)
    least = {name: min(t) for name, t in taken.items()}
    base = {
        name: least[accurate.MATCHING if name in (accurate.MATCHING, accurate.LOCUS) else "matching"] for name in least
    }
    return [
        {"scene": scene.name, "step": name, "ms": 1e3 * t, "ratio": t / base[name], "rounds": rounds}
        for name, t in least.items()
    ]


def picture(found: list[dict[str, Any]], path: Path) -> None:
    """Curves of error over completeness: the first pair of the simulator, and the motorcycle."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np
    from gridding.measures import least

    names = [n for n in dict.fromkeys(f["scene"] for f in found) if n in ("mockup 0", "motorcycle")]
    kinds = list(dict.fromkeys(f["kind"] for f in found))
    figure, axes = plt.subplots(len(names), len(kinds), figsize=(11, 4.2 * len(names)), squeeze=False)
    for f in found:
        if f["scene"] in names:
            axis = axes[names.index(f["scene"])][kinds.index(f["kind"])]
            shares = np.linspace(0.1, max(j.completeness for j in f["curve"]), 60)
            (line,) = axis.plot(shares, [1e3 * (least(f["curve"], "rmse", s) or np.nan) for s in shares])
            line.set_label(f["method"])
            axis.plot(f["default"].completeness, 1e3 * f["default"].rmse, "o", color=line.get_color())
            axis.set(title=f"{f['scene']}, {f['kind']}", xlabel="completeness", ylabel="RMSE (mm)")
            axis.legend(fontsize=7)
            axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    print(f"\n{path}")


def main() -> None:
    given = arguments()
    start_process(given.threads)
    from gridding.methods import available
    from stereo.methods import set_threads

    set_threads(given.threads)
    methods, found, timed = available(), [], []
    print("\n".join(f"{method.name}: {method.what}" for method in methods))
    for kind, scene in scenes(given.pairs, given.preset):
        mine = compare(kind, scene, methods)
        cells = f"{int(scene.judged.sum())} cells of {1e3 * scene.lattice.cell:g} mm"
        show(f"{scene.name}, {kind}, {cells}; x: Locus over the method at completeness 'at'", mine)
        found += mine
        if kind == "true disparity" and scene.name in ("mockup 0", "motorcycle"):
            timed += times(scene, methods, given.rounds, given.preset)
    summary(found)
    for name in dict.fromkeys(t["scene"] for t in timed):
        rows = [[t["step"], t["ms"], t["ratio"]] for t in timed if t["scene"] == name]
        table(f"time: {name}, {given.threads} thread(s); asked: Locus <= {TIME_GOAL} x", ["step", "ms", "x"], rows)
    if given.picture:
        picture(found, given.picture)
    if given.json:
        plain = [f | {"default": asdict(f["default"]), "curve": [asdict(j) for j in f["curve"]]} for f in found]
        given.json.write_text(json.dumps({"accuracy": plain, "time": timed}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
