"""Names of sequences, which become folders, file names and keys of the cache; names of files as words of a text."""

from __future__ import annotations

import re
import shlex
import unicodedata
import zlib
from collections.abc import Sequence
from pathlib import Path

from rille.stages.core.errors import InputError

MAX_CHARACTERS = 80

NAME = re.compile(rf"[A-Za-z0-9_][A-Za-z0-9_.-]{{0,{MAX_CHARACTERS - 1}}}")
"""Names without paths, hidden files, options or control characters, on any file system and in any bucket."""

OTHER = re.compile(r"[^A-Za-z0-9_.-]+")

UNWRITABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
"""In a name: control characters and line separators, which would end a comment, and bytes that are not UTF-8."""

RESERVED = ("latest",)
"""Names with another meaning on the command line."""


def check_name(name: str) -> None:
    """Refuse an impossible name of a sequence.

    Raises
    ------
    InputError
        It has other characters, is too long, or has another meaning.
    """
    if not NAME.fullmatch(name) or name in RESERVED:
        shown = repr(name if len(name) <= MAX_CHARACTERS else f"{name[:MAX_CHARACTERS]}...")
        text = f"{shown} is not permitted as the name of a sequence"
        remedy = f"at most {MAX_CHARACTERS} of A-Z a-z 0-9 _ . -, the first a letter, digit or _, and not {RESERVED[0]}"
        raise InputError("RIL-764", text, remedy=remedy)


def derived_name(text: str) -> str:
    """A name made from that of any file or folder: letters without their accents.

    Letters of other alphabets are left out; that others remain apart, a checksum of all stands behind.
    """
    plain = "".join(c for c in unicodedata.normalize("NFKD", text) if not unicodedata.combining(c))
    lost = any(c.isalnum() and not c.isascii() for c in plain)
    mark = f"_{zlib.crc32(text.encode(errors='surrogatepass')):08x}" if lost else ""
    name = OTHER.sub("_", plain).strip("_.-")[: MAX_CHARACTERS - len(mark)].rstrip("_.-")
    return f"{name if name and name not in RESERVED else 'sequence'}{mark}"


def shell_word(path: str | Path) -> str:
    """A path as a word of a command, for a shell: quoted, and no option."""
    return shlex.quote(f"./{path}" if str(path).startswith("-") else str(path))


def writable(name: str) -> None:
    """Refuse the name of a file that does not fit into a line of text.

    Raises
    ------
    InputError
        It has a control character or a line break, or is not in UTF-8.
    """
    if UNWRITABLE.search(name):
        text = f"the name {name!r} has a line break, or is not in UTF-8: no manifest holds it"
        raise InputError("RIL-185", text, remedy="rename it")


def ends(paths: Sequence[Path]) -> str:
    """The names of the first and the last of some files: ``000000.png to 000050.png``."""
    return " to ".join(dict.fromkeys((paths[0].name, paths[-1].name))) if paths else "none"
