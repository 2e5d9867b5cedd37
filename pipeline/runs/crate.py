"""Rerun of an RO-Crate of a run (:mod:`rille.pipeline.export.programs.rocrate`): its sequence, options and results."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any, TypeVar

from rille.datasets.registry import is_there
from rille.datasets.text.names import shell_word
from rille.datasets.text.reading import TABLE, read_text
from rille.pipeline.export import catalogue
from rille.pipeline.export.programs.rocrate import METADATA, sha256
from rille.pipeline.runs.options import Settings
from rille.stages.core.errors import InputError

Chosen = TypeVar("Chosen", bound=Settings)


@dataclass(frozen=True)
class Crate:
    """A run described by a crate: its sequence, the options of its command by name, and the SHA-256 of each result."""

    folder: Path
    sequence: str
    options: Mapping[str, tuple[str, ...]]
    digests: Mapping[str, str]

    def unlike(self, run: Path) -> list[str]:
        """Results of the crate that differ in a run, or are missing there."""
        return [name for name, digest in self.digests.items() if sha256(run / name) != digest]


def read(folder: Path) -> Crate | None:
    """The run that a crate describes; None: the folder is no crate, or one of data alone.

    Raises
    ------
    InputError
        It is no crate of a run of Rille.
    """
    path = folder / METADATA
    if not os.path.isfile(path):
        return None
    try:
        entities = {one["@id"]: one for one in json.loads(read_text(path, "crate", TABLE))["@graph"]}
        if "./" in entities and "#run" not in entities:
            return None
        program, verb, sequence, *rest = shlex.split(entities["#run"]["name"])
        if (program, verb) != ("rille", "reconstruct"):
            raise ValueError(f"{program} {verb} is no reconstruction")
        options: dict[str, tuple[str, ...]] = {}
        for name, value in zip(rest[::2], rest[1::2], strict=True):  # each option of such a command has a value
            options[name] = (*options.get(name, ()), value)
        results = [one["@id"] for one in entities["#run"]["result"]]
        digests = {str(name): str(entities[name]["sha256"]) for name in results if name not in catalogue.RENDERED}
        if any(PurePath(name).is_absolute() or ".." in PurePath(name).parts for name in digests):
            raise ValueError("a file lies outside of it")
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        text = f"{path} describes no run of Rille ({type(error).__name__}: {error})"
        raise InputError("RIL-023", text, remedy="`rille export RUN --to rocrate` writes one") from error
    return Crate(folder, sequence, options, digests)


def resolved(sequence: str, options: Chosen) -> tuple[str, Chosen, Crate | None]:
    """Sequence and options of a command; where a crate is named its own, as far as they are not given anew.

    Raises
    ------
    InputError
        The crate's sequence is not where its command says.
    """
    crate = read(Path(sequence))
    if crate is None:
        return sequence, options, None
    if not is_there(crate.sequence):
        text = f"{sequence} is a run of {crate.sequence}, which is not here, and a crate holds no images"
        whence = f"name the crate {shell_word(crate.folder.resolve())} in a folder where it lies"
        whence = "bring it, or a link to it, to this path" if Path(crate.sequence).is_absolute() else whence
        raise InputError("RIL-612", text, remedy=f"{whence}; {METADATA} has the SHA-256 of each image")
    own: dict[str, Any] = {"config": crate.folder / "config.toml", "frames": crate.options.get("--frames", (None,))[-1]}
    own |= {name: crate.options.get(f"--{name}", ()) for name in ("until", "only") if hasattr(options, name)}
    return crate.sequence, replace(options, **{n: getattr(options, n) or value for n, value in own.items()}), crate
