"""The command line: ``rille reconstruct | drive | plan | runs | why | timing | compile | check | init | match | ...``.

Exit codes: 0 complete; 1 failed; 2 usage, configuration or input; 3 finished, but not all of it: what the data do not
determine, failures under ``--keep-going``, frames without a pose, images that do not match, a drive that did not reach
its goal, a parameter that no task read; 130 interrupted. Results go to stdout, progress and complaints to stderr. Heavy
imports happen inside the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

import os
import sys
import traceback
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, CycloptsError, MissingArgumentError, UnusedCliTokensError
from rich.console import Console

from rille.pipeline.commands import cache as cache_commands
from rille.pipeline.commands import datasets as datasets_commands
from rille.pipeline.commands import files
from rille.pipeline.commands.options import (
    COMPLETE,
    FAILED,
    INTERRUPTED,
    RUNS,
    USAGE,
    Assignments,
    CacheFolder,
    Debug,
    Executor,
    Frames,
    MemoryLimit,
    Output,
    Results,
    Run,
    Runs,
    Settings,
    cache_folder,
    flag,
    options,
    prepare,
)
from rille.pipeline.engine.plain import plain_output, raw

LONGEST = 1000
"""Characters of a complaint."""


def _versions() -> str:
    """Version of the program, of what its results depend on, and the machine's kind; one a line."""
    import platform

    from rille.pipeline.engine.packages import installed

    found = installed()
    found = {"rille": found["rille"], **found, "system": f"{platform.system()} {platform.machine()}"}
    return "\n".join(f"{name:24s} {version}" for name, version in found.items())


app = App(
    name="rille",
    suppress_keyboard_interrupt=False,  # cyclopts would end the program without a word
    version=_versions,
    version_format="plaintext",
    help="Stereo image sequences to terrain, trajectory, risk map and safe path, without rectification.",
)
app.command(datasets_commands.app)
app.command(cache_commands.app)
for command in (files.init, files.calibrate, files.match, files.compare_dem):
    app.command(command)
app.command(files.export, name="export")

app.register_install_completion_command(help="Install completion of commands and options for your shell.")

_SETTINGS, _RESULTS = Settings(), Results()


@app.command
def reconstruct(
    seq: str = "mockup",
    *,
    settings: Settings = _SETTINGS,
    results: Results = _RESULTS,
    frames: Frames = None,
    executor: Executor = "dask",
    keep_going: Annotated[
        bool, flag("After a failure, finish all tasks that do not depend on it; the exit status is then 3.")
    ] = False,
    memory_limit: MemoryLimit = None,
) -> int:
    """Reconstruct a sequence; the same command again resumes, and recomputes only what changed.

    Parameters
    ----------
    seq
        A name from `rille datasets`, or a folder whose layout is recognised.
    """
    prepare()
    from rille.pipeline.runs import session as run

    given = options(
        seq, settings, results, frames=frames, executor=executor, keep_going=keep_going, memory_limit=memory_limit
    )
    return run.reconstruct(given)


@app.command
def drive(
    seq: str = "mockup-loop",
    *,
    settings: Settings = _SETTINGS,
    results: Results = _RESULTS,
    executor: Executor = "dask",
) -> int:
    """Drive a simulated rover to a goal in a closed loop: stop, map, plan, drive, localise, repeat.

    Prints how it ended (goal, no path, safety stop, stops, and why) and the folder of the report. What the rover does
    is set like any parameter: rover.slip=0.3, drive.goal=[0.2,1.1].

    Parameters
    ----------
    seq
        A simulated sequence; mockup-loop.
    """
    prepare()
    from rille.pipeline.runs import session as run

    return run.reconstruct(replace(options(seq, settings, results, executor=executor), verb="drive"))


@app.command
def plan(
    seq: str = "mockup",
    *,
    settings: Settings = _SETTINGS,
    frames: Frames = None,
    executor: Literal["dask", "inline"] = "dask",
    memory_limit: MemoryLimit = None,
    verbose: Annotated[bool, flag("Each task with its reason.", "--verbose", "-v")] = False,
) -> int:
    """Show what `reconstruct` would compute and why, and what is cached; nothing is computed.

    Parameters
    ----------
    seq
        As for reconstruct.
    executor
        Where tasks would run.
    """
    prepare()
    from rille.pipeline.commands import plan as command

    given = options(seq, settings, _RESULTS, frames=frames, executor=executor, memory_limit=memory_limit)
    return command.plan(given, verbose=verbose)


@app.command
def graph(
    seq: str = "mockup",
    *,
    output: Annotated[Path, Output] = Path("graph.svg"),
    settings: Settings = _SETTINGS,
    frames: Frames = None,
    tasks: Annotated[bool, flag("Each task, not each stage.")] = False,
) -> int:
    """Draw the tasks of a run and what each reads, by stage.

    Parameters
    ----------
    seq
        As for reconstruct.
    output
        The drawing, .svg, or .dot for Graphviz.
    """
    prepare()
    from rille.pipeline.commands import graph as command

    return command.graph(options(seq, settings, _RESULTS, frames=frames), output, tasks=tasks)


@app.command
def why(
    run: Run,
    task: str,
    *,
    runs: Runs = RUNS,
    cache: CacheFolder = None,
    debug: Debug = False,
) -> int:
    """Explain one task of a run: its inputs, why it was computed, its parameters and code, what changed since.

    Parameters
    ----------
    task
        The task's label, as in the run's ledger.jsonl: hfvm/12, locus/world/12, trajectory.
    """
    from rille.pipeline.commands.why import describe
    from rille.pipeline.engine.store.base import Store
    from rille.pipeline.runs import lookup

    folder = lookup.find(run, runs)
    with lookup.reading(folder):
        print("\n".join(describe(folder, task, Store(cache_folder(cache)))))
    return COMPLETE


