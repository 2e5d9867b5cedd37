"""What each idea of the local planner gains: drives on exact elevations with one idea switched off at a time.

    benchmarks/planner_ablation.py --seeds 61:81     beds to choose by
    benchmarks/planner_ablation.py --seeds 41:61     beds to judge by

The drives are those of ``benchmarks/exact_loop.py``: exact maps of the ground in view, exact legs. Ways are compared on
the beds whose goals the planner reaches with the idea and without it. Drives are kept in ``--out``, so that a run that
is interrupted goes on.
"""

from __future__ import annotations

import argparse
import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

from driving.beds import NOMINAL, choose_goal, config_of, prepared

ALL = "all ideas"


def replacements() -> dict[str, tuple[Any, str, Any]]:
    """Ideas that a replaced attribute switches off: object, name, replacement."""
    from rille.stages.planning.local_planner import clearance, ground, policy
    from rille.stages.planning.local_planner.clearance import Footing
    from rille.stages.planning.local_planner.look import Target

    build = Footing.of

    def unbounded(*args: Any, bounds: Any = None, **more: Any) -> Footing:
        return build(*args, **more)

    return {
        "hidden ground under the belly": (Footing, "of", staticmethod(unbounded)),
        "kept path": (ground.Ground, "again", lambda *_: ([], float("inf"))),
        "straightened path": (policy, "_straight", lambda _, way: list(way)),
        "legs that end in view of the next ground": (Target, "last_view", lambda *_: None),
        "turns to see": (Target, "turn", lambda *_: None),
        "cost beside hazards": (ground, "PROXIMITY_COST", 0.0),
        "cost of unseen spots narrower than a wheel": (clearance, "_opened", lambda mask, *_: mask),
        "cost of caution and doubted ground": (ground, "CAUTION_COST", 1e-9),
        "lower cost of ground seen from afar": (ground, "FAR_COST", ground.UNKNOWN_COST),
        "lower cost of far doubts": (ground, "NEAR_WHEELBASES", float("inf")),
        "ground no worse than that under the vehicle": (ground, "HERE_WHEELBASES", -1.0),
        "cost of doubtful ground": (ground, "LIKELY_COST", ground.UNKNOWN_COST),
    }


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="61:81", help="FIRST:END of the beds (default 61:81)")
    parser.add_argument("--cover", type=float, default=0.1, help="rock cover (default 0.1)")
    parser.add_argument("--idea", action="append", help="only these; may be repeated")
    parser.add_argument("--out", type=Path, default=Path("planner-ablation.jsonl"), help="one line a drive, appended")
    return parser.parse_args()


def drive(seed: int, cover: float, idea: str) -> dict[str, Any]:
    """Figures of one drive without an idea."""
    import exact_loop
    from driving.exact_bed import ExactBed

    settings = [f"mockup.seed={seed}", f"rover.seed={seed}", f"mockup.rock_cover={cover}"]
    sequence, layers = prepared(settings)
    config = config_of(layers)
    goal = choose_goal(ExactBed.of(sequence, config, NOMINAL), config)
    if goal is None:
        return {"verdict": "not driven", "shortest_way": None}
    with ExitStack() as stack:
        if idea in replacements():
            stack.enter_context(patch.object(*replacements()[idea]))
        return exact_loop.drive(sequence, config, goal)


def table(rows: list[dict[str, Any]]) -> list[str]:
    """One line an idea."""
    whole = {r["seed"]: r for r in rows if r["idea"] == ALL}
    lines = ["| without | drives | reached | way / shortest | with all ideas, same beds | stops |", "|---" * 6 + "|"]
    for idea in dict.fromkeys(r["idea"] for r in rows):
        mine = [r for r in rows if r["idea"] == idea and r["shortest_way"]]
        both = [(r, whole[r["seed"]]) for r in mine if r["verdict"] == whole[r["seed"]]["verdict"] == "goal"]
        shortest = sum(r["shortest_way"] for r, _ in both)
        ways = [sum(pair[k]["way"] for pair in both) / shortest if both else float("nan") for k in (0, 1)]
        reached = sum(r["verdict"] == "goal" for r in mine)
        stops = sum(r["stops"] for r in mine) / max(len(mine), 1)
        lines.append(f"| {idea} | {len(mine)} | {reached} | {ways[0]:.3f} | {ways[1]:.3f} | {stops:.1f} |")
    return lines


def main() -> None:
    from rille.pipeline.engine.runtime.environment import prepare_environment

    given = arguments()
    prepare_environment()
    ideas = [ALL, *(given.idea or replacements())]
    rows = [json.loads(line) for line in given.out.read_text().splitlines()] if given.out.exists() else []
    done = {(r["seed"], r["cover"], r["idea"]) for r in rows}
    first, end = (int(v) for v in given.seeds.split(":"))
    for seed in range(first, end):
        for idea in ideas:
            if (seed, given.cover, idea) in done:
                continue
            rows.append({"seed": seed, "cover": given.cover, "idea": idea, **drive(seed, given.cover, idea)})
            with given.out.open("a") as file:
                file.write(json.dumps(rows[-1]) + "\n")
    asked = [r for r in rows if first <= r["seed"] < end and r["cover"] == given.cover and r["idea"] in ideas]
    print("\n".join(table(asked)))


if __name__ == "__main__":
    main()
