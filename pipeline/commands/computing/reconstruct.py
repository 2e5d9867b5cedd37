"""``rille reconstruct`` and ``rille drive``: a run from its options to a folder of results."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rille.datasets.text.warning import warning
from rille.pipeline.commands import batch
from rille.pipeline.commands.options import COMPLETE, HOLES, DriveOptions, Options
from rille.pipeline.engine.plain import some, warn
from rille.pipeline.export.programs import rocrate
from rille.pipeline.runs import session

_OPTIONS, _DRIVE = Options(), DriveOptions()


def reconstruct(seq: str = "mockup", *more: str, options: Options = _OPTIONS) -> int:
    """Reconstruct sequences; the same command again resumes, and recomputes only what changed.

    Of several a table says at the end what became of each; the exit code is that of the worst. One that cannot be
    reconstructed ends the command, unless with --keep-going.

    Parameters
    ----------
    seq
        A name from `rille datasets`, a folder whose layout is recognised, a manifest, or an RO-Crate of a run
        (`rille export`), which is run again from its sequence and compared.
    more
        Others, which follow one after another.
    """
    if not more:
        return _perform(replace(options, sequence=seq))[0]
    sequences = (seq, *more)
    ended = batch.each(sequences, lambda name: _perform(replace(options, sequence=name)), keep_going=options.keep_going)
    print(batch.table(ended, sequences))
    return batch.worst(ended)


def _perform(options: Options) -> tuple[int, Path]:
    """Run a sequence, or the run of a crate anew; the exit code and the folder of the results."""
    if not (Path(options.sequence) / rocrate.METADATA).is_file():
        return session.perform(options)
    crate = rocrate.read(Path(options.sequence))
    frames = crate.options.get("--frames", (None,))[-1]
    again = replace(
        options,
        sequence=crate.sequence,
        config=options.config or crate.folder / "config.toml",
        frames=options.frames or frames,
        until=options.until or crate.options.get("--until", ()),
        only=options.only or crate.options.get("--only", ()),
    )
    code, run = session.perform(again)
    unlike = crate.unlike(run)
    print(f"{len(crate.digests) - len(unlike)} of {len(crate.digests)} results are those of {crate.folder}, to the bit")
    if unlike:
        warn(warning("RIL-041", f"other results than those of the crate: {some(unlike, 6)}"))
    return max(code, HOLES if unlike else COMPLETE), run


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