@app.command
def timing(run: Run = "latest", *, runs: Runs = RUNS, debug: Debug = False) -> int:
    """Show where the time of a run went, against the least time that its tasks permit."""
    from rille.pipeline.runs import critical_path, lookup

    folder = lookup.find(run, runs)
    with lookup.reading(folder):
        print("\n".join(critical_path.describe(folder)))
    return COMPLETE


@app.command
def view(run: Run = "latest", *, runs: Runs = RUNS, debug: Debug = False) -> int:
    """Open the report of a run in the browser; print its path."""
    from rille.pipeline.commands import view as command
    from rille.pipeline.runs import lookup

    return command.view(lookup.find(run, runs))


@app.command
def compare(
    a: Run,
    b: Run,
    *,
    output: Annotated[Path, Output] = Path("comparison.png"),
    runs: Runs = RUNS,
    debug: Debug = False,
) -> int:
    """Compare two runs: which parameters, tasks, figures, positions and elevations differ.

    Parameters
    ----------
    output
        Picture of the difference of the elevations, A minus B, to write.
    """
    prepare()
    from rille.pipeline.commands import compare as command
    from rille.pipeline.runs import lookup

    return command.compare(lookup.find(a, runs), lookup.find(b, runs), output)


@app.command(name="runs")
def list_runs(sequence: str = "", *, runs: Runs = RUNS, debug: Debug = False) -> int:
    """List runs, the latest last: name, state, tasks computed and cached, seconds.

    Parameters
    ----------
    sequence
        Runs of this sequence only; all by default.
    """
    from rille.pipeline.runs import lookup

    return lookup.show(sequence, runs)


@app.command
def params(
    section: str = "",
    *,
    markdown: Annotated[bool, flag("As tables of Markdown.")] = False,
    debug: Debug = False,
) -> int:
    """Print all parameters, or those of one section: default, what is permitted, and meaning.

    Parameters
    ----------
    section
        Such as locus; all by default.
    """
    from rille.pipeline.commands import params as command

    return command.show(section, markdown=markdown)


@app.command(name="compile")
def compile_kernels(*, debug: Debug = False) -> int:
    """Compile the numerical kernels for this user and machine, so that the first run need not.

    Runs two small simulated sequences in a temporary folder. What is compiled stays: again, nothing is left to compile.
    """
    prepare()
    from rille.pipeline.runs import compilation as command

    return command.compile_kernels()


@app.command
def check(
    seq: str,
    *,
    output: Annotated[Path | None, Output] = None,
    assignments: Assignments = None,
    frames: Frames = None,
    cache: CacheFolder = None,
    debug: Debug = False,
) -> int:
    """Check a sequence: one finding a line, and a picture of the first pair's epipolar residuals.

    Parameters
    ----------
    seq
        As for reconstruct.
    output
        PNG to write; SEQUENCE-check.png by default.
    """
    prepare()
    from rille.pipeline.commands import check as command
    from rille.pipeline.flow.unread import refuse_unchecked
    from rille.pipeline.runs.session import settings as settle

    given = options(seq, Settings(assignments=assignments, cache=cache), _RESULTS, frames=frames)
    settled = settle(given)
    refuse_unchecked(settled.given, settled.config)
    return command.check(settled.sequence, settled.config, output=output, frames=settled.frames, cache=given.cache)


def main(argv: list[str] | None = None) -> None:
    """Entry point of ``rille``."""
    with plain_output():
        try:
            code = _run(argv)
            # Here, where a reader that has gone is still an exception: at exit Python would print a traceback.
            sys.stdout.flush()
        except BrokenPipeError:  # who read the output has had enough of it
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            code = FAILED
    sys.exit(code)


def _run(argv: list[str] | None) -> int:
    tokens = list(sys.argv[1:] if argv is None else argv)
    # Asked of the words, not of the command: an error may come before its options are known.
    debug = "--debug" in tokens
    try:
        console = Console(file=raw(sys.stdout))  # of the help, which has colours
        code = app(tokens, console=console, exit_on_error=False, print_error=False, result_action="return_value")
        # --help and --version give no code.
        return code if isinstance(code, int) else COMPLETE
    except KeyboardInterrupt:
        print("rille: interrupted; the same command resumes from here", file=sys.stderr)
        return INTERRUPTED
    except CycloptsError as error:
        words = " ".join(("rille", *(error.command_chain or ())))
        extra = isinstance(error, UnusedCliTokensError)
        text = f"unexpected {', '.join(map(repr, error.unused_tokens or ()))}." if extra else str(error)
        hint = f" `{words} --help` says what it takes." if extra or isinstance(error, MissingArgumentError) else ""
        _print_error("RIL-001", f"{text}{hint}")
        return USAGE
    except BrokenPipeError:
        raise
    except Exception as error:
        return _complain(error, debug)


def _complain(error: Exception, debug: bool) -> int:
    """One line that says what to change; the traceback on request."""
    from rille.pipeline.engine.failures import translated
    from rille.stages.core.errors import ConfigError, InputError

    if debug:
        traceback.print_exception(error)
    if (known := translated(error)) is not None:
        _print_error(known.code, str(known))
    else:
        hint = "" if debug else " (run again with --debug for the traceback)"
        _print_error("RIL-999", f"{type(error).__name__}: {error}{hint}")
    return USAGE if isinstance(error, ConfigError | InputError) else FAILED


def _print_error(code: str, words: str) -> None:
    line = " ".join(words.split())
    if len(line) > LONGEST:  # of what a file holds, enough to find it
        line = f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"
    print(f"rille: error {code}: {line}", file=sys.stderr)


if __name__ == "__main__":
    main()
