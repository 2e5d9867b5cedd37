"""Errors of a run's elevation models by how sure they are of their cells: error over completeness, the surest first.

``python benchmarks/surest.py [--run RUN] [--cache FOLDER] [--runs FOLDER] [--at 0.6 0.7 0.78]``

Without a run it reconstructs the mockup with ``terrain.preset=accurate``. Each model is cut at the standard deviation
of its own at which so much is left of the cells that both cameras of a pair see (in the evaluation window); no truth
takes part in the choice. Printed are the RMS errors there, mm, the limit of the standard deviation at the last of them,
and the shares of all given cells below one and two standard deviations; and the time of Locus beside that of matching.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from rille.pipeline.engine.store.base import Store

    Floats = NDArray[np.floating[Any]]

SEQUENCE, PRESET = "mockup", "terrain.preset=accurate"


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", help="sequence, run or folder; default: a new run of the mockup")
    parser.add_argument("--cache", help="default: the one of `rille`")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="default runs")
    parser.add_argument("--at", type=float, nargs="+", default=[0.6, 0.7, 0.78], help="completenesses")
    return parser.parse_args()


def surest(error: Floats, sigma: Floats, wanted: int, completeness: float) -> tuple[float, float]:
    """RMS error of the surest cells, so many of the ``wanted`` ones, and the greatest standard deviation among them.

    ``error``, ``sigma``: (n,) of the cells that the model gives. NaN where it gives fewer.
    """
    import numpy as np

    count = round(completeness * wanted)
    if count > len(error) or not count:
        return math.nan, math.nan
    first = np.argsort(sigma, kind="stable")[:count]
    return float(np.sqrt(np.mean(error[first] ** 2))), float(sigma[first].max())


def judged(store: Store, rows: Mapping[str, Any], row: Mapping[str, Any]) -> tuple[Floats, Floats, int]:
    """Errors and standard deviations (n,) of what a task ``dem_accuracy`` has judged, and how many cells it wanted."""
    import numpy as np

    from rille.stages.evaluation.dem_accuracy import in_window
    from rille.stages.geometry.lattice import Lattice, mosaic

    def found(label: str) -> Any:
        ref = store.lookup(rows[label]["stage"], rows[label]["key"])
        if ref is None:
            sys.exit(f"the cache has no artifact of {label} any more: reconstruct again")
        return store.open(ref)

    truth, models = found(row["inputs"]["truth"]), [found(label) for label in row["inputs"]["dem"]]
    lattice = Lattice.from_dict(truth.meta["lattice"])
    at = [Lattice.from_dict(m.meta["lattice"]) for m in models]
    elevation, sigma = (
        mosaic([(part, np.asarray(m[name])) for part, m in zip(at, models, strict=True)], np.nan, lattice)
        for name in ("elevation", "elevation_std")
    )
    true = np.asarray(truth["elevation"])
    window = store.open(store.lookup(row["stage"], row["key"])).meta["window"]
    counts = (np.asarray(truth["seen"]) != 0) & in_window(lattice, window) & np.isfinite(true)
    given = counts & np.isfinite(elevation)
    return (elevation.astype(np.float64) - true)[given], sigma[given].astype(np.float64), int(counts.sum())


def figures(name: str, error: Floats, sigma: Floats, wanted: int, at: Sequence[float]) -> list[Any]:
    """A row of the table."""
    import numpy as np

    cut = [surest(error, sigma, wanted, share) for share in at]
    ratio = np.abs(error) / sigma
    whole = [len(error) / wanted, 1e3 * float(np.sqrt(np.mean(error**2)))]
    return [name, *whole, *(1e3 * rms for rms, _ in cut), 1e3 * cut[-1][1], np.mean(ratio < 1), np.mean(ratio < 2)]


def times(rows: Mapping[str, Any]) -> None:
    """Medians of what this run computed; the first tasks of a process, which compile, apart."""
    took = defaultdict(list)
    for label, row in rows.items():
        if row["status"] == "computed" and not row.get("first", False):
            took[label.rsplit("/", 1)[0]].append(row["kernel"])
    matching = sum(median(took[name]) for name in ("hfvm", "hfvm/back") if took[name])
    if matching and took["locus/local"]:
        locus = median(took["locus/local"])
        print(f"\nLocus {locus:.2f} s a pair, matching {matching:.2f} s: {locus / matching:.2f} times (medians)")


def main() -> None:
    given = arguments()
    from matching import say, start_process, table

    start_process(1)
    from rille.pipeline.engine import events
    from rille.pipeline.engine.store.base import Store
    from rille.pipeline.runs import lookup
    from rille.pipeline.runs.options import Options, cache_folder
    from rille.pipeline.runs.session import perform

    cache = cache_folder(given.cache)
    if given.run is None and perform(SEQUENCE, Options((PRESET,), runs=given.runs, cache=str(cache))).code:
        sys.exit("the run is not complete")
    folder = lookup.find(given.run or SEQUENCE, given.runs)
    rows = {row["label"]: row for row in events.read(folder / lookup.LEDGER)}
    store, found = Store(cache), []
    for label, row in rows.items():
        if row["stage"] == "dem_accuracy" and row["status"] in ("computed", "cached"):
            say(label)
            found.append(figures(label.partition("/")[2], *judged(store, rows, row), given.at))
    if not found:
        sys.exit(f"{lookup.name(folder)} has no elevations with a truth")
    headings = ["model", "given", "RMS, mm", *(f"at {share:g}" for share in given.at), "limit, mm", "1 std", "2 std"]
    table(f"{lookup.name(folder)}: elevations, the surest first", headings, sorted(found, key=_order))
    times(rows)


def _order(row: list[Any]) -> tuple[str, int]:
    kind, _, number = str(row[0]).partition("/")
    return kind, int(number) if number.isdigit() else -1


if __name__ == "__main__":
    main()
