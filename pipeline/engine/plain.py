"""The one place that all output of the command line passes through: no name can make a terminal do anything.

File names, cameras' names and manifests' texts come from whoever wrote the data. An escape sequence in one of them
would set the terminal's title, hide lines, or move the cursor over a complaint; a mark of direction turn it around.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import TextIOWrapper
from typing import Any, TextIO

UNSEEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters but for tab and line feed, marks of direction, and bytes of file names that are no UTF-8."""


def plain(text: str) -> str:
    r"""The text with ``\x1b`` and the like for what a terminal would obey."""
    return UNSEEN.sub(lambda found: ascii(found[0])[1:-1], text)


class PlainStream:
    """A stream that writes plain text; ``raw`` is the one behind it, for bars and colours of our own."""

    def __init__(self, raw: TextIO) -> None:
        self.raw = raw

    def write(self, text: str) -> int:
        """Write, and count the letters as they were given."""
        self.raw.write(plain(text))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.raw, name)


def raw(stream: Any) -> Any:
    """The stream behind a plain one."""
    return stream.raw if isinstance(stream, PlainStream) else stream


def warned(line: str) -> str:
    """A warning as it is printed: one that begins with a code (``RIL-680: ...``) shows it where an error would."""
    return f"rille: warning{' ' if line.startswith('RIL-') else ': '}{one_line(line)}"


def warn(line: str) -> None:
    """Print a warning on stderr."""
    print(warned(line), file=sys.stderr)


def one_line(text: object) -> str:
    """The text of something in one line, with single blanks."""
    return " ".join(str(text).split())


def brief(value: Any, most: int) -> str:
    """A text, or a value as JSON; of more than ``most`` characters the first, and three dots."""
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= most else f"{text[: most - 3]}..."


@contextmanager
def plain_output() -> Iterator[None]:
    """Everything that is printed within is plain."""
    with redirect_stdout(PlainStream(_open(sys.stdout))), redirect_stderr(PlainStream(_open(sys.stderr))):
        yield


def _open(stream: TextIO | None) -> TextIO:
    """The stream, which has a form for every letter; or one that leads nowhere: a shell's ``>&-`` leaves none."""
    if isinstance(stream, TextIOWrapper):
        stream.reconfigure(errors="backslashreplace")
    return open(os.devnull, "w", encoding="utf-8") if stream is None else stream
