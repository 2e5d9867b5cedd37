"""Ctrl-C that does not get lost.

Python raises KeyboardInterrupt wherever the main thread happens to be. In a callback of a weak reference, or in a
finaliser, an exception is printed and forgotten, and the run would go on to its end. Here every interrupt is remembered
as well, so that it can be raised again where the run next looks.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType, TracebackType
from typing import Any, NoReturn


@contextmanager
def held() -> Iterator[None]:
    """Let Ctrl-C wait for the end of a block, around what complains aloud when it is left half made.

    Threads and processes begun in the block, and all that these begin, never see it.
    """
    # Blocked, not ignored: the signal stays pending until the end of the block, and new threads and processes inherit
    # the mask.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class OutsideImports:
    """Handler of SIGINT that raises KeyboardInterrupt; in the midst of an import it calls ``leave``, which does not
    return.

    What libraries make of an exception in the midst of their import is anything: another one, a traceback, nothing.
    """

    def __init__(self, leave: Callable[[], Any]) -> None:
        self._leave = leave

    def __call__(self, number: int, frame: FrameType | None) -> NoReturn:
        """Handle the signal."""
        while frame is not None:
            if frame.f_code.co_filename.startswith("<frozen importlib"):
                self._leave()
            frame = frame.f_back
        raise KeyboardInterrupt


class Interrupts:
    """Remembers interrupts while it is entered, on the main thread and where nobody else handles them.

    SIGTERM, by which batch systems and ``timeout`` end a program, is one as well.
    """

    def __init__(self) -> None:
        self.came = False
        self._hook: Any = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Interrupts:
        main = threading.current_thread() is threading.main_thread()
        # A notebook or another program that has a handler of its own keeps it.
        before = signal.getsignal(signal.SIGINT)
        if main and (before is signal.default_int_handler or isinstance(before, OutsideImports)):
            ours = [signal.SIGINT, *[signal.SIGTERM] * (signal.getsignal(signal.SIGTERM) is signal.SIG_DFL)]
            self._before = {number: signal.signal(number, self._interrupted) for number in ours}
            self._hook, sys.unraisablehook = sys.unraisablehook, self._unraisable
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._hook is not None:
            for number, before in self._before.items():
                signal.signal(number, before)
            sys.unraisablehook, self._hook = self._hook, None

    def check(self) -> None:
        """Raise KeyboardInterrupt if one came."""
        if self.came:
            raise KeyboardInterrupt

    def _interrupted(self, number: int, frame: FrameType | None) -> NoReturn:
        self.came = True
        raise KeyboardInterrupt

    def _unraisable(self, what: Any) -> None:
        # Python would print this interrupt and forget it; check() raises it, so the print is noise.
        if not issubclass(what.exc_type, KeyboardInterrupt):
            self._hook(what)
