"""Accuracy and time of whole runs: the README's table, from the reports of the runs themselves.

``python benchmarks/accuracy.py`` runs the built-in mockup and, where RILLE_DATA names a folder that has it, the street
``kitti06_51``. Runs resume from the cache; ``--cold`` starts from an empty one, which is what the seconds stand for.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

COLUMNS = (
    ("trajectory_drift", "drift"),
    ("trajectory_rpe_translation_rmse", "RPE a frame"),
    ("trajectory_ate_rmse", "ATE"),
    ("crosscheck_drift", "COLMAP's drift"),
    ("crosscheck_ate_rmse", "COLMAP's ATE"),
    ("agreement_share", "RMS distance to COLMAP"),
    ("dem_pairs_rmse_max", "DEM RMSE, worst pair"),
    ("dem_pairs_completeness_min", "completeness, worst pair"),
    ("dem_merged_rmse", "merged DEM RMSE"),
    ("dem_merged_tilt", "its vertical off by"),
    ("trajectory_nees", "NEES"),
    ("path_check_hazard_cells", "truly hazardous cells on the path"),
)


def sequences() -> list[str]:
    found = ["mockup"]
    street = Path(os.environ.get("RILLE_DATA") or "-") / "kitti06_51"
    return [*found, str(street)] if street.is_dir() else found


def report(sequence: str, settings: list[str], cold: bool) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="rille-bench-") as folder:
        cache = ["--cache", f"{folder}/cache"] if cold else []
        command = [
            sys.executable,
            "-m",
            "rille.pipeline.cli",
            "reconstruct",
            sequence,
            "--runs",
            f"{folder}/runs",
            *cache,
        ]
        command += [word for setting in settings for word in ("--set", setting)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        path = next(Path(folder).glob("runs/*/latest/report.json"))
        found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return found


def cell(metric: dict[str, Any] | None) -> str:
    if metric is None or metric.get("value") is None:
        return "-"
    value, unit = metric["value"], metric.get("unit") or ""
    return f"{value:.3g} {unit}".strip() if isinstance(value, int | float) else str(value)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequences", nargs="*", help="names or folders; the mockup and the street by default")
    parser.add_argument("--set", action="append", default=[], help="a parameter, section.key=value, of every run")
    parser.add_argument("--cold", action="store_true", help="start from an empty cache")
    parser.add_argument("--json", type=Path, help="write the metrics there too")
    given = parser.parse_args()
    found = {s: report(s, given.set, given.cold) for s in given.sequences or sequences()}
    print("| sequence | frames | seconds | " + " | ".join(words for _, words in COLUMNS) + " |")
    print("|---" * (3 + len(COLUMNS)) + "|")
    for r in found.values():
        values = [cell(r["metrics"].get(name)) for name, _ in COLUMNS]
        print(
            f"| {r['sequence']['name']} | {r['sequence']['frames']} | {r['seconds']:.0f} | " + " | ".join(values) + " |"
        )
    if given.json:
        given.json.write_text(json.dumps({s: r["metrics"] for s, r in found.items()}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
