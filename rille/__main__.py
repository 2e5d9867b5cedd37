"""``rille`` and ``python -m rille``: the command line, which Ctrl-C ends with exit code 130 and one line."""

from __future__ import annotations

import os
import signal
import sys

TYPE_CHECKING = False  # as in the package
if TYPE_CHECKING:
    from typing import Any


def _leave(*_: Any) -> None:
    os.write(2, b"rille: interrupted\n")
    os._exit(130)


def _unraisable(what: Any) -> None:
    # In a finaliser or a callback an exception is printed and forgotten.
    if issubclass(what.exc_type, KeyboardInterrupt):
        _leave()
    sys.__unraisablehook__(what)


def main() -> None:
    """Entry point of ``rille``."""
    # A shell lets what it starts in the background ignore Ctrl-C.
    heeded = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if heeded:
        # First of all: nothing is begun, and from the midst of an import an exception would be a traceback.
        signal.signal(signal.SIGINT, _leave)
    from rille.pipeline import cli
    from rille.pipeline.engine.runtime import interrupts

    try:
        try:
            if heeded:
                sys.unraisablehook = _unraisable
                signal.signal(signal.SIGINT, interrupts.OutsideImports(_leave))
            cli.main()
        finally:
            if heeded:
                signal.signal(signal.SIGINT, _leave)
    except KeyboardInterrupt:  # just before or behind the command
        _leave()


if __name__ == "__main__":
    main()
