"""What each idea of a terrain model gains: Locus with one idea left out at a time, on pairs of the simulator.

Ratios to the model with all ideas, means over the pairs: RMS error of all cells, of the surest 70 % of the cells that
both cameras see, completeness; the shares of the errors within one and two standard deviations; and, of all cells with
an elevation, in per cent, those that are off by more than four of them. Seeds 1 to 3 are those that settings may be
chosen with, 4 to 6 those to judge by.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from rille.stages.terrain.locus import refinement, solve, uncertainty
from rille.stages.terrain.locus.solve import LocusParams
from rille.stages.terrain.locus.stage import MatchedPair, reconstruct
from rille.stages.terrain.matches import Matches

SEEDS = {"chosen": (1, 2, 3), "judged": (4, 5, 6)}
FRAMES = (0, 6)
SUREST = 0.7
"""Share of the cells that both cameras see."""

Changes = Mapping[tuple[Any, str], Any]
IDEAS: tuple[tuple[str, dict[str, Any], Changes], ...] = (
    ("refinement by both images", {"refine_steps": 0}, {}),
    ("second step of it", {"refine_steps": 1}, {}),
    ("edges in it", {}, {(refinement, "MAX_BEND_PX"): 1e9}),
    ("smoothness in it", {}, {(refinement, "BEND_STIFFNESS"): 40.0}),
    ("a window for the local mean", {}, {(refinement, "MEAN_SIDE_CELLS"): 1001}),
    ("limit of a jump", {}, {(solve, "MAX_JUMP_PX"): 1e9}),
    ("limit of the standard deviation", {"max_sigma": 1e9}, {}),
    ("doubt beside hidden ground", {}, {(uncertainty, "HOLE_VARIANCE_PX2"): 0.0}),
    ("doubt where cells moved", {}, {(uncertainty, "MIN_AREA_PX"): 1e9}),
    ("coarse to fine search", {}, {(solve, "COARSE_CELLS"): 1}),
)
"""What is left out, in words, as parameters, and as constants of modules."""
TWO_WAYS: tuple[tuple[str, dict[str, Any], Changes], ...] = (("both directions", {"both": False}, {}),)


def table(half: str) -> None:
    """Print the table of one half of the seeds."""
    scenes = list(_scenes(SEEDS[half]))
    print(
        "| left out | RMS error | of the surest 70 % | completeness | within 1 std | 2 std | beyond 4 std, % |\n"
        "|---|---|---|---|---|---|---|"
    )
    for ideas, given in ((IDEAS, {}), (TWO_WAYS, {"both": True})):
        whole = [_figures(scene, given, {}) for scene in scenes]
        _row("nothing" + (", both directions" if given else ""), whole, whole)
        for words, params, changes in ideas:
            _row(words, [_figures(scene, {**given, **params}, changes) for scene in scenes], whole)


def _scenes(seeds: tuple[int, ...]) -> Iterator[tuple[Any, dict[str, Any]]]:
    from stereo.pairs import fetcher

    from rille.datasets.registry import open_sequence
    from rille.pipeline.runs.options import cache_folder

    from .scenes import match, simulated

    fetch = fetcher(cache_folder(None))
    for seed in seeds:
        sequence = open_sequence("mockup-short", {"mockup": {"seed": seed}})
        for frame in FRAMES:
            scene = simulated(sequence, fetch, frame)
            yield scene, {side: match(scene, turned=side == "back") for side in ("forth", "back")}


def _figures(given: tuple[Any, dict[str, Any]], params: dict[str, Any], changes: Changes) -> list[float]:
    """RMS error of all and of the surest cells, completeness, shares within one and two and beyond four deviations."""
    (scene, found), before = given, {place: getattr(*place) for place in changes}
    chosen = LocusParams(**{"max_sigma": scene.max_sigma, **params})
    forth, back = (Matches(d.column, d.row, d.usable(np.inf), d.std) for d in (found["forth"], found["back"]))
    pair = MatchedPair(scene.left, forth, scene.right, back if chosen.both else None)
    try:
        for (module, name), value in changes.items():
            setattr(module, name, value)
        dem = reconstruct(pair, scene.rig, scene.T_local_left, scene.lattice, scene.z_range, chosen)
    finally:
        for (module, name), value in before.items():
            setattr(module, name, value)
    known = scene.judged & np.isfinite(dem.elevation)
    error, std = dem.elevation[known].astype(np.float64) - scene.truth[known], dem.elevation_std[known]
    surest = np.argsort(std, kind="stable")[: round(SUREST * scene.judged.sum())]
    rms = [float(np.sqrt(np.mean(e**2))) for e in (error, error[surest])]
    within = [float(np.mean(np.abs(error) < k * std)) for k in (1, 2)]
    # Hidden ground, too, where a spike beside a depth edge would stand.
    off = np.abs(dem.elevation.astype(np.float64) - scene.truth)
    given_cells = np.isfinite(off)
    beyond = 100.0 * float(np.mean((off > 4.0 * dem.elevation_std)[given_cells]))
    return [*rms, known.sum() / scene.judged.sum(), *within, beyond]


def _row(words: str, mine: list[list[float]], whole: list[list[float]]) -> None:
    a, b = (np.array(figures) for figures in (mine, whole))
    ratios = np.mean(a[:, :3] / b[:, :3], axis=0)
    cells = [*ratios, *a[:, 3:].mean(axis=0)]
    print(f"| {words} | {' | '.join(f'{v:.3f}' for v in cells)} |", flush=True)
