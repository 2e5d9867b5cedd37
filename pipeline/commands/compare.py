"""``rille compare A B``: which parameters, tasks, figures, poses and elevations of two runs differ."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rille.datasets.text.reading import TABLE, read_lines, read_text, read_toml
from rille.pipeline.commands import compare_dem
from rille.pipeline.commands.options import check_output
from rille.pipeline.engine import events
from rille.pipeline.engine.failures import reported
from rille.pipeline.export.read_dem import read_elevation
from rille.pipeline.report.words import metres, quantity
from rille.pipeline.runs import lookup
from rille.stages.core.errors import ConfigError, InputError


def compare(a: Path, b: Path, output: Path) -> int:
    """Print what differs between two runs, and draw the difference of their elevations; gives the exit code.

    Raises
    ------
    ConfigError
        One of the runs did not come to its end, or the picture cannot be written.
    """
    # All before anything is printed: where something cannot be read or written there is no half of a comparison.
    check_output(output, ".png", ".pdf", ".svg")
    with lookup.reading(a, b):
        reports = [_report(run) for run in (a, b)]
        settings = [_flat(read_toml(run / "config.toml", "configuration")) for run in (a, b)]
        lines = [*_parameters(*settings), *_tasks(a, b), *_figures(*reports), _positions(a, b)]
    terrain = _elevations(a, b, output)
    print("\n".join([f"A {lookup.name(a)}", f"B {lookup.name(b)}", *lines, terrain]))
    return 0


def _report(run: Path) -> dict[str, Any]:
    path = run / "report.json"
    if not path.exists():
        raise ConfigError(
            "RIL-890", f"run {lookup.name(run)} did not come to its end", remedy="run the same command again"
        )
    found: dict[str, Any] = json.loads(read_text(path, "report", TABLE))
    return found


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values of nested tables by dotted names."""
    found: dict[str, Any] = {}
    for name, value in table.items():
        found |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return found


def _parameters(a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[str]:
    names = [name for name in {**a, **b} if a.get(name) != b.get(name)]
    yield f"parameters    {len(names) or 'none'} differ"
    for name in names:
        one, other = (json.dumps(table[name]) if name in table else "not set" for table in (a, b))
        yield f"  {name}: {one} -> {other}"


def _tasks(a: Path, b: Path) -> Iterator[str]:
    """Counts by stage: tasks with another result, and those of which one run alone or neither has a result."""
    every = [{row["label"]: row for row in events.read(run / lookup.LEDGER)} for run in (a, b)]
    # A task that failed or was left out has no digest.
    one, other = ({label: row for label, row in rows.items() if row.get("digest")} for rows in every)
    common = [label for label in one if label in other]
    changed = [label for label in common if one[label]["digest"] != other[label]["digest"]]
    neither = [label for label in every[0] if label in every[1] and label not in one and label not in other]
    yield f"tasks         {len(common) - len(changed)} with the same result, {len(changed)} with another"
    for words, rows, labels in (
        ("another result", one, changed),
        ("in A alone", one, [label for label in one if label not in other]),
        ("in B alone", other, [label for label in other if label not in one]),
        ("without a result in both", every[0], neither),
    ):
        for stage, count in Counter(rows[label]["stage"] for label in labels).items():
            yield f"  {stage}: {count} {words}"


def _figures(a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[str]:
    """Figures of the report that differ or that one run alone has; times are no results."""
    one, other = a["metrics"], b["metrics"]
    both = [name for name in one if name in other and name != "wall_clock"]
    differ = [name for name in both if one[name]["value"] != other[name]["value"]]
    shown = {name: [quantity(m[name]["value"], m[name]["unit"]) for m in (one, other)] for name in differ}
    # What differs only beyond the digits shown would read as "12.3 -> 12.3".
    seen = [name for name, (before, after) in shown.items() if before != after]
    equal = f"{len(both) - len(differ)} equal, {len(differ) - len(seen)} equal to three digits"
    yield f"figures       {equal}, {len(seen)} differ"
    yield from (f"  {one[name]['label']}: {' -> '.join(shown[name])}" for name in seen)
    for words, metrics, without in (("in A alone", one, other), ("in B alone", other, one)):
        alone = [name for name in metrics if name not in without and name != "wall_clock"]
        yield from (
            f"  {metrics[n]['label']}: {quantity(metrics[n]['value'], metrics[n]['unit'])} {words}" for n in alone
        )


def _positions(a: Path, b: Path) -> str:
    paths = [run / "trajectory.tum" for run in (a, b)]
    if not all(path.exists() for path in paths):
        return "positions     not both runs have a trajectory"
    rows = (np.loadtxt(read_lines(path, "trajectory"), ndmin=2) for path in paths)
    one, other = ({row[0]: row[1:4] for row in found} for found in rows)
    common = [time for time in one if time in other]
    if not common:
        return "positions     no frame has a pose in both"
    apart = np.array([np.linalg.norm(one[time] - other[time]) for time in common])
    rms = float(np.sqrt(np.mean(apart**2)))
    return f"positions     of {len(common)} frames: RMS {metres(rms)}, at most {metres(float(apart.max()))} apart"


def _elevations(a: Path, b: Path, output: Path) -> str:
    try:
        models = [read_elevation(run) for run in (a, b)]
        compare_dem.check(*models)
        found, error, slope, distance = compare_dem.measure(models[0], models[1])
    except InputError as problem:
        return f"elevations    not compared: {problem}"
    with reported("RIL-892", f"{output} cannot be written", remedy="name another with -o", kind=ConfigError):
        compare_dem.draw(output, found, error, slope, distance)
    known = np.isfinite(error)
    moved, most = int(np.count_nonzero(error[known])), float(np.abs(error[known]).max(initial=0.0))
    rms = float(np.sqrt(np.mean(np.square(error[known]))))
    return (
        f"elevations    {moved} of {int(known.sum())} common cells differ: RMS {metres(rms)}, at most {metres(most)}\n"
        f"{output}"
    )
