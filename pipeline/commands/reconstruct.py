"""``rille reconstruct`` and ``rille drive``: a run from its options to a folder of results."""

from __future__ import annotations

from dataclasses import replace

from rille.pipeline.commands import batch
from rille.pipeline.commands.options import DriveOptions, Options
from rille.pipeline.runs import session

_OPTIONS, _DRIVE = Options(), DriveOptions()


def reconstruct(seq: str = "mockup", *more: str, options: Options = _OPTIONS) -> int:
    """Reconstruct sequences; the same command again resumes, and recomputes only what changed.

    Of several a table says at the end what became of each; the exit code is that of the worst. One that cannot be
    reconstructed ends the command, unless with --keep-going.

    Parameters
    ----------
    seq
        A name from `rille datasets`, or a folder whose layout is recognised.
    more
        Others, which follow one after another.
    """
    if not more:
        return session.reconstruct(replace(options, sequence=seq))
    sequences = (seq, *more)
    ended = batch.each(
        sequences, lambda name: session.perform(replace(options, sequence=name)), keep_going=options.keep_going
    )
    print(batch.table(ended, sequences))
    return batch.worst(ended)


def drive(seq: str = "mockup-loop", *, options: DriveOptions = _DRIVE) -> int:
    """Drive a simulated rover to a goal in a closed loop: stop, map, plan, drive, localise, repeat.

    Prints how it ended (goal, no path, safety stop, stops, and why) and the folder of the report. What the rover does
    is set like any parameter: rover.slip=0.3, drive.goal=[0.2,1.1].

    Parameters
    ----------
    seq
        A simulated sequence; mockup-loop.
    """
    return session.reconstruct(replace(options, sequence=seq, verb="drive"))
