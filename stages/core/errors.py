"""Errors and warnings that a user can act on: each says what is wrong, where, and what to change."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, Self


class RilleError(Exception):
    """Base of every error that Rille raises on purpose; the command line prints it as one line.

    ``code`` (``RIL-214``) names the message for good, whatever its words become; ``remedy`` says what to change and is
    printed behind the message. Codes: 001-099 command line and configuration, 100-299 input, 300-499 stages,
    500-599 engine and store, 600-639 outputs, 640-709 findings of ``rille check`` and warnings, 710-998 later ones.
    """

    def __init__(self, code: str, message: str, *, remedy: str = "") -> None:
        super().__init__(code, message, remedy)
        self.code = code
        self.message = message
        self.remedy = remedy

    def __str__(self) -> str:
        return f"{self.message}: {self.remedy}" if self.remedy else self.message

    def __reduce__(self) -> tuple[object, ...]:
        # An exception is pickled by its args, to come back from a worker; keyword arguments would be lost.
        return (partial(type(self), remedy=self.remedy), (self.code, self.message))

    def at(self, where: str) -> Self:
        """Return the same error with the place in front: ``where: message``."""
        return type(self)(self.code, f"{where}: {self.message}", remedy=self.remedy)


@contextmanager
def within(where: str) -> Iterator[None]:
    """Put the place in front of errors raised inside, unless it is there."""
    try:
        yield
    except RilleError as error:
        if error.message.startswith(where):
            raise
        raise error.at(where) from error


def did_you_mean(text: str, names: Iterable[str], prefix: str = "") -> str:
    """Ask, after a prefix, whether one of the names like a text was meant; empty if none is like it."""
    known = list(dict.fromkeys(names))
    alike = difflib.get_close_matches(text, known, n=3, cutoff=0.6) or [n for n in known if text and text in n][:3]
    return f"did you mean {' or '.join(prefix + name for name in alike)}?" if alike else ""


class ConfigError(RilleError, ValueError):
    """A parameter is unknown, out of range or contradicts another one."""


class InputError(RilleError, ValueError):
    """An input file or sequence cannot be used as it is."""


class IncompleteError(InputError):
    """Files make no sequence as they are: some are not there or lack a partner. Of one that arrives, more may come."""


class DegenerateError(RilleError, ArithmeticError):
    """The data do not determine the answer (too few landmarks, no texture, no baseline ...)."""


def warning(code: str, text: str) -> str:
    """Format a warning as one line: the code of the message, then ``text``.

    ``text`` states the problem, with its value and where it is (file, camera or frame).

    >>> warning("RIL-680", "cam0: 2 images are not there")
    'RIL-680: cam0: 2 images are not there'
    """
    return f"{code}: {text}"


def told(complaints: Sequence[Any], words: Callable[[Any], str] = str) -> str:
    """Three complaints of one kind in words, and how many more there are: whoever mends them sees the next."""
    more = [f"and {len(complaints) - 3} more"] if len(complaints) > 3 else []
    return "; ".join([*map(words, complaints[:3]), *more])
