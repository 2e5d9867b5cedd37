"""Several sequences in one command: each is a run as by itself, and a table says what became of all of them."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from rille.pipeline.commands.complaints import complain
from rille.pipeline.commands.options import COMPLETE, FAILED, HOLES, USAGE

SEVERITY = (COMPLETE, HOLES, USAGE, FAILED)
"""Exit codes, the least severe first."""

STATES = {COMPLETE: "complete", HOLES: "with holes", USAGE: "refused", FAILED: "failed"}


class Ended(NamedTuple):
    """What became of a sequence: exit code, folder of its run if it has one, and seconds that it took."""

    sequence: str
    code: int
    folder: Path | None
    seconds: float


def each(sequences: Sequence[str], one: Callable[[str], tuple[int, Path | None]], *, keep_going: bool) -> list[Ended]:
    """Call ``one`` for each sequence. After one that ends in an error the others follow if ``keep_going``."""
    ended = []
    for number, sequence in enumerate(sequences, 1):
        print(f"rille: {sequence} ({number} of {len(sequences)})", file=sys.stderr)
        begin = time.monotonic()
        try:
            code, folder = one(sequence)
        except Exception as error:  # a fault of the program in one sequence is none of the others
            code, folder = complain(error), None
        ended.append(Ended(sequence, code, folder, time.monotonic() - begin))
        if code in (USAGE, FAILED) and not keep_going:
            break
    return ended


def worst(ended: Sequence[Ended]) -> int:
    """The most severe of the exit codes."""
    return max((one.code for one in ended), key=SEVERITY.index)


def table(ended: Sequence[Ended], sequences: Sequence[str]) -> str:
    """A line for each sequence: state, share of frames with a pose, drift, what is missing, time, folder of the run."""
    width = max(map(len, ("sequence", *sequences)))
    lines = [f"{'sequence':{width}s}  {'state':10s} {'posed':>6s} {'drift':>8s} {'missing':>7s} {'seconds':>8s}  run"]
    for sequence, code, folder, seconds in ended:
        posed, drift, missing = _figures(folder)
        state, where = STATES[code], "" if folder is None else str(folder)
        line = f"{sequence:{width}s}  {state:10s} {posed:>6s} {drift:>8s} {missing:>7s} {seconds:8.1f}  {where}"
        lines.append(line.rstrip())
    lines += [f"{sequence:{width}s}  not begun" for sequence in sequences[len(ended) :]]
    return "\n".join(lines)


def _figures(folder: Path | None) -> tuple[str, str, str]:
    """Frames with a pose, drift and number of what is missing, as the report of a run states them."""
    if folder is None:
        return "", "", ""
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    drift = report["metrics"].get("trajectory_drift", {}).get("value")
    frames = report["frames"]
    share = f"{100 * sum(frame['posed'] for frame in frames) / len(frames):.0f} %" if frames else ""
    return share, "" if drift is None else f"{drift:.3g} %", str(len(report["missing"]))
