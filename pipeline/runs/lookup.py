"""Runs by the names that users type, and tasks of a run by their labels."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from itertools import combinations
from pathlib import Path
from typing import Any

from rille.pipeline.engine import events
from rille.stages.core.errors import ConfigError, RilleError, did_you_mean, warning
from rille.stages.core.quantities import count, some

LEDGER = "ledger.jsonl"


def all_runs(runs: Path) -> list[Path]:
    """Folders of all runs that have a ledger, in order of time within each sequence."""
    if runs.is_dir():
        os.scandir(runs).close()  # raises if the folder cannot be read, where glob would find nothing
    # Without the link `latest`, whose run is in the list; a pipe would block for ever.
    return sorted(p.parent for p in runs.glob(f"*/*/{LEDGER}") if p.is_file() and not p.parent.is_symlink())


def name(run: Path) -> str:
    """``sequence/run id``."""
    return f"{run.parent.name}/{run.name}"


@contextmanager
def reading(*runs: Path) -> Iterator[None]:
    """Turn errors of reading files of these runs into one line that they are not as Rille writes them.

    A run's folder may come from others, and be damaged or edited. The context should hold nothing else: faults of the
    program would be reported as faults of the files.

    Raises
    ------
    ConfigError
        The files are not as Rille writes them.
    """
    try:
        yield
    except RilleError:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError) as error:
        which, what = " or ".join(map(name, runs)), f"{type(error).__name__}: {error}"
        text = f"files of run {which} are not as Rille writes them ({what})"
        fault = "if it is your own and whole, this is a fault of Rille, and --debug shows where"
        remedy = f"run the same command again, or remove its folder; {fault}"
        raise ConfigError("RIL-980", text, remedy=remedy) from error


def find(text: str, runs: Path) -> Path:
    """Folder of a run: its path, or that of a sequence's runs; ``SEQUENCE`` (its latest), ``SEQUENCE/ID``, ``ID``, or
    ``latest`` of all.

    Raises
    ------
    ConfigError
        There is no such run; the message has the nearest names.
    """
    known = all_runs(runs)
    if text == "latest" and known:
        return max(known, key=lambda run: run.name).resolve()
    # Paths before names: in another folder of runs a user means the runs there.
    for path in (Path(text), Path(text, "latest"), runs / text, runs / text / "latest"):
        if (path / LEDGER).is_file():
            return path.resolve()
    # By its name alone, or the last one of a sequence none of whose runs has ended.
    for run in reversed(known):
        if text in (run.name, run.parent.name):
            return run.resolve()
    names = [word for run in known for word in (name(run), run.parent.name, run.name)]
    where = f"there are {some(sorted({run.parent.name for run in known}), 4)}" if known else f"{runs} holds none"
    raise ConfigError("RIL-067", f"no run {text!r}", remedy=did_you_mean(text, names) or where)


def elevation(text: str, runs: Path) -> Path:
    """Path of an elevation model: a file or folder, else the run of this name."""
    path = Path(text)
    if path.is_file() or (path / "dem.tif").exists():
        return path
    try:
        return find(text, runs)
    except ConfigError:
        return path  # its reader reports the error


def refuse_unknown(option: str, given: Iterable[str], known: Collection[str], what: str) -> None:
    """Refuse unknown names of an option.

    Raises
    ------
    ConfigError
        One of the ``given`` names is not ``known``; the message has the nearest names, or all.
    """
    for name in sorted(set(given).difference(known)):
        hint = did_you_mean(name, known) or f"one of {', '.join(sorted(known))}"
        raise ConfigError("RIL-035", f"{option} {name!r} is no {what}", remedy=hint)


def earlier(run: Path, *, of_any: bool = False) -> Iterator[Path]:
    """Runs of the same sequence (or of any) before this one, the latest first."""
    before = [r for r in all_runs(run.parent.parent) if r.name < run.name and (of_any or r.parent == run.parent)]
    yield from sorted(before, key=lambda r: r.name, reverse=True)


def tasks(run: Path) -> dict[str, dict[str, Any]]:
    """Rows of a run's ledger by the label of their task."""
    return {row["label"]: row for row in events.read(run / LEDGER)}


def used(run: Path) -> set[str]:
    """Keys of all artifacts that a run used.

    Raises
    ------
    ConfigError
        Its ledger cannot be read.
    """
    with reading(run):
        rows = (row for row in tasks(run).values() if row["status"] in ("computed", "cached"))
        return {str(row["key"]) for row in rows if "key" in row}


def shared_images(runs: Iterable[Path]) -> Iterator[str]:
    """Lines on runs that have images in common, as two of one sequence: what these show would count twice."""
    images = {
        run: {row.get("digest") for label, row in tasks(run).items() if label.startswith("image/left/")} - {None}
        for run in runs
    }
    for (a, ours), (b, theirs) in combinations(images.items(), 2):
        if both := len(ours & theirs):
            text = f"{count(both, 'left image')} of {name(b)} are those of {name(a)}, and count twice"
            yield warning("RIL-848", f"{text}: stated standard deviations are too small")
