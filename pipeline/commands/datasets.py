"""``rille datasets``: sequences that Rille knows."""

from __future__ import annotations

from pathlib import Path

from cyclopts import App

from rille.pipeline.commands.options import COMPLETE, Assignments, CacheFolder, Debug, cache_folder, prepare

app = App(name="datasets", help="Sequences that Rille knows: list them, or export one for other tools.")


@app.default
@app.command(name="list")
def list_datasets() -> int:
    """List the built-in sequences and the folder layouts that are recognised."""
    from rille.datasets.registry import catalogue

    for name, words in catalogue():
        print(f"{name:16s} {words}")
    return COMPLETE


@app.command
def export(
    seq: str,
    directory: Path,
    *,
    assignments: Assignments = None,
    cache: CacheFolder = None,
    debug: Debug = False,
) -> int:
    """Write a built-in sequence as plain files (PNG, rig, poses, disparity, DEM, times), for use by other tools.

    Parameters
    ----------
    seq
        Name of a built-in sequence.
    directory
        Folder to make; it must not exist yet or be empty.
    """
    prepare()
    from rille.pipeline.runs import session

    return session.export_dataset(seq, directory, tuple(assignments or ()), cache_folder(cache))
