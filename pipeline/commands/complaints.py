"""Errors on the command line: one line with a code, and an exit code."""

from __future__ import annotations

import sys
import traceback

from rille.pipeline.engine.plain import one_line
from rille.pipeline.runs.options import FAILED, USAGE

LONGEST_COMPLAINT = 1000
"""Characters."""


def complain(error: Exception, *, debug: bool = False) -> int:
    """Print an error in one line, with the traceback if ``debug``; return its exit code."""
    from rille.pipeline.engine.failures import translated
    from rille.stages.core.errors import ConfigError, InputError

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
