"""Errors that a user can act on: each says what is wrong, where, and what to change."""

from __future__ import annotations


class RilleError(Exception):
    """Base of every error that Rille raises on purpose; the command line prints it as one line.

    ``remedy`` says what to change; it is printed behind the message.
    """

    def __init__(self, message: str, *, remedy: str = "") -> None:
        super().__init__(message, remedy)
        self.message = message
        self.remedy = remedy

    def __str__(self) -> str:
        return f"{self.message}: {self.remedy}" if self.remedy else self.message

    def __reduce__(self) -> tuple[object, ...]:
        return (_rebuild, (type(self), self.message, self.remedy))


def _rebuild(kind: type[RilleError], message: str, remedy: str) -> RilleError:
    return kind(message, remedy=remedy)


class ConfigError(RilleError, ValueError):
    """A parameter is unknown, out of range or contradicts another one."""


class InputError(RilleError, ValueError):
    """An input file or sequence cannot be used as it is."""


class DegenerateError(RilleError, ArithmeticError):
    """The data do not determine the answer (too few landmarks, no texture, no baseline ...)."""
