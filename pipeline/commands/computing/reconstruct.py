"""``rille reconstruct`` and ``rille drive``: a run from its options to a folder of results."""

from __future__ import annotations

from pathlib import Path

from rille.pipeline.commands import complaints
from rille.pipeline.commands.results.runs import describe
from rille.pipeline.engine.plain import warn
from rille.pipeline.runs import session
from rille.pipeline.runs.crate import resolved
from rille.pipeline.runs.options import COMPLETE, HOLES, DriveOptions, Options
from rille.stages.core.errors import warning
from rille.stages.core.quantities import some


def reconstruct(seq: str = "mockup", *more: str, options: Options = Options()) -> int:
    """Reconstruct sequences; the same command again resumes, and recomputes only what changed.

    Of several a table lists the runs at the end, as `rille runs` does; the exit code is that of the worst. One that
    cannot be reconstructed ends the command, unless with --keep-going.

    Parameters
    ----------
    seq
        A name from `rille datasets list`, a folder whose layout is recognised, a manifest, or an RO-Crate of a run
        (`rille export`), which is run again from its sequence and compared.
    more
        Others, which follow one after another.
    """
    if not more:
        return _perform(seq, options)[0]
    code, ended = complaints.each((seq, *more), lambda name: _perform(name, options), keep_going=options.keep_going)
    runs = describe(end for _, end in ended if isinstance(end, Path))
    print("\n".join([*runs, *(f"{sequence:44s} {end}" for sequence, end in ended if isinstance(end, str))]))
    return code


def _perform(seq: str, options: Options, verb: str = "reconstruct") -> tuple[int, Path]:
    """Run a sequence, or the run of a crate again; return the exit code and the folder of the results."""
    seq, options, crate = resolved(seq, options)
    result = session.perform(seq, options, verb=verb)
    result.print()
    if crate is None:
        return result.code, result.folder
    unlike = crate.unlike(result.folder)
    print(f"{len(crate.digests) - len(unlike)} of {len(crate.digests)} results are those of {crate.folder}, to the bit")
    if unlike:
        warn(warning("RIL-041", f"other results than those of the crate: {some(unlike, 6)}"))
    return max(result.code, HOLES if unlike else COMPLETE), result.folder


def drive(seq: str = "mockup-loop", *, options: DriveOptions = DriveOptions()) -> int:
    """Drive a simulated rover to a goal in a closed loop: stop, map, plan, drive, localise, repeat.

    Prints how it ended (goal, no path, safety stop, stops, and why) and the folder of the report. What the rover does
    is set like any parameter: rover.slip=0.3, drive.goal=[0.2,1.1].

    Parameters
    ----------
    seq
        A simulated sequence; mockup-loop.
    """
    return _perform(seq, options, "drive")[0]
