"""``rille compare A B``: differences of parameters, tasks, figures and positions of two runs."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from rille.datasets.manifest.opening import dotted
from rille.datasets.text.reading import read_toml
from rille.pipeline.python import runs as opened
from rille.pipeline.runs import lookup
from rille.pipeline.runs.options import RUNS, Run, Runs
from rille.stages.core.quantities import metres, quantity

BEGINS = "another result, the first to differ"


def compare(a: Run, b: Run, *, runs: Runs = RUNS) -> None:
    """Compare two runs: which parameters, tasks, figures and positions differ.

    Their elevations: rille compare-dem A B.
    """
    one, other = both = lookup.find(a, runs), lookup.find(b, runs)
    # Read all before anything is printed.
    with lookup.reading(*both):
        reports = [opened.Run(run).report for run in both]
        settings = [dict(dotted(read_toml(run / "config.toml", "configuration"))) for run in both]
        lines = [*_parameters(*settings), *_tasks(*both), *_figures(*reports), _positions(*both)]
    heads = [f"{letter} {lookup.name(run)}" for letter, run in (("A", one), ("B", other))]
    print("\n".join([*(head + _frames(report) for head, report in zip(heads, reports, strict=True)), *lines]))


def _frames(report: Mapping[str, Any]) -> str:
    """Which frames of its sequence a run has, in words."""
    of = report.get("sequence", {})
    return f"  frames {of['first']} to {of['last']}: {of['frames']} of {of['frames_of_sequence']}" if of else ""


def _parameters(a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[str]:
    names = [name for name in {**a, **b} if a.get(name) != b.get(name)]
    yield f"parameters    {len(names) or 'none'} differ"
    for name in names:
        one, other = (json.dumps(table[name]) if name in table else "not set" for table in (a, b))
        yield f"  {name}: {one} -> {other}"


def _tasks(a: Path, b: Path) -> Iterator[str]:
    """Counts by stage: tasks with another result, and tasks with a result in one run alone, or in neither.

    Tasks that differ though their inputs do not are where the difference begins; `rille why` says of one by what.
    """
    ledgers = [lookup.tasks(run) for run in (a, b)]
    # A failed or skipped task has no digest.
    digests = {label: tuple(rows.get(label, {}).get("digest") for rows in ledgers) for label in ledgers[0] | ledgers[1]}
    fates = {label: _fate(*pair) for label, pair in digests.items()}
    total = Counter(fates.values())
    for label in [name for name, fate in fates.items() if fate == "another result"]:
        read, also = (rows[label].get("inputs", {}) for rows in ledgers)
        names = chain.from_iterable(np.ravel(one) for one in read.values())
        if read == also and all(len({*digests.get(name, ())}) < 2 for name in names):
            fates[label] = BEGINS
    yield f"tasks         {total['the same result']} with the same result, {total['another result']} with another"
    stages = Counter((fate, (ledgers[1] | ledgers[0])[label]["stage"]) for label, fate in fates.items())
    yield from (f"  {stage}: {n} {fate}" for (fate, stage), n in stages.items() if fate != "the same result")
    if first := next((label for label, fate in fates.items() if fate == BEGINS), ""):
        yield f"  by the manifest, parameters, files or code: rille why {lookup.name(b)} {first}"


def _fate(a: str | None, b: str | None) -> str:
    if a and b:
        return "the same result" if a == b else "another result"
    return "in A alone" if a else "in B alone" if b else "without a result in both"


def _figures(a: Mapping[str, Any], b: Mapping[str, Any]) -> Iterator[str]:
    """Figures of the report, without times, that differ."""
    one, other = a["metrics"], b["metrics"]
    # Compared in words, of three digits, to avoid "12.3 -> 12.3".
    words = {name: [_in_words(m.get(name)) for m in (one, other)] for name in one | other if name != "wall_clock"}
    differ = [name for name, (before, after) in words.items() if before != after]
    yield f"figures       {len(words) - len(differ)} equal to three digits, {len(differ)} differ"
    yield from (f"  {(one | other)[name]['label']}: {' -> '.join(words[name])}" for name in differ)


def _in_words(metric: Mapping[str, Any] | None) -> str:
    return "none" if metric is None else quantity(metric["value"], metric["unit"])


def _positions(a: Path, b: Path) -> str:
    if not all((run / "trajectory.kitti").exists() for run in (a, b)):
        return "positions     not both runs have a trajectory"
    one, other = (opened.Run(run).trajectory for run in (a, b))
    _, rows, others = np.intersect1d(one.time, other.time, return_indices=True)
    posed, also = (np.isfinite(run.position.values).all(axis=1) for run in (one, other))
    known = posed[rows] & also[others]
    rows, others, how = rows[known], others[known], ""
    if not rows.size:
        return "positions     no frame has a pose in both"
    here, there = one.position.values[rows], other.position.values[others]
    if one.time[posed][0] != other.time[also][0]:  # the world of each begins at its first frame
        turn = one.rotation.values[rows[0]] @ other.rotation.values[others[0]].T
        there, how = (there - there[0]) @ turn.T + here[0], ", the first of them laid on each other"
    apart = np.linalg.norm(here - there, axis=1)
    rms = metres(float(np.sqrt(np.mean(apart**2))))
    return f"positions     of {apart.size} frames{how}: RMS {rms}, at most {metres(float(apart.max()))} apart"
