"""What a program gives: names and paths, and parameters by section."""

from __future__ import annotations

from collections.abc import Mapping
from os.path import expanduser
from pathlib import Path
from typing import Any

import tomli_w

from rille.pipeline.flow import config
from rille.stages.core.errors import ConfigError, InputError

Settings = Mapping[str, Any]


def place_of(path: object, name: str) -> str:
    """A name or path as a command line has it, from argument ``name``; what can be none is refused."""
    if not isinstance(path, str | Path) or "\0" in str(path):
        remedy = "give a text or a Path"
        if name == "seq":
            remedy += ", or what rille.open returns, with frames='START:STOP' for a part of it"
        raise InputError("RIL-970", f"{name}={path!r:.80} is no name or path", remedy=remedy)
    return expanduser(path)


def check_sections(settings: Mapping[str, object]) -> None:
    """Refuse a parameter that is given without its section."""
    for section, values in settings.items():
        if not isinstance(values, Mapping):
            text = f"{section}={values!r} is no section of parameters"
            raise ConfigError("RIL-861", text, remedy='give them by section, e.g. locus={"cell_size": 0.002}')


def assignments(settings: Mapping[str, Settings]) -> list[str]:
    """Return the same settings as assignments for ``--set``.

    >>> assignments({"locus": {"cell_size": 0.002, "both": True}, "drive": {"goal": (0.1, 2.0)}})
    ['locus.cell_size=0.002', 'locus.both=true', 'drive.goal=[ 0.1, 2.0, ]']
    """
    words = []
    check_sections(settings)
    for section, values in config.merge({}, settings).items():
        for name, value in values.items():
            try:
                lines = tomli_w.dumps({"v": value}).removeprefix("v = ").splitlines()
            except TypeError:
                text = f"{section}.{name} = {value!r} is no value of TOML"
                remedy = "give a number, a text, True or False, or a list of these; or leave it out"
                raise ConfigError("RIL-866", text, remedy=remedy) from None
            # Only a list has several lines: the line feed of a text is escaped.
            words.append(f"{section}.{name}={' '.join(line.strip() for line in lines)}")
    return words
