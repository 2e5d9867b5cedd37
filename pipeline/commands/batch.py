"""Several sequences in one command, one after the other."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from rille.pipeline.commands.complaints import complain
from rille.pipeline.engine.failures import translated
from rille.pipeline.runs.options import COMPLETE, FAILED, HOLES, USAGE

Ended = list[tuple[str, Path | str]]
"""Sequences, each with the folder of its run, or the code or the type of its error."""


def each(
    sequences: Sequence[str], one: Callable[[str], tuple[int, Path | str]], *, keep_going: bool
) -> tuple[int, Ended]:
    """Call ``one`` for each sequence, up to the first error unless ``keep_going``; the most severe of the exit codes,
    and what ``one`` gave for each."""
    worst, ended = COMPLETE, Ended()
    for number, sequence in enumerate(sequences, 1):
        print(f"rille: {sequence} ({number} of {len(sequences)})", file=sys.stderr)
        try:
            code, end = one(sequence)
        except Exception as error:  # faults of the program too: they may not affect the others
            known = translated(error)
            code, end = complain(error), type(error).__name__ if known is None else known.code
        ended.append((sequence, end))
        # The least severe first.
        worst = max(worst, code, key=(COMPLETE, HOLES, USAGE, FAILED).index)
        if code in (USAGE, FAILED) and not keep_going:
            break
    return worst, ended + [(sequence, "not begun") for sequence in sequences[len(ended) :]]
