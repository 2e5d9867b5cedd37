"""Options that several commands of ``rille`` share, with their explanation, and the steps before each command."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

if TYPE_CHECKING:
    from rille.pipeline.runs.session import Options

COMPLETE, FAILED, USAGE, HOLES, INTERRUPTED = 0, 1, 2, 3, 130

RUNS = Path("runs")


def flag(words: str, *names: str) -> Parameter:
    """An option that is given or not, without a ``--no-`` form."""
    return Parameter(name=list(names) or None, negative="", help=words)


def several(words: str, *names: str) -> Parameter:
    """An option that may be repeated, one value each time."""
    return Parameter(name=list(names) or None, negative="", consume_multiple=False, help=f"{words}; may be repeated.")


Assignments = Annotated[
    list[str] | None, several("A parameter, section.key=value, for example locus.cell_size=0.002", "--set", "-s")
]
CacheFolder = Annotated[
    str | None,
    Parameter(
        name="--cache",
        help="Folder of cached artifacts; RILLE_CACHE or .rille/cache by default.",
    ),
]
Debug = Annotated[bool, flag("Show tracebacks.")]
Executor = Annotated[
    str,
    Parameter(
        help="Where tasks run: dask (a cluster of this machine), inline, or a dask scheduler's address, tcp://host:port."
    ),
]
Frames = Annotated[str | None, Parameter(help="Frame range START:STOP[:STEP], as in Python; all by default.")]
MemoryLimit = Annotated[
    str | None,
    Parameter(help="Memory that a run may use in total, for example 6GB or 75%; by default 90 % of what is free."),
]
Output = Parameter(name=["--output", "-o"])
Run = Annotated[
    str, Parameter(help="A run by name: SEQUENCE (its latest), SEQUENCE/ID, ID, latest (of all); or its folder.")
]
Runs = Annotated[Path, Parameter(help="Folder of results; each run makes RUNS/sequence/run-id.")]


@Parameter(name="*")
@dataclass(frozen=True)
class Settings:
    """Options that choose the computation and its cache."""

    assignments: Assignments = None
    config: Annotated[
        Path | None, Parameter(help="TOML file of parameters; every run writes one with all defaults filled.")
    ] = None
    jobs: Annotated[int | None, Parameter(help="Worker processes; the number of cores by default.")] = None
    force: Annotated[list[str] | None, several("A stage to compute again although it is cached")] = None
    cache: CacheFolder = None
    debug: Debug = False


@Parameter(name="*")
@dataclass(frozen=True)
class Results:
    """Options of the folder of results and of the messages during a run."""

    runs: Runs = RUNS
    progress: Annotated[
        Literal["auto", "bar", "plain", "json", "quiet"], Parameter(help="How progress is shown on stderr.")
    ] = "auto"
    quiet: Annotated[bool, flag("No progress; warnings and errors only.", "--quiet", "-q")] = False
    verbose: Annotated[bool, flag("Say where to watch dask at work.", "--verbose", "-v")] = False


def options(
    seq: str,
    settings: Settings,
    results: Results,
    *,
    executor: str = "dask",
    frames: str | None = None,
    keep_going: bool = False,
    memory_limit: str | None = None,
) -> Options:
    """Collect the options of the command line for :mod:`rille.pipeline.runs.session`."""
    from rille.pipeline.runs.session import Options

    return Options(
        sequence=seq,
        assignments=tuple(settings.assignments or ()),
        config=settings.config,
        frames=frames,
        jobs=settings.jobs,
        executor=executor,
        keep_going=keep_going,
        force=frozenset(settings.force or ()),
        runs=results.runs,
        cache=cache_folder(settings.cache),
        progress="quiet" if results.quiet else results.progress,
        memory_limit=memory_limit,
        verbose=results.verbose,
    )


def cache_folder(given: str | Path | None) -> Path:
    """Return the folder of the artifact cache: ``--cache``, else ``RILLE_CACHE``, else ``.rille/cache`` here."""
    from rille.pipeline.engine.store.folder import locate

    return locate(given or os.environ.get("RILLE_CACHE") or Path(".rille/cache"))


def check_output(path: Path, *endings: str) -> None:
    """Refuse a name that the file to be written cannot have, before anything is computed.

    Raises
    ------
    ConfigError
        ``path`` is a folder, or has none of the ``endings`` where there are any.
    """
    from rille.stages.core.errors import ConfigError

    if path.is_dir():
        raise ConfigError("RIL-047", f"the output {path} is a folder", remedy="name a file in it")
    if endings and path.suffix.lower() not in endings:
        allowed = " or ".join(endings)
        raise ConfigError("RIL-871", f"the output {path} has another ending", remedy=f"end it in {allowed}")


def prepare() -> None:
    """One thread a library, safe kernels, and nothing of the current folder, before NumPy and numba are imported."""
    from rille.pipeline.engine.runtime import apart
    from rille.pipeline.engine.runtime.environment import prepare_environment

    prepare_environment()
    apart.leave_out()
    apart.ignore_settings()
