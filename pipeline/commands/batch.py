"""Several sequences in one command: each is a separate run, and a table has the outcome of all."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from rille.pipeline.commands.complaints import complain
from rille.pipeline.engine.failures import translated
from rille.pipeline.runs.options import COMPLETE, FAILED, HOLES, USAGE

STATES = {COMPLETE: "complete", HOLES: "with holes", USAGE: "refused", FAILED: "failed"}


class Ended(NamedTuple):
    """Outcome of a sequence: exit code, folder of its run, and seconds.

    Without a folder, ``error`` is the code or the type of the error.
    """

    sequence: str
    code: int
    folder: Path | None
    seconds: float
    error: str = ""


def each(sequences: Sequence[str], one: Callable[[str], tuple[int, Path | None]], *, keep_going: bool) -> list[Ended]:
    """Call ``one`` for each sequence, up to the first error unless ``keep_going``."""
    ended = []
    for number, sequence in enumerate(sequences, 1):
        print(f"rille: {sequence} ({number} of {len(sequences)})", file=sys.stderr)
        begin, wrong = time.monotonic(), ""
        try:
            code, folder = one(sequence)
        except Exception as error:  # faults of the program too: they may not affect the others
            code, folder, known = complain(error), None, translated(error)
            wrong = type(error).__name__ if known is None else known.code
        ended.append(Ended(sequence, code, folder, time.monotonic() - begin, wrong))
        if code in (USAGE, FAILED) and not keep_going:
            break
    return ended


def worst(ended: Sequence[Ended]) -> int:
    """The most severe of the exit codes."""
    # The least severe first.
    return max((one.code for one in ended), key=(COMPLETE, HOLES, USAGE, FAILED).index)


def table(ended: Sequence[Ended], sequences: Sequence[str]) -> str:
    """A line for each sequence: state, share of frames with a pose, drift, number of missing products, tasks, time, and
    the folder of its run or the code of its error."""
    width = max(map(len, ("sequence", *sequences)))

    def line(name: str, state: str, figures: Sequence[str], end: str) -> str:
        widths = (6, 8, 7, 8, 6, 8)
        words = " ".join(f"{figure:>{w}s}" for figure, w in zip(figures, widths, strict=True))
        return f"{name:{width}s}  {state:10s} {words}  {end}".rstrip()

    lines = [line("sequence", "state", ("posed", "drift", "missing", "computed", "cached", "seconds"), "run")]
    for one in ended:
        end = one.error if one.folder is None else str(one.folder)
        lines.append(line(one.sequence, STATES[one.code], (*_figures(one.folder), f"{one.seconds:.1f}"), end))
    lines += [f"{sequence:{width}s}  not begun" for sequence in sequences[len(ended) :]]
    return "\n".join(lines)


def _figures(folder: Path | None) -> tuple[str, str, str, str, str]:
    """Frames with a pose, drift, number of missing products, and numbers of computed and of cached tasks."""
    from rille.pipeline.report.delivery import lacking

    if folder is None:
        return "", "", "", "", ""
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    drift = report["metrics"].get("trajectory_drift", {}).get("value")
    frames = report["frames"]
    share = f"{100 * sum(frame['posed'] for frame in frames) / len(frames):.0f} %" if frames else ""
    computed, cached = (str(sum(one[what] for one in report["stages"].values())) for what in ("computed", "cached"))
    return share, "" if drift is None else f"{drift:.3g} %", str(len(lacking(report["missing"]))), computed, cached
