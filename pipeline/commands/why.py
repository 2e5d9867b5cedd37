"""``rille why RUN TASK``: where a result comes from, and what has changed since the run before."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rille.pipeline.engine import events, provenance
from rille.pipeline.engine.keys import digest
from rille.pipeline.engine.memory import words
from rille.pipeline.engine.plain import brief, some
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.manifest import artifact_path
from rille.pipeline.flow.config import modules, stage
from rille.pipeline.runs import lookup

SHORT = 12
"""Hexadecimal digits of a digest that are shown."""

INPUTS = 8
"""Inputs of one port that are listed; more are counted."""

WIDTH = 70
"""Characters of a value."""


def describe(run: Path, label: str, store: Store) -> Iterable[str]:
    """Lines on one task of a run.

    Raises
    ------
    ConfigError
        The run has no such task.
    """
    rows = events.read(run / lookup.LEDGER)
    row = lookup.row(rows, label, run)
    made = store.manifest(row["stage"], row["key"]) if "key" in row else None
    yield f"{label}: stage {row['stage']}, {row['status']} in run {lookup.name(run)}"
    yield from _fate(row, run, made)
    yield from _inputs(row, {r["label"]: r for r in rows})
    if made is None:
        if "key" in row and row["status"] in ("computed", "cached"):
            gone = f"{row['key'][:SHORT]} has gone from {store.root}, or the run used another cache (--cache)"
            yield f"artifact      {gone}: parameters and code are not known"
        return
    yield from _recipe(made)
    yield from _since(run, row, made, store)


def _fate(row: Mapping[str, Any], run: Path, made: Mapping[str, Any] | None) -> Iterable[str]:
    if row["status"] == "computed":
        yield f"why           {row.get('reason', '')}"
        yield f"took          {row['seconds']:.2f} s, of which the stage itself {row['kernel']:.2f} s"
    elif row["status"] == "cached":
        yield f"why           an artifact of the same key was there{_computed_by(row, run)}"
    else:
        yield f"why           {row.get('reason', '')}"
    if "digest" in row:
        yield f"key           {row['key'][:SHORT]} (stage, code, packages, parameters, arguments, inputs' digests)"
        facts = ""
        if made is not None:
            path = artifact_path(made["stage"], made["key"])
            facts = f", {words(made['size'])} in {path}: {', '.join(made['arrays']) or 'metadata only'}"
        yield f"result        digest {row['digest'][:SHORT]}{facts}"


def _computed_by(row: Mapping[str, Any], run: Path) -> str:
    """Which kept run computed it."""
    for before in lookup.earlier(run, of_any=True):
        for other in events.read(before / lookup.LEDGER):
            if other.get("key") == row["key"] and other["status"] == "computed":
                return f"; run {lookup.name(before)} computed it"
    return "; the run that computed it is not kept"


def _inputs(row: Mapping[str, Any], rows: Mapping[str, Mapping[str, Any]]) -> Iterable[str]:
    for port, given in row.get("inputs", {}).items():
        labels = given if isinstance(given, list) else [given]
        for label in labels[:INPUTS]:
            up = rows.get(label, {})
            found = f"digest {up['digest'][:SHORT]}, " if "digest" in up else ""
            yield f"input         {port:12s} {label:24s} {found}{up.get('status', 'not known')}"
        if len(labels) > INPUTS:
            states = sorted({str(rows.get(label, {}).get("status")) for label in labels[INPUTS:]})
            yield f"input         {port:12s} and {len(labels) - INPUTS} more, {' or '.join(states)}"


def _recipe(made: Mapping[str, Any]) -> Iterable[str]:
    """Parameters, arguments, code and environment of an artifact."""
    past = made["provenance"]
    defaults = _defaults(made["stage"])
    for name, value in past["params"].items():
        differs = name in defaults and defaults[name] != value
        note = f"   (default: {brief(defaults[name], WIDTH)})" if differs else ""
        yield f"parameter     {made['stage']}.{name} = {brief(value, WIDTH)}{note}"
    yield from (f"argument      {name} = {brief(value, WIDTH)}" for name, value in past["args"].items())
    modules = sorted(past["code"])
    yield f"code          {digest(past['code'])[:SHORT]} of {len(modules)} modules: {some(modules, 6)}"
    packages = ", ".join(f"{name} {version}" for name, version in sorted(past["env"].items()))
    yield f"packages      {packages or 'none declared'}"
    when = datetime.fromtimestamp(past["started"], UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    host = past["host"]
    yield f"computed      {when}, Python {past['python']}, {host['name']} ({host['machine']}, {host['cpus']} cores)"


def _defaults(name: str) -> dict[str, Any]:
    if name not in modules():
        return {}
    return stage(name).params().model_dump(mode="json")


def _since(run: Path, row: Mapping[str, Any], made: Mapping[str, Any], store: Store) -> Iterable[str]:
    """What is different from the last run before that had this task."""
    for before in lookup.earlier(run):
        # The last run that had the task decides; what differs from runs before that one, its own `why` tells.
        other = next(
            (r for r in events.read(before / lookup.LEDGER) if r["label"] == row["label"] and "key" in r), None
        )
        if other is None:
            continue
        if other["key"] == row["key"]:
            yield f"since         {lookup.name(before)}: nothing changed, the key is the same"
            return
        then = store.manifest(row["stage"], other["key"])
        if then is None:
            known = "another key; its artifact has gone, so what differs is not known"
            yield f"since         {lookup.name(before)}: {known}"
            return
        found = provenance.differences(then["provenance"], made["provenance"]) or ["the key has another format"]
        yield from (f"since         {lookup.name(before)}: {difference}" for difference in found)
        if other.get("digest") == row.get("digest"):
            yield f"since         {lookup.name(before)}: another key, and yet the result is the same to the bit"
        return
    yield "since         no earlier run of this sequence had this task"
