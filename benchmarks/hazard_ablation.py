"""What each idea of the hazards gains: classes of simulated pairs with one idea or one measure switched off at a time.

    benchmarks/hazard_ablation.py --scenes FOLDER [--seeds 20] [--cover 0.05 0.1 0.2]

The scenes and the truth are those of ``benchmarks/hazards.py``: the truth always has all seven measures. Shares are of
the observed cells.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from hazards import SLOPES, judge
from matching import start_process, table

ALL = "all ideas"
NEVER = 1e9


def replacements() -> dict[str, tuple[Any, str, Any]]:
    """Ideas and measures that a replaced attribute switches off: module, name, replacement."""
    from rille.stages.hazard import classification, measures, risk

    ideas: dict[str, tuple[Any, str, Any]] = {
        "median of fine cells": (measures, "MIN_FINE_CELLS", NEVER),
        "doubt by hidden ground": (classification, "HIDDEN_STEPS", 0.0),
        "higher probability at the limit": (classification, "LIFT", 0.0),
    }
    for measure in measures.MEASURES:
        rest = tuple(m for m in measures.MEASURES if m is not measure)
        ideas[measure.words] = (risk, "classify", partial(classification.classify, measures=rest))
    return ideas


def classes(scene: Any, idea: str) -> dict[str, Any]:
    """The risk map of a scene without an idea."""
    from hazard.scenes import CELL

    from rille.stages.hazard.risk import RiskParams, risk_map

    params = {"closed holes": RiskParams(max_hole=0.0), "added standard deviations": RiskParams(sigmas=0.0)}
    with ExitStack() as stack:
        if idea in replacements():
            stack.enter_context(patch.object(*replacements()[idea]))
        return risk_map(scene.elevation, scene.elevation_std, CELL, scene.vehicle, params.get(idea))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="scenes of each cover (default 20)")
    parser.add_argument("--cover", type=float, nargs="+", default=[0.05, 0.1, 0.2], help="rock covers")
    parser.add_argument("--scenes", type=Path, help="keep simulated pairs there")
    given = parser.parse_args()
    start_process(1)
    import numpy as np
    from hazard.scenes import CELL, kept

    from rille.stages.hazard.risk import risk_map

    ideas = [ALL, "closed holes", "added standard deviations", *replacements()]
    counts: dict[str, dict[str, int]] = {idea: {} for idea in ideas}
    for k, cover in enumerate(given.cover):
        for seed in range(1, given.seeds + 1):
            scene = kept(given.scenes, seed, cover, SLOPES[(seed + k) % len(SLOPES)], "default")
            exact = risk_map(scene.exact, np.zeros_like(scene.exact), CELL, scene.vehicle)
            for idea in ideas:
                found = judge(scene, exact, {"risk": classes(scene, idea)["risk"]})
                counts[idea] = {name: counts[idea].get(name, 0) + value for name, value in found.items()}
    shares = ("safe", "caution", "false safe", "enterable hazard", "false hazard")
    rows = [[idea, *(100 * c[name] / c["observed"] for name in shares)] for idea, c in counts.items()]
    table(f"{given.seeds * len(given.cover)} scenes", ["without", *(f"{name}, %" for name in shares)], rows)


if __name__ == "__main__":
    main()
