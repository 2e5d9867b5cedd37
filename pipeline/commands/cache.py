"""``rille cache``: look after the cache of artifacts."""

from __future__ import annotations

from typing import Annotated

from cyclopts import App

from rille.pipeline.commands.options import RUNS, CacheFolder, Debug, Run, Runs, cache_folder, flag

app = App(name="cache", help="Look after the cache of artifacts.")


@app.command
def verify(
    *,
    deep: Annotated[bool, flag("Decode every chunk too, and compare the digests of the arrays.")] = False,
    cache: CacheFolder = None,
    debug: Debug = False,
) -> int:
    """Read every artifact and compare its checksums; damaged ones are named and recomputed by the next run."""
    from rille.pipeline.runs import session as run

    return run.verify_cache(cache_folder(cache), deep=deep)


@app.command
def gc(
    *,
    cache: CacheFolder = None,
    runs: Runs = RUNS,
    dry_run: Annotated[bool, flag("List by stage what would be removed, and remove nothing.")] = False,
    debug: Debug = False,
) -> int:
    """Remove artifacts that no kept and no pinned run refers to, and leftovers of interrupted runs."""
    from rille.pipeline.runs import session as run

    return run.collect_garbage(cache_folder(cache), runs, dry_run=dry_run)


@app.command
def ls(
    *,
    as_json: Annotated[bool, flag("As JSON.", "--json")] = False,
    cache: CacheFolder = None,
    runs: Runs = RUNS,
    debug: Debug = False,
) -> int:
    """List what the cache holds by sequence and stage: number, sizes, age, and the run that used it last."""
    from rille.pipeline.runs import inventory

    return inventory.ls(cache_folder(cache), runs, as_json=as_json)


@app.command
def pin(
    run: Run,
    *,
    cache: CacheFolder = None,
    runs: Runs = RUNS,
    debug: Debug = False,
) -> int:
    """Keep all artifacts of a run: gc leaves them alone, even if the run's folder is removed."""
    from rille.pipeline.runs import session as commands

    return commands.pin(cache_folder(cache), run, runs)


@app.command
def unpin(run: str, *, cache: CacheFolder = None, debug: Debug = False) -> int:
    """Remove the pin of a run; its artifacts stay until the next gc.

    Parameters
    ----------
    run
        SEQUENCE (its latest pin), SEQUENCE/ID, or ID.
    """
    from rille.pipeline.runs import session as commands

    return commands.unpin(cache_folder(cache), run)
