"""Names of sequences: they become folders, file names and keys of the cache, so that one rule holds for all of them."""

from __future__ import annotations

import re

from rille.stages.core.errors import InputError

MAX_CHARACTERS = 80

NAME = re.compile(rf"[A-Za-z0-9_][A-Za-z0-9_.-]{{0,{MAX_CHARACTERS - 1}}}")
"""Never a path, a hidden file, an option or a control character, on no file system and in no bucket."""

OTHER = re.compile(r"[^A-Za-z0-9_.-]+")

RESERVED = ("latest",)
"""What the command line means otherwise."""


def check_name(name: str) -> None:
    """Refuse what is no name of a sequence.

    Raises
    ------
    InputError
        It has other characters, is too long, or means something else.
    """
    if not NAME.fullmatch(name) or name in RESERVED:
        shown = repr(name if len(name) <= MAX_CHARACTERS else f"{name[:MAX_CHARACTERS]}...")
        text = f"{shown} is not permitted as the name of a sequence"
        remedy = f"at most {MAX_CHARACTERS} of A-Z a-z 0-9 _ . -, the first a letter, digit or _, and not {RESERVED[0]}"
        raise InputError("RIL-764", text, remedy=remedy)


def derived_name(text: str) -> str:
    """A name made of that of a file or folder, whatever it has."""
    name = OTHER.sub("_", text).strip("_.-")[:MAX_CHARACTERS].rstrip("_.-")
    return name if name and name not in RESERVED else "sequence"
