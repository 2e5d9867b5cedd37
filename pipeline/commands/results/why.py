"""``rille why RUN [TASK]``: origin of results, and changes since the run before."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rille.pipeline.engine import provenance
from rille.pipeline.engine.keys import digest
from rille.pipeline.engine.memory import words
from rille.pipeline.engine.plain import brief
from rille.pipeline.engine.store.artifact import artifact_path
from rille.pipeline.engine.store.base import Store
from rille.pipeline.flow.config import build
from rille.pipeline.runs import lookup
from rille.pipeline.runs.options import RUNS, CacheFolder, Run, Runs, cache_folder
from rille.stages.core.errors import ConfigError, did_you_mean
from rille.stages.core.quantities import count, some

SHORT_DIGITS = 12
"""Shown hexadecimal digits of a digest."""

MAX_INPUTS = 8
"""Listed inputs of a port; more are counted."""

WIDTH = 70
"""Most characters of a value."""


def why(run: Run, task: str | None = None, *, runs: Runs = RUNS, cache: CacheFolder = None) -> None:
    """Explain one task of a run: its inputs, why it was computed, its parameters and code, what changed since.

    Parameters
    ----------
    task
        The task's label, as in the run's ledger.jsonl: hfvm/12, locus/world/12, trajectory; or a stage, for the reason
        of each of its tasks; without one all tasks by stage and reason.
    """
    folder = lookup.find(run, runs)
    with lookup.reading(folder):
        lines = summary(folder) if task is None else describe(folder, task, Store(cache_folder(cache)))
        print("\n".join(lines))


def summary(run: Path) -> Iterable[str]:
    """Lines on all tasks of a run: their number by stage, outcome and reason."""
    rows = lookup.tasks(run).values()
    yield f"{len(rows)} tasks in run {lookup.name(run)}"
    groups: dict[tuple[str, str, str], list[str]] = {}
    for row in rows:
        # Cached tasks need no reason.
        reason = "" if row["status"] == "cached" else brief(row.get("reason", ""), WIDTH)
        groups.setdefault((row["stage"], row["status"], reason), []).append(row["label"])
    for (stage, status, reason), labels in groups.items():
        yield f"{stage:24s} {len(labels):5d} {status:9s} {some(labels, 3)}{reason and f': {reason}'}"


def describe(run: Path, label: str, store: Store) -> Iterable[str]:
    """Lines on one task of a run, or on all tasks of a stage.

    Raises
    ------
    ConfigError
        The run has no such task and no such stage.
    """
    rows = lookup.tasks(run)
    if label not in rows:
        of_stage = [row for row in rows.values() if row["stage"] == label]
        if not of_stage:
            text = f"run {lookup.name(run)} has no task or stage {label!r}"
            nearest = did_you_mean(label, [*rows, *(row["stage"] for row in rows.values())])
            raise ConfigError("RIL-068", text, remedy=nearest or f"it has {some(list(rows), 4)}")
        yield f"{count(len(of_stage), 'task')} of stage {label} in run {lookup.name(run)}"
        yield from (f"{row['label']:24s} {row['status']:9s} {row.get('reason', '')}".rstrip() for row in of_stage)
        return
    row = rows[label]
    made = store.manifest(row["stage"], row["key"]) if "key" in row else None
    yield f"{label}: stage {row['stage']}, {row['status']} in run {lookup.name(run)}"
    if others := [other for other in rows if rows[other]["stage"] == label != other]:
        yield f"stage         {label} has also {some(others, 4)}"
    yield from _fate(row, run, made, store)
    yield from _inputs(row, rows)
    if made is None:
        if "key" in row and row["status"] in ("computed", "cached"):
            gone = f"{row['key'][:SHORT_DIGITS]} has gone from {store.root}, or the run used another cache (--cache)"
            yield f"artifact      {gone}: parameters and code are not known"
        return
    yield from _recipe(made)
    yield from _since(run, row, made, store)


def _fate(row: Mapping[str, Any], run: Path, made: Mapping[str, Any] | None, store: Store) -> Iterable[str]:
    cached = row["status"] == "cached"
    reason = f"an artifact of the same key was there{_computed_by(row, run)}" if cached else row.get("reason", "")
    yield f"why           {reason}"
    if row["status"] == "computed":
        yield f"took          {row['seconds']:.2f} s, of which the stage itself {row['kernel']:.2f} s"
    if "digest" in row:
        made_of = "stage, code, packages, parameters, arguments, inputs' digests"
        yield f"key           {row['key'][:SHORT_DIGITS]} ({made_of})"
        facts = ""
        if made is not None:
            path = artifact_path(made["stage"], made["key"])
            size = words((store.root / path).stat().st_size)
            facts = f", {size} in {path}: {', '.join(made['arrays']) or 'metadata only'}"
        yield f"result        digest {row['digest'][:SHORT_DIGITS]}{facts}"


def _computed_by(row: Mapping[str, Any], run: Path) -> str:
    """The kept run that computed it, in words."""
    for before in lookup.earlier(run, of_any=True):
        for other in lookup.tasks(before).values():
            if other.get("key") == row.get("key") and other["status"] == "computed":
                return f"; run {lookup.name(before)} computed it"
    return f"; no run that is kept in {run.parent.parent} computed it"


def _inputs(row: Mapping[str, Any], rows: Mapping[str, Mapping[str, Any]]) -> Iterable[str]:
    for port, given in row.get("inputs", {}).items():
        labels = given if isinstance(given, list) else [given]
        for label in labels[:MAX_INPUTS]:
            up = rows.get(label, {})
            result = f"digest {up['digest'][:SHORT_DIGITS]}, " if "digest" in up else ""
            yield f"input         {port:12s} {label:24s} {result}{up.get('status', 'not known')}"
        if len(labels) > MAX_INPUTS:
            states = sorted({str(rows.get(label, {}).get("status")) for label in labels[MAX_INPUTS:]})
            yield f"input         {port:12s} and {len(labels) - MAX_INPUTS} more, {' or '.join(states)}"


def _recipe(made: Mapping[str, Any]) -> Iterable[str]:
    """Parameters, arguments, code and environment of an artifact."""
    past = made["provenance"]
    section, defaults = _section(made["stage"], past["params"])
    for name, value in past["params"].items():
        differs = name in defaults and defaults[name] != value
        note = f"   (default: {brief(defaults[name], WIDTH)})" if differs else ""
        yield f"parameter     {section}.{name} = {brief(value, WIDTH)}{note}"
    yield from (f"argument      {name} = {brief(value, WIDTH)}" for name, value in past["args"].items())
    yield from (f"source        {name} = {value}" for name, value in past.get("hints", {}).items())
    code = sorted(past["code"])
    yield f"code          {digest(past['code'])[:SHORT_DIGITS]} of {len(code)} modules: {some(code, 6)}"
    packages = ", ".join(f"{name} {version}" for name, version in sorted(past["env"].items()))
    yield f"packages      {packages or 'none declared'}"
    when = datetime.fromtimestamp(past["started"], UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    host = past["host"]
    yield f"computed      {when}, Python {past['python']}, {host['name']} ({host['machine']}, {host['cpus']} cores)"


def _section(stage: str, params: Mapping[str, Any]) -> tuple[str, Mapping[str, Any]]:
    """Section of the configuration with a stage's parameters, and its defaults.

    Several stages may share a section, as those of a tile share the matcher's.
    """
    known = build().model_dump(mode="json")
    shared = (name for name, values in known.items() if values.keys() == params.keys())
    section = stage if stage in known else next(shared, stage)
    return section, known.get(section, {})


def _since(run: Path, row: Mapping[str, Any], made: Mapping[str, Any], store: Store) -> Iterable[str]:
    """Differences from the last earlier run that had this task."""
    past = ((before, lookup.tasks(before).get(row["label"])) for before in lookup.earlier(run))
    before, other = next(((before, other) for before, other in past if other and "key" in other), (run, None))
    if other is None:
        yield "since         no earlier run of this sequence had this task"
        return
    if other["key"] == row["key"]:
        found = ["nothing changed, the key is the same"]
    elif (then := store.manifest(row["stage"], other["key"])) is None:
        found = ["another key; its artifact has gone, so what differs is not known"]
    else:
        found = provenance.differences(then["provenance"], made["provenance"]) or ["the key has another format"]
        if other.get("digest") == row.get("digest"):
            found.append("another key, and yet the result is the same to the bit")
    yield from (f"since         {lookup.name(before)}: {difference}" for difference in found)
