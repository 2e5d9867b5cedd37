"""The command line: ``rille reconstruct | drive | plan | runs | why | timing | compile | check | init | match | ...``.

Exit codes: 0 complete; 1 failed; 2 usage, configuration or input; 3 finished, but not all of it: what the data do not
determine, failures under ``--keep-going``, frames without a pose, images that do not match, a drive that did not reach
its goal, a parameter that no task read; 130 interrupted. Results go to stdout, progress and complaints to stderr. The
module of a command is imported when the command is named, so that ``rille --help`` answers at once.
"""

from __future__ import annotations

import os
import sys
import traceback

from cyclopts import App, CycloptsError, MissingArgumentError, UnusedCliTokensError
from rich.console import Console

from rille.pipeline.commands.options import COMPLETE, FAILED, INTERRUPTED, USAGE, prepare
from rille.pipeline.engine.plain import plain_output, raw

LONGEST_COMPLAINT = 1000
"""Characters."""

COMMANDS = {
    "reconstruct": (
        "reconstruct:reconstruct",
        "Reconstruct a sequence; the same command again resumes, and recomputes only what changed.",
    ),
    "drive": (
        "reconstruct:drive",
        "Drive a simulated rover to a goal in a closed loop: stop, map, plan, drive, localise, repeat.",
    ),
    "plan": ("plan:plan", "Show what `reconstruct` would compute and why, and what is cached; nothing is computed."),
    "graph": ("graph:graph", "Draw the tasks of a run and what each reads, by stage."),
    "why": (
        "why:why",
        "Explain one task of a run: its inputs, why it was computed, its parameters and code, what changed since.",
    ),
    "timing": ("timing:timing", "Show where the time of a run went, by stage."),
    "view": ("view:view", "Open the report of a run in the browser; print its path."),
    "compare": (
        "compare:compare",
        "Compare two runs: which parameters, tasks, figures, positions and elevations differ.",
    ),
    "runs": ("runs:list_runs", "List runs, the latest last: name, state, tasks computed and cached, seconds."),
    "params": (
        "params:params",
        "Print all parameters, or those of one section: default, what is permitted, and meaning.",
    ),
    "compile": (
        "compile:compile_kernels",
        "Compile the numerical kernels for this user and machine, so that the first run need not.",
    ),
    "check": (
        "check:check",
        "Check a sequence: one finding a line, and a picture of the first pair's epipolar residuals.",
    ),
    "init": (
        "init:init",
        "Write a commented manifest of a folder of stereo images: what was found, and what is still needed.",
    ),
    "calibrate": (
        "calibrate:calibrate",
        "Calibrate a stereo rig from pictures of a chessboard; prints the residual of each view.",
    ),
    "match": (
        "match:match",
        "Match any two images, without calibration or rectification, to a two-band disparity TIFF.",
    ),
    "export": (
        "export:export",
        "Write a run for other programs: cloud.laz or cloud.ply (points), terrain.glb (mesh), a model, a map.",
    ),
    "compare-dem": (
        "compare_dem:compare_dem",
        "Compare elevation model A with reference B: errors, completeness, error against range and slope.",
    ),
    "datasets": ("datasets:app", "Sequences that Rille knows: list them, or export one for other tools."),
    "cache": ("cache:app", "Look after the cache of artifacts."),
}
"""Module and name of each command, and the line about it in the list of all."""


def _versions() -> str:
    """Version of the program, of what its results depend on, and the machine's kind; one a line."""
    import platform

    from rille.pipeline.engine.packages import installed

    versions = installed()
    versions = {"rille": versions["rille"], **versions, "system": f"{platform.system()} {platform.machine()}"}
    return "\n".join(f"{name:24s} {version}" for name, version in versions.items())


def program(*, listed: bool = False) -> App:
    """Return the app of all commands; ``listed``: to print their list, for which no module of a command is imported."""
    app = App(
        name="rille",
        suppress_keyboard_interrupt=False,  # cyclopts would end the program without a word
        version=_versions,
        version_format="plaintext",
        help="Stereo image sequences to terrain, trajectory, risk map and safe path, without rectification.",
    )
    for name, (place, words) in COMMANDS.items():
        # A line that is given here takes the place of the whole help text of the command.
        app.command(f"rille.pipeline.commands.{place}", name=name, **({"help": words} if listed else {}))
    app.register_install_completion_command(help="Install completion of commands and options for your shell.")
    return app


app = program()


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
        prepare()
        console = Console(file=raw(sys.stdout))  # of the help, which has colours
        chosen = program(listed=True) if tokens in ([], ["-h"], ["--help"]) else app
        code = chosen(tokens, console=console, exit_on_error=False, print_error=False, result_action="return_value")
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
    if len(line) > LONGEST_COMPLAINT:  # of what a file holds, enough to find it
        line = f"{line[: LONGEST_COMPLAINT // 2]} ... {line[-LONGEST_COMPLAINT // 2 :]}"
    print(f"rille: error {code}: {line}", file=sys.stderr)


if __name__ == "__main__":
    main()
