"""``rille`` and ``python -m rille``: the command line, which Ctrl-C ends with exit code 130 and one line.

No module is imported from the current folder.
"""

import os
import sys


def _leave_out_current_folder() -> None:
    """Remove what Python has put before its library for the current folder, unless Rille itself lies there."""
    try:
        here = os.getcwd()
    except FileNotFoundError:  # it was removed
        return
    entries = ("", *os.environ.get("PYTHONPATH", "").split(os.pathsep))
    ours = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
    there = {os.path.normpath(os.path.join(here, entry)) for entry in entries if not os.path.isabs(entry)} - {ours}
    before = [*sys.path, library := os.path.dirname(os.__file__)].index(library)
    sys.path[:before] = [entry for entry in sys.path[:before] if entry not in there]


_leave_out_current_folder()

import signal  # noqa: E402  # only now: Python does not load it by itself


def _leave(*_: object) -> None:
    os.write(2, b"rille: interrupted\n")
    os._exit(130)


def _unraisable(what: "sys.UnraisableHookArgs") -> None:
    # In a finaliser or a callback an exception is printed and forgotten.
    if issubclass(what.exc_type, KeyboardInterrupt):
        _leave()
    sys.__unraisablehook__(what)


def main() -> None:
    """Run ``rille`` with the words of the command line."""
    # A shell lets what it starts in the background ignore Ctrl-C.
    heeded = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if heeded:
        # First of all: nothing is begun, and from the midst of an import an exception would be a traceback.
        signal.signal(signal.SIGINT, _leave)
    from rille.pipeline import cli
    from rille.pipeline.engine.runtime import interrupts

    try:
        if heeded:
            sys.unraisablehook = _unraisable
            signal.signal(signal.SIGINT, interrupts.OutsideImports(_leave))
        cli.main()
    except KeyboardInterrupt:  # just before or behind the command
        _leave()
    finally:
        if heeded:
            signal.signal(signal.SIGINT, _leave)


if __name__ == "__main__":
    main()
