"""The command line, ``rille COMMAND``.

Exit codes: 0 complete; 1 failed; 2 usage, configuration or input; 3 finished, but not all of it: what the data do not
determine, failures under ``--keep-going``, frames without a pose, images that do not match, a drive that did not reach
its goal, a parameter that no task read; 130 interrupted. Results go to stdout, progress and complaints to stderr. The
module of a command is imported when the command is named, so that ``rille --help`` answers at once.
"""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path

from cyclopts import App, CycloptsError, MissingArgumentError, UnusedCliTokensError
from rich.console import Console

from rille.pipeline.commands.complaints import complain, print_error
from rille.pipeline.engine.plain import plain_output, raw
from rille.pipeline.runs.options import COMPLETE, FAILED, INTERRUPTED, USAGE

COMMANDS = {
    "reconstruct": "computing.reconstruct:reconstruct",
    "watch": "computing.watch:watch",
    "drive": "computing.reconstruct:drive",
    "plan": "computing.plan:plan",
    "graph": "computing.plan:graph",
    "why": "results.why:why",
    "timing": "results.runs:timing",
    "view": "results.runs:view",
    "compare": "results.compare:compare",
    "runs": "results.runs:list_runs",
    "params": "params:params",
    "compile": "computing.compile:compile_kernels",
    "check": "sequences.check:check",
    "init": "sequences.init:init",
    "calibrate": "sequences.calibrate:calibrate",
    "rig": "results.rig:rig",
    "mask": "sequences.mask:mask",
    "match": "sequences.match:match",
    "export": "results.export:export",
    "compare-dem": "results.compare_dem:compare_dem",
    "localize": "results.localize:localize",
    "merge": "results.merge:merge",
    "datasets": "sequences.datasets:app",
    "cache": "cache:app",
}
"""Module and name of each command."""


def _versions() -> str:
    """Version of the program, of what its results depend on, and the machine's kind; one a line."""
    import platform

    from rille.pipeline.engine.keys import installed

    versions = installed() | {"system": f"{platform.system()} {platform.machine()}"}
    return "\n".join(f"{name:24s} {version}" for name, version in versions.items())


def program(*, listed: bool = False) -> App:
    """Return the app of all commands; ``listed``: to print their list, for which no module of a command is imported."""
    app = App(
        name="rille",
        suppress_keyboard_interrupt=False,  # cyclopts would end the program without a word
        version=_versions,
        version_format="plaintext",
        help="Stereo image sequences to terrain, trajectory, risk map and safe path, without rectification.",
        help_epilogue="--debug, with any command, shows tracebacks.",
    )
    for name, place in COMMANDS.items():
        # A line that is given here takes the place of the whole help text of the command.
        app.command(f"rille.pipeline.commands.{place}", name=name, **({"help": summary(place)} if listed else {}))
    app.register_install_completion_command(help="Install completion of commands and options for your shell.")
    return app


def summary(place: str) -> str:
    """First line of the docstring of a command, or of the module of an app of several, read from its source alone."""
    module, _, name = place.partition(":")
    path = Path(__file__).with_name("commands") / f"{module.replace('.', '/')}.py"
    source = path.read_text(encoding="utf-8")
    return source[max(source.find(f"def {name}("), 0) :].split('"""', 2)[1].partition("\n")[0]


app = program()


def main(argv: list[str] | None = None) -> None:
    """Entry point of ``rille``."""
    if argv is None and sys.getfilesystemencoding() != "utf-8":
        # Names of files are in UTF-8 in any locale; in that of ASCII they could be neither printed nor written.
        os.execv(sys.executable, [sys.executable, "-X", "utf8", *sys.orig_argv[1:]])
    with plain_output():
        try:
            code = _run(argv)
            # Flushed here, where a closed pipe can be caught: at exit Python would print a traceback.
            sys.stdout.flush()
        except BrokenPipeError:  # the reader of the output closed it
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            code = FAILED
    sys.exit(code)


def prepare() -> None:
    """One thread a library, safe kernels, and nothing of the current folder, before NumPy and numba are imported."""
    from rille.pipeline.engine.runtime import environment

    environment.prepare_environment()
    environment.leave_out()
    environment.ignore_settings()


def _run(argv: list[str] | None) -> int:
    given = list(sys.argv[1:] if argv is None else argv)
    # Every command takes it; looked for here, for an error may come before a command is known.
    tokens, debug = [word for word in given if word != "--debug"], "--debug" in given
    try:
        prepare()
        # New objects before Python's collector looks for unreachable cycles
        # By default the collector looks through all that is imported again and again, a tenth of the time of a start.
        gc.set_threshold(50_000)
        console = Console(file=raw(sys.stdout))  # of the help, which has colours
        chosen = program(listed=True) if tokens in ([], ["-h"], ["--help"]) else app
        code = chosen(tokens, console=console, exit_on_error=False, print_error=False, result_action="return_value")
        # Most commands either complete, and give no code, or raise.
        return code if isinstance(code, int) else COMPLETE
    except KeyboardInterrupt:
        print("rille: interrupted; the same command resumes from here", file=sys.stderr)
        return INTERRUPTED
    except CycloptsError as error:
        words = " ".join(("rille", *(error.command_chain or ())))
        extra = isinstance(error, UnusedCliTokensError)
        text = f"unexpected {', '.join(map(repr, error.unused_tokens or ()))}." if extra else str(error)
        hint = f" `{words} --help` says what it takes." if extra or isinstance(error, MissingArgumentError) else ""
        dashed = [
            f" The path {word} is given as ./{word}." for word in tokens if word[:1] == "-" and os.path.lexists(word)
        ]
        print_error("RIL-001", f"{text}{hint}{''.join(dashed)}")
        return USAGE
    except BrokenPipeError:
        raise
    except Exception as error:
        return complain(error, debug=debug)


if __name__ == "__main__":
    main()
