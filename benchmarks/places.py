"""A closed drive on the simulated bed: error at its end with and without the place seen again, and what is recomputed.

    python benchmarks/places.py                   seeds 1 to 3, 80 frames around a circle of 2.4 m
    python benchmarks/places.py --set loops.apart=5

Each bed is reconstructed twice with one cache: by the chain of frames alone, and adjusted to the first place, which the
last frames show again. The second run computes anew those world models whose pose has moved by more than a quarter of
a cell, and the world tiles that they touch.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from typing import Any

CIRCLE = {
    "frames": 80,
    "turn_deg": 4.5,
    "sideways": 0.0,
    "forward": 0.034,
    "bed_width": 3.0,
    "bed_length": 3.0,
    "image_width": 400,
    "image_height": 364,
    "focal_length": 420.0,
}
"""Parameters of the simulation: 80 turns of 4.5 degrees are a whole one."""


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, action="append", help="may be repeated (default 1 2 3)")
    parser.add_argument("--set", action="append", default=[], help="a parameter, section.key=value; may be repeated")
    return parser.parse_args()


def drive(seed: int, cache: str, more: dict[str, Any], *, enabled: bool) -> tuple[dict[str, Any], dict[str, str]]:
    """``report.json`` of a drive, and whether each task of it was computed or cached."""
    import rille

    settings: dict[str, Any] = {"hfvm": {"preset": "fast"}, "crosscheck": {"enabled": False}, **more}
    settings["loops"] = {**settings.get("loops", {}), "enabled": enabled}
    sequence = rille.open("mockup", mockup={**CIRCLE, "seed": seed})
    folder = rille.reconstruct(sequence, runs=f"{cache}/runs", cache=cache, quiet=True, **settings).folder
    rows = [json.loads(line) for line in (folder / "ledger.jsonl").read_text(encoding="utf-8").splitlines()]
    status = {row["label"]: row["status"] for row in rows if "label" in row}
    return json.loads((folder / "report.json").read_text(encoding="utf-8")), status


def main() -> None:
    """Drive each bed, with one cache for both runs."""
    from rille.pipeline.flow.config import parse_assignments

    given = arguments()
    print("| seed | places | largest correction, mm | end error without, % | with, % | models anew | tiles anew |")
    print("|---" * 7 + "|")
    for seed in given.seed or (1, 2, 3):
        with tempfile.TemporaryDirectory() as cache:
            (without, _), (adjusted, status) = (
                drive(seed, cache, parse_assignments(given.set), enabled=enabled) for enabled in (False, True)
            )
        loops = adjusted.get("loops", [])
        errors = [f"{report['metrics']['trajectory_drift']['value']:.4f}" for report in (without, adjusted)]
        anew = []
        for kind in ("locus/world/", "merge/"):
            here = [was for label, was in status.items() if label.startswith(kind)]
            anew.append(f"{here.count('computed')} of {len(here)}")
        most = max((1e3 * row["move_m"] for row in loops), default=0.0)
        print(f"| {' | '.join([str(seed), str(len(loops)), f'{most:.2f}', *errors, *anew])} |", flush=True)


if __name__ == "__main__":
    main()
