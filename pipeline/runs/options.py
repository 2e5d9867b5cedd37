"""Options of a run with their explanations, options shared with other commands, exit codes."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from rille.pipeline.engine.plain import plain
from rille.stages.core.errors import ConfigError

COMPLETE, FAILED, USAGE, HOLES, INTERRUPTED = 0, 1, 2, 3, 130

RUNS = Path("runs")

FLAG = Parameter(negative="")
"""An option that is given or not, without a ``--no-`` form."""

SEVERAL = Parameter(negative="", consume_multiple=False, show_default=False)
"""An option that may be repeated, one value each time."""

SET_HELP = "A parameter, section.key=value, for example locus.cell_size=0.002; may be repeated."
Assignments = Annotated[tuple[str, ...], SEVERAL, Parameter(name=["--set", "-s"], help=SET_HELP)]
CacheFolder = Annotated[
    str | None, Parameter(name="--cache", help="Folder of cached artifacts; RILLE_CACHE or .rille/cache by default.")
]
Output = Parameter(name=["--output", "-o"])
Run = Annotated[
    str, Parameter(help="A run by name: SEQUENCE (its latest), SEQUENCE/ID, ID, latest (of all); or its folder.")
]
Runs = Annotated[Path, Parameter(help="Folder of results; each run makes RUNS/sequence/run-id.")]
Unparsed = Parameter(parse=False)

_NONE: Mapping[Path, str] = {}


@Parameter(name="*")
@dataclass(frozen=True)
class Settings:
    """Options that choose what is computed, and the cache.

    Parameters
    ----------
    config
        TOML file of parameters; every run writes one with all defaults filled.
    frames
        Frame range START:STOP[:STEP], as in Python; all by default.
    """

    assignments: Assignments = ()
    config: Path | None = None
    frames: str | None = None
    cache: CacheFolder = None


@Parameter(name="*")
@dataclass(frozen=True)
class Options(Settings):
    """:class:`Settings`, and options that choose where tasks run, the part that is made, and the messages during a run.

    A plan takes them all, so that it takes the command line of its run. ``executor`` may also be a ``Client`` of dask.

    Parameters
    ----------
    jobs
        Worker processes; the number of cores by default.
    force
        A stage to compute again although it is cached; may be repeated.
    executor
        Where tasks run: dask (a cluster of this machine), inline, or a dask scheduler's address, tcp://host:port.
    memory_limit
        Memory that a run may use in total, for example 6GB or 75%; by default 90 % of what is free.
    keep_going
        After a failure, finish all tasks that do not depend on it; the exit status is then 3.
    until
        Compute a stage's tasks and what they need, nothing else; may be repeated.
    only
        Make a file, for example dem.tif, and what it needs, nothing else; may be repeated.
    progress
        How progress is shown on stderr.
    quiet
        The same as --progress quiet: warnings and errors only.
    """

    jobs: int | None = None
    force: Annotated[frozenset[str], SEVERAL] = frozenset()
    executor: Any = "dask"
    memory_limit: str | None = None
    runs: Runs = RUNS
    keep_going: Annotated[bool, FLAG] = False
    until: Annotated[tuple[str, ...], SEVERAL] = ()
    only: Annotated[tuple[str, ...], SEVERAL] = ()
    progress: Literal["auto", "bar", "plain", "quiet"] = "auto"
    quiet: Annotated[bool, FLAG, Parameter(name=["--quiet", "-q"])] = False

    def part(self) -> str:
        """The options that choose a part of the run, as typed; empty: all of it."""
        return " ".join([*(f"--until {name}" for name in self.until), *(f"--only {name}" for name in self.only)])

    def command(self, verb: str, *opened: str) -> str:
        """The command line, for a shell, that repeats a run of a sequence (``Sequence.opened``), in one line."""
        words = ["rille", verb, *opened]
        words += ["--config", str(self.config)] if self.config else []
        words += ["--frames", self.frames] if self.frames else []
        words += [word for a in self.assignments for word in ("--set", a)]
        # In one line, for the comment in `config.toml`; line feeds in lists of TOML may be spaces.
        return plain(f"{shlex.join(words)} {self.part()}".replace("\n", " ").strip())


@Parameter(name="*")
@dataclass(frozen=True)
class DriveOptions(Options):
    """Options of a drive, which takes its frames itself."""

    frames: Annotated[None, Unparsed] = None
    until: Annotated[tuple[str, ...], Unparsed] = ()
    only: Annotated[tuple[str, ...], Unparsed] = ()


@Parameter(name="*")
@dataclass(frozen=True)
class WatchOptions(Options):
    """:class:`Options`, and when the watch ends.

    Parameters
    ----------
    until_idle
        End when nothing has arrived for so many seconds; by default at Ctrl-C.
    count
        End when so many pairs have arrived.
    """

    frames: Annotated[str | None, Unparsed] = None
    until_idle: float | None = None
    count: int | None = None


def cache_folder(given: str | Path | None) -> Path:
    """Return the folder of the artifact cache: ``--cache``, else ``RILLE_CACHE``, else ``.rille/cache`` here."""
    from rille.pipeline.engine.store.base import locate

    return locate(given or os.environ.get("RILLE_CACHE") or Path(".rille/cache"))


def output_file(output: Path, ending: str) -> Path:
    """The file with this ending of an output of several files, whose name has no ending, or that of one of them.

    Raises
    ------
    ConfigError
        It has no name, as ``.`` has none.
    """
    if not output.name:  # as "." has none
        check_output(output)
    return output.with_name(re.sub(r"\.(gpkg|json|tif|tum)$", "", output.name) + ending)


def check_output(path: Path, *endings: str, option: str = "--output", others: Mapping[Path, str] = _NONE) -> None:
    """Refuse an impossible name of a file to write, before anything is computed.

    Parameters
    ----------
    path : value of ``option``.
    endings : permitted endings; none: any.
    others : other files that the command reads or writes, in words, by their resolved paths.

    Raises
    ------
    ConfigError
        ``path`` is a folder, has another ending, or is one of the others; or nothing can be written there.
    """
    if path.resolve() in others:
        text = f"{option} and {others[path.resolve()]} are both {path}"
        raise ConfigError("RIL-043", text, remedy="give another name")
    if path.is_dir():
        raise ConfigError("RIL-047", f"the output {path} is a folder", remedy="name a file in it")
    if endings and path.suffix.lower() not in endings:
        allowed = " or ".join(endings)
        raise ConfigError("RIL-871", f"the output {path} has another ending", remedy=f"end it in {allowed}")
    above = next(folder for folder in path.absolute().parents if folder.exists())
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        why, check = ("may not be written", "check its rights, or ") if above.is_dir() else ("is no folder", "")
        text, remedy = f"the output {path} cannot be written: {above} {why}", f"{check}give another {option}"
        raise ConfigError("RIL-746", text, remedy=remedy)


def check_new(path: Path, but: str = "", remedy: str = "give another --output, or remove it") -> None:
    """Refuse to overwrite a file that may be the user's own work; ``but``: why it may be."""
    if path.exists():
        raise ConfigError("RIL-038", f"{path} exists{but}", remedy=remedy)
