"""What each idea costs and gains, left out or changed one at a time: steps of preset ``accurate``, or of navigation.

    RILLE_DATA=... python benchmarks/ablation.py [navigation | terrain] [--half judged]

Navigation: pieces of the street and of the mockup (``benchmarks/odometry/ideas.py``), also with a knocked rig; lost
frames, error a frame and drift, over those with all ideas. Terrain: pairs of the simulator
(``benchmarks/gridding/ideas.py``). The rest of this page is on the matcher.

Pairs: those that settings may be chosen with (``CHOSEN`` of ``benchmarks/stereo/pairs.py``) and the mockup, or with
``--half judged`` the others. Time: processor seconds a pair on one thread, both directions, over those of OpenCV's SGBM
3WAY on the same pairs in the same run. Bad-1 and bad-2 after filling over SGBM's, means of the pairs' ratios: once
filled alike, once by Rille's own filling. Bad-2 of the matched, their median error and the completeness: means.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import Any

STEPS = (
    ("accurate", ""),
    ("no propagation along paths", "without=paths"),
    ("no variational refinement", "without=smooth"),
    ("no placement of depth edges", "without=edges"),
    ("no planes without texture", "without=planes"),
    ("no Lucas-Kanade step", "without=refine"),
    ("lonely matches kept", "min_support=0"),
)
"""What is changed, in words and as parameters."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--half", choices=("chosen", "judged"), default="chosen", help="of the pairs (chosen)")
    ideas = ("accurate", "navigation", "terrain")
    parser.add_argument("of", nargs="?", choices=ideas, default="accurate", help="whose ideas")
    given = parser.parse_args()
    from rille.pipeline.engine.runtime.environment import prepare_environment

    prepare_environment()
    if given.of == "navigation":
        from odometry import ideas as of_navigation

        of_navigation.table(Path(os.environ["RILLE_DATA"]), given.half)
        return
    if given.of == "terrain":
        from gridding import ideas as of_terrain

        of_terrain.table(given.half)
        return
    from stereo import methods
    from stereo.pairs import halves, mockup

    methods.set_threads(1)
    pairs = [*halves()[given.half], *([mockup()] if given.half == "chosen" else [])]
    peer = next(m for m in methods.opencv() if m.name == "SGBM 3WAY")
    print(f"pairs ({given.half}): {', '.join(pair.name for pair in pairs)}\n")
    print(
        "| | time | filled: bad-1 | bad-2 | own filling: bad-1 | bad-2 | matched: bad-2 | median, px | completeness |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    peers = [judged(peer, pair) for pair in pairs]
    tell("SGBM 3WAY", peers, peers)
    tell("default", [judged(variant("preset=default"), pair) for pair in pairs], peers)
    for words, changed in STEPS:
        method = variant(f"preset=accurate {changed}")
        tell(words, [judged(method, pair) for pair in pairs], peers)


def variant(text: str) -> Any:
    """The matcher with these parameters, compiled."""
    import numpy as np
    from stereo import methods
    from stereo.pairs import Pair

    method = methods.hfvm([text], 1)[-1]
    noise = np.random.default_rng(0).integers(0, 256, (64, 96), dtype=np.uint8)
    method.run(Pair("warm-up", noise, noise, None, 0, 15))
    return method


def judged(method: Any, pair: Any) -> dict[str, float]:
    """Figures of one pair, and the processor seconds that matching it took."""
    from stereo.measures import Found, error, judge

    begun = time.process_time()
    raw = method.run(pair)
    seconds = time.process_time() - begun
    found = method.read(raw, pair)
    figures = {**judge(found, pair.truth), "seconds": seconds}
    figures |= {"bad1_own": figures["bad1"], "bad2_own": figures["bad2"]}
    if found.dense is not None:
        off = error(Found(found.dense[0], found.dense[1], found.matched, found.rows), pair.truth)[pair.truth.known]
        figures |= {f"bad{n}_own": float((~(off <= n)).mean()) for n in (1, 2)}
    return figures


def tell(words: str, mine: list[dict[str, float]], peers: list[dict[str, float]]) -> None:
    """One line of the table."""

    def mean(values: list[float]) -> float:
        return sum(values) / len(values)

    ratio = sum(f["seconds"] for f in mine) / sum(p["seconds"] for p in peers)
    over = [mean([f[k] / p[k] for f, p in zip(mine, peers, strict=True)]) for k in ("bad1", "bad2")]
    over += [mean([f[f"{k}_own"] / p[k] for f, p in zip(mine, peers, strict=True)]) for k in ("bad1", "bad2")]
    plain = [mean([f[k] for f in mine]) for k in ("bad2_matched", "median", "completeness")]
    cells = [f"{ratio:.1f}", *(f"{v:.3f}" for v in over + plain)]
    print(f"| {words} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
