"""Artifacts of a run by their labels, and the export of a run in one form."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

from rille.pipeline.engine import events
from rille.pipeline.engine.graph import first_label
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.store.base import Store
from rille.pipeline.export.writers import check_folder
from rille.stages.core.declare import Bundle
from rille.stages.core.errors import InputError

FILES = {"laz": "cloud.laz", "ply": "cloud.ply", "glb": "terrain.glb"}
"""Forms that are one file, and its usual name; any other is a folder named by its form. The module of that name,
without ending, writes it."""


def export_run(form: str, run: Path, target: Path, store: Store, **thinning: float) -> str:
    """Export a run folder in a form, such as ``laz`` or ``colmap``, whole or not at all; return its content, in words.

    Parameters
    ----------
    thinning : of points, see :func:`rille.pipeline.export.programs.cloud.write_run`.

    Raises
    ------
    InputError
        The run has nothing for this form, or its artifacts are gone from the cache.
    ConfigError
        A folder is to be written, and ``target`` is no empty one.
    """
    if form not in FILES:
        check_folder(target)
    module = Path(FILES.get(form, form)).stem
    write_run = import_module(f"rille.pipeline.export.programs.{module}").write_run
    with atomic.replacing(target) as temporary:
        words: str = write_run(temporary, RunArtifacts(run, store), **thinning)
    return words


class RunArtifacts:
    """The artifacts in the ledger of a run; arrays are read at access.

    If the run has corrected its calibration, a label stands for the task that was laid out last.
    """

    def __init__(self, run: Path, store: Store) -> None:
        self.run, self._store = run, store

    @cached_property
    def _rows(self) -> dict[str, dict[str, Any]]:
        ledger = self.run / "ledger.jsonl"
        outdated = set(events.facts(ledger).get("outdated", ()))
        made = (row for row in events.read(ledger) if row["status"] in ("computed", "cached") and "key" in row)
        return {first_label(row["label"]): row for row in made if row["label"] not in outdated}

    def find(self, label: str) -> Bundle | None:
        """The artifact of exactly this label; None if the run has none."""
        return self._open(label) if label in self._rows else None

    def one(self, label: str, *, last: bool = False) -> Bundle:
        """The artifact of this label, else the first (or last) whose label begins with it."""
        # With the slash, so that "merge" does not match other stages whose names begin with it.
        begun = [name for name in self._rows if f"{name}/".startswith(f"{label}/")]
        if not begun:
            text = f"the run has no {label}"
            remedy = "run the same command again if it was stopped; else its report says why"
            raise InputError("RIL-609", text, remedy=remedy)
        return self._open(label if label in begun else begun[-1 if last else 0])

    def all(self, stage: str) -> dict[str, Bundle]:
        """All artifacts of a stage by the rest of their labels."""
        names = [name for name, row in self._rows.items() if row["stage"] == stage]
        return {name.partition("/")[2]: self._open(name) for name in names}

    def labels(self, pattern: str) -> list[str]:
        """The first group of a pattern in each label that it matches as a whole."""
        return [match[1] for name in self._rows if (match := re.fullmatch(pattern, name))]

    def input(self, label: str, port: str) -> Bundle:
        """The artifact that a task of the run has read at a port."""
        self.one(label)
        return self.one(first_label(self._rows[label]["inputs"][port]))

    def left_image(self, frame: int) -> Bundle:
        """The left image of an ideal camera, which was matched and tracked."""
        undistorted = self.find(f"undistort/left/{frame}")
        return self.one(f"image/left/{frame}") if undistorted is None else undistorted

    def risk(self) -> Bundle:
        """Risk map of the world; of a drive, what it knew at its last stop."""
        stops = [int(stop) for stop in self.labels(r"risk/(\d{1,9})")]
        return self.one(f"risk/{max(stops)}" if stops and "risk/world" not in self._rows else "risk/world")

    def digests(self) -> Iterator[tuple[str, str]]:
        """Label and SHA-256 of each file that a task of the run has read, by its artifact."""
        for label, row in self._rows.items():
            made = self._store.manifest(str(row["stage"]), str(row["key"])) if not row.get("inputs") else None
            args = {} if made is None else made["provenance"]["args"]
            yield from ((label, value) for value in (args.get("sha256"), *args.get("digests", {}).values()) if value)

    def _open(self, label: str) -> Bundle:
        row = self._rows[label]
        ref = self._store.lookup(str(row["stage"]), str(row["key"]))
        if ref is None:
            raise InputError("RIL-610", f"{label} is not in the cache", remedy="name the run's cache with --cache")
        return self._store.open(ref)
