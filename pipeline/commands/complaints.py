"""Errors on the command line: one line with a code, and an exit code; also of several sequences in one command."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

from rille.pipeline.engine.failures import translated
from rille.pipeline.engine.plain import one_line
from rille.pipeline.runs.options import COMPLETE, FAILED, HOLES, USAGE
from rille.stages.core.errors import ConfigError, InputError

LONGEST_COMPLAINT = 1000
"""Characters."""


def complain(error: Exception, *, debug: bool = False) -> int:
    """Print an error in one line, with the traceback if ``debug``; return its exit code."""
    if debug:
        traceback.print_exception(error)
    if (known := translated(error)) is not None:
        print_error(known.code, str(known))
    else:
        hint = "" if debug else " (run again with --debug for the traceback)"
        print_error("RIL-999", f"{type(error).__name__}: {error}{hint}")
    return USAGE if isinstance(known, ConfigError | InputError) else FAILED


def print_error(code: str, words: str) -> None:
    """Print an error in one line of at most :data:`LONGEST_COMPLAINT` characters."""
    line = one_line(words)
    if len(line) > LONGEST_COMPLAINT:  # it may quote a file, of which this is enough to find the place
        line = f"{line[: LONGEST_COMPLAINT // 2]} ... {line[-LONGEST_COMPLAINT // 2 :]}"
    print(f"rille: error {code}: {line}", file=sys.stderr)


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
