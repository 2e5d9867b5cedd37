"""The command line: ``rille reconstruct | drive | plan | why | timing | check | init | calibrate | match | ...``.

Exit codes: 0 complete; 1 failed; 2 usage, configuration or input; 3 finished with holes under ``--keep-going``;
130 interrupted. Results go to stdout, progress and complaints to stderr. Heavy imports happen inside the commands, so
that ``--help`` answers at once.
"""

from __future__ import annotations

import os
import sys
import traceback
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, CycloptsError, Parameter

COMPLETE, FAILED, USAGE, HOLES, INTERRUPTED = 0, 1, 2, 3, 130

app = App(
    name="rille",
    version=version("rille"),
    help="Stereo image sequences to terrain, trajectory, risk map and safe path, without rectification.",
)
datasets_app = App(name="datasets", help="Sequences that Rille knows: list them, or export one for other tools.")
cache_app = App(name="cache", help="Look after the cache of artifacts.")
app.command(datasets_app)
app.command(cache_app)

Assignments = Annotated[list[str] | None, Parameter(name=["--set", "-s"], negative="", consume_multiple=False)]
CacheFolder = Annotated[str | None, Parameter(name="--cache")]
Progress = Literal["auto", "bar", "plain", "json", "quiet"]


def cache_folder(given: str | Path | None) -> Path | str:
    """Where the artifact cache is: ``--cache``, else ``RILLE_CACHE``, else ``.rille/cache`` here."""
    from pipeline.location import locate

    return locate(given or os.environ.get("RILLE_CACHE") or Path(".rille/cache"))


def _prepare(cache: str | None) -> None:
    """Threads and the place of compiled kernels, before NumPy and numba are imported."""
    from pipeline.environment import prepare_environment
    from pipeline.location import hints_folder

    prepare_environment(hints_folder(cache_folder(cache)))


@app.command
def reconstruct(
    seq: str = "mockup",
    *,
    assignments: Assignments = None,
    config: Path | None = None,
    frames: str | None = None,
    jobs: int | None = None,
    executor: str = "processes",
    keep_going: Annotated[bool, Parameter(negative="")] = False,
    force: Annotated[list[str] | None, Parameter(negative="", consume_multiple=False)] = None,
    fresh: Annotated[bool, Parameter(negative="")] = False,
    memory_limit: str | None = None,
    runs: Path = Path("runs"),
    cache: CacheFolder = None,
    progress: Progress = "auto",
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
    debug: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Reconstruct a sequence; the same command again resumes, and recomputes only what changed.

    Parameters
    ----------
    seq
        A name from `rille datasets`, or a folder whose layout is recognised.
    assignments
        A parameter, section.key=value, for example locus.cell_size=0.002; may be repeated.
    config
        TOML file of parameters; every run writes one with all defaults filled.
    frames
        Frame range START:STOP[:STEP], as in Python; all by default.
    jobs
        Worker processes; the number of cores by default.
    executor
        Where tasks run: processes, threads, inline, or the address of a dask scheduler, tcp://host:port.
    keep_going
        Finish what does not depend on a failed task; the exit status is then 3.
    force
        Recompute this stage although it is cached; may be repeated.
    fresh
        Write a new folder of results even if nothing is new and the latest run stands.
    memory_limit
        Memory that the run may take in all, for example 6GB or 75%; nine tenths of what is free by default.
    runs
        Folder of results; each run makes RUNS/sequence/run-id.
    cache
        Folder of cached artifacts, or s3://bucket/prefix; RILLE_CACHE or .rille/cache by default.
    progress
        How progress is shown on stderr.
    quiet
        No progress; complaints only.
    debug
        Show tracebacks.
    """
    _prepare(cache)
    from pipeline import run

    options = run.Options(
        sequence=seq,
        assignments=tuple(assignments or ()),
        config=config,
        frames=frames,
        jobs=jobs,
        executor=executor,
        keep_going=keep_going,
        force=frozenset(force or ()),
        runs=runs,
        cache=cache_folder(cache),
        progress="quiet" if quiet else progress,
        fresh=fresh,
        memory_limit=memory_limit,
    )
    return run.reconstruct(options)


@app.command
def drive(
    seq: str = "mockup-loop",
    *,
    assignments: Assignments = None,
    config: Path | None = None,
    jobs: int | None = None,
    executor: str = "processes",
    force: Annotated[list[str] | None, Parameter(negative="", consume_multiple=False)] = None,
    fresh: Annotated[bool, Parameter(negative="")] = False,
    runs: Path = Path("runs"),
    cache: CacheFolder = None,
    progress: Progress = "auto",
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
    debug: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Drive a simulated rover to a goal in a closed loop: stop, think, drive, localise, and again.

    Prints how it ended (goal, no path, safety stop and why) and the folder of the report.

    Parameters
    ----------
    seq
        A simulated sequence; mockup-loop.
    assignments
        A parameter, section.key=value, for example rover.slip=0.3 or drive.goal=[0.2,1.1]; may be repeated.
    config
        TOML file of parameters; every run writes one with all defaults filled.
    jobs
        Worker processes; the number of cores by default.
    executor
        Where tasks run: processes, threads, inline, or the address of a dask scheduler, tcp://host:port.
    force
        Recompute this stage although it is cached; may be repeated.
    fresh
        Write a new folder of results even if nothing is new and the latest run stands.
    runs
        Folder of results; each run makes RUNS/sequence/run-id.
    cache
        Folder of cached artifacts, or s3://bucket/prefix; RILLE_CACHE or .rille/cache by default.
    progress
        How progress is shown on stderr.
    quiet
        No progress; complaints only.
    debug
        Show tracebacks.
    """
    _prepare(cache)
    from pipeline import run

    options = run.Options(
        sequence=seq,
        assignments=tuple(assignments or ()),
        config=config,
        jobs=jobs,
        executor=executor,
        force=frozenset(force or ()),
        runs=runs,
        cache=cache_folder(cache),
        progress="quiet" if quiet else progress,
        fresh=fresh,
        verb="drive",
    )
    return run.reconstruct(options)


@app.command
def plan(
    seq: str = "mockup",
    *,
    assignments: Assignments = None,
    config: Path | None = None,
    frames: str | None = None,
    jobs: int | None = None,
    executor: Literal["processes", "threads", "inline"] = "processes",
    force: Annotated[list[str] | None, Parameter(negative="", consume_multiple=False)] = None,
    memory_limit: str | None = None,
    cache: CacheFolder = None,
    verbose: Annotated[bool, Parameter(name=["--verbose", "-v"], negative="")] = False,
    debug: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Say what `reconstruct` would compute, what is cached, and why each miss; nothing is computed.

    Parameters
    ----------
    seq
        As for reconstruct.
    assignments
        A parameter, section.key=value; may be repeated.
    config
        TOML file of parameters.
    frames
        Frame range START:STOP[:STEP]; all by default.
    jobs
        Workers that the estimates are for; the number of cores by default.
    executor
        Where tasks would run.
    force
        Stage that would be recomputed although it is cached; may be repeated.
    memory_limit
        Memory that the run may take in all, for example 6GB or 75%; nine tenths of what is free by default.
    cache
        Folder of cached artifacts, or s3://bucket/prefix; RILLE_CACHE or .rille/cache by default.
    verbose
        Each task with its reason.
    debug
        Show tracebacks.
    """
    _prepare(cache)
    from pipeline import plan as command
    from pipeline.run import Options

    options = Options(
        sequence=seq,
        assignments=tuple(assignments or ()),
        config=config,
        frames=frames,
        jobs=jobs,
        executor=executor,
        force=frozenset(force or ()),
        memory_limit=memory_limit,
        cache=cache_folder(cache),
    )
    return command.plan(options, verbose=verbose)


@app.command
def why(
    run: str,
    task: str,
    *,
    runs: Path = Path("runs"),
    cache: CacheFolder = None,
    debug: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Say of one task of a run where its inputs come from, why it was computed or not, with what, and what has changed.

    Parameters
    ----------
    run
        SEQUENCE (its latest run), SEQUENCE/ID, or the run's folder.
    task
        The task's label, as in the run's ledger.jsonl: hfvm/12, locus/world/12, trajectory.
    runs
        Folder of runs.
    cache
        Folder of cached artifacts; RILLE_CACHE or .rille/cache by default.
    debug
        Show tracebacks.
    """
    from pipeline import why as command

    return command.why(run, task, folder=runs, cache=cache_folder(cache))


@app.command
def timing(
    run: str = "latest", *, runs: Path = Path("runs"), debug: Annotated[bool, Parameter(negative="")] = False
) -> int:
    """Say where the time of a run went, and how far it is from what its tasks allow.

    Parameters
    ----------
    run
        SEQUENCE (its latest run), SEQUENCE/ID, or the run's folder; the latest of all by default.
    runs
        Folder of runs.
    debug
        Show tracebacks.
    """
    from pipeline import timing as command

    return command.show(run, runs)


@app.command
def check(
    seq: str,
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    assignments: Assignments = None,
    frames: str | None = None,
    cache: CacheFolder = None,
    debug: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Open everything of a sequence and judge it, one line each; a picture shows the first pair's epipolar residuals.

    Parameters
    ----------
    seq
        As for reconstruct.
    output
        PNG to write; SEQUENCE-check.png by default.
    assignments
        A parameter of the sequence, section.key=value; may be repeated.
    frames
        Frame range START:STOP[:STEP]; all by default.
    cache
        Folder of cached artifacts, or s3://bucket/prefix; RILLE_CACHE or .rille/cache by default.
    debug
        Show tracebacks.
    """
    _prepare(cache)
    from pipeline import check as command
    from pipeline.run import Options, choose_frames, settings

    options = Options(sequence=seq, assignments=tuple(assignments or ()), frames=frames, cache=cache_folder(cache))
    sequence, _, _ = settings(options)
    return command.check(sequence, output=output, frames=choose_frames(frames, sequence.frames), cache=options.cache)


@app.command
def init(
    directory: Path,
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    force: Annotated[bool, Parameter(negative="")] = False,
    debug: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Look at a folder of stereo images and write a commented manifest: what was found, and what is still needed.

    Parameters
    ----------
    directory
        Folder with the images, and with whatever is known of the cameras.
    output
        Manifest to write; by default DIRECTORY's name with .rille.toml, in the present folder.
    force
        Replace a manifest that is there.
    debug
        Show tracebacks.
    """
    from pipeline import init as command

    return command.init(directory, output, force)


@app.command
def calibrate(
    left: Path,
    right: Path,
    *,
    square: float,
    corners: str | None = None,
    model: Literal["radtan", "radtan4", "rational", "fisheye"] = "radtan",
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("rig.yaml"),
    keep_bad: Annotated[bool, Parameter(negative="")] = False,
    debug: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Calibrate a stereo rig from pictures of a chessboard; prints the residual of each view.

    Parameters
    ----------
    left
        Folder or glob of the left camera's images.
    right
        The same of the right camera; views are paired by number.
    square
        Side of a square, metres.
    corners
        Inner corners, COLUMNSxROWS, for example 9x6; found by itself if not given.
    model
        Distortion model.
    output
        YAML file to write.
    keep_bad
        Use views too whose residuals are far above the others'.
    debug
        Show tracebacks.
    """
    from pipeline import calibrate as command

    return command.calibrate(left, right, square=square, corners=corners, model=model, output=output, keep_bad=keep_bad)


@app.command
def match(
    left: Path,
    right: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("disparity.tif"),
    preset: Literal["default", "fast", "accurate", "paper"] | None = None,
    dense: Annotated[bool, Parameter(negative="")] = False,
    prior_disparity: Path | None = None,
    confidence: Path | None = None,
    assignments: Assignments = None,
    debug: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Match any two images, without calibration or rectification, to a two-band disparity TIFF.

    Band 1 is column_disparity and band 2 row_disparity, float32 pixels, right minus left (negative columns on a
    rectified pair), NaN where undefined.

    Parameters
    ----------
    left
        Reference image.
    right
        Search image.
    output
        TIFF to write.
    preset
        Parameter set of the matcher: fast matches at half the resolution, accurate takes several times as long, paper
        follows the publication to the letter.
    dense
        Fill undefined disparities by interpolation.
    prior_disparity
        Disparity TIFF of this left image to start from, as this command writes it; where it is undefined the search
        starts as without it. It may err by some pixels: three and a few more from neighbours.
    confidence
        TIFF to write with the bands disparity_std (pixels, standard deviation of the column), validity (bits) and
        backmatch_error (pixels).
    assignments
        A parameter of the matcher, hfvm.key=value; may be repeated.
    debug
        Show tracebacks.
    """
    _prepare(None)
    from pipeline import match as command

    return command.match_files(
        left,
        right,
        output,
        preset=preset,
        dense=dense,
        assignments=tuple(assignments or ()),
        prior=prior_disparity,
        confidence=confidence,
    )


@app.command(name="export")
def export_run(
    run: Path,
    *,
    to: Annotated[list[Literal["laz", "glb", "colmap"]], Parameter(negative="")],
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    cache: CacheFolder = None,
    debug: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Write a run for other programs: cloud.laz (a point a cell), terrain.glb (textured mesh) or a COLMAP model.

    Parameters
    ----------
    run
        Folder of a run, for example runs/mockup/latest.
    to
        laz: CloudCompare, PDAL, QGIS; glb: any glTF viewer, Blender; colmap: cameras, rig, poses and tracked points.
        May be repeated.
    output
        What to write, for one form only; by default cloud.laz, terrain.glb or the folder colmap in the run's folder.
    cache
        Folder of cached artifacts (colmap); RILLE_CACHE or .rille/cache by default.
    debug
        Show tracebacks.
    """
    from stages.errors import ConfigError

    if output is not None and len(to) > 1:
        raise ConfigError(
            f"--output names one place for {len(to)} forms", remedy="give one --to, or leave --output out"
        )
    _prepare(cache)
    for kind in to:
        print(_export(run, kind, output, cache))
    return COMPLETE


def _export(run: Path, kind: Literal["laz", "glb", "colmap"], output: Path | None, cache: str | None) -> str:
    """Write one form; what was written, in words."""
    if kind == "colmap":
        from pipeline import colmap
        from pipeline.store import at

        return str(colmap.export_run(run, output or run / kind, at(cache_folder(cache))))
    from pipeline import cloud

    path, words = cloud.export(run, kind, output)
    return f"{path}  {words}"


@app.command(name="compare-dem")
def compare_dem(
    a: Path,
    b: Path,
    *,
    align: Literal["none", "shift", "tilt", "rigid"] = "none",
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("dem_comparison"),
    debug: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Compare elevation model A with reference B: errors, completeness, error against range and slope.

    The finer one is brought to the coarser one's cells (means of the known cells inside, or bilinear between four known
    ones); only cells that both know are compared. Prints the figures; writes OUTPUT.png and OUTPUT.json.

    Parameters
    ----------
    a
        GeoTIFF, folder of a run, or zarr group with elevation, x and y.
    b
        Reference, likewise.
    align
        Move A onto B first: shift (x, y, z), tilt (z and two inclinations) or rigid (all six); what was moved is told.
    output
        Files to write, without ending.
    debug
        Show tracebacks.
    """
    _prepare(None)
    from pipeline import compare_dem as command

    return command.compare(a, b, align=align, output=output)


@datasets_app.default
def list_datasets() -> int:
    """List the built-in sequences and the folder layouts that are recognised."""
    from datasets.registry import catalogue

    for name, words in catalogue():
        print(f"{name:16s} {words}")
    return COMPLETE


@datasets_app.command
def export(
    seq: str,
    directory: Path,
    *,
    assignments: Assignments = None,
    cache: CacheFolder = None,
    debug: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Write a built-in sequence as plain files (PNG, rig, poses, disparity, DEM, times), for use by other tools.

    Parameters
    ----------
    seq
        Name of a built-in sequence.
    directory
        Folder to make; it must not exist yet or be empty.
    assignments
        A parameter of the sequence, for example mockup.seed=3; may be repeated.
    cache
        Folder of cached artifacts, or s3://bucket/prefix; RILLE_CACHE or .rille/cache by default.
    debug
        Show tracebacks.
    """
    _prepare(cache)
    from pipeline import run

    return run.export_dataset(seq, directory, tuple(assignments or ()), cache_folder(cache))


@cache_app.command
def verify(
    *,
    deep: Annotated[bool, Parameter(negative="")] = False,
    cache: CacheFolder = None,
    debug: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Read every artifact and compare its checksums; damaged ones are named and recomputed by the next run.

    Parameters
    ----------
    deep
        Decode every chunk too, and compare the digests of the arrays.
    cache
        Folder of cached artifacts, or s3://bucket/prefix; RILLE_CACHE or .rille/cache by default.
    debug
        Show tracebacks.
    """
    from pipeline import run

    return run.verify_cache(cache_folder(cache), deep=deep)


@cache_app.command
def gc(
    *,
    cache: CacheFolder = None,
    runs: Path = Path("runs"),
    dry_run: Annotated[bool, Parameter(negative="")] = False,
    debug: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Remove artifacts that no kept and no pinned run refers to, and leftovers of interrupted runs.

    Parameters
    ----------
    cache
        Folder of cached artifacts, or s3://bucket/prefix; RILLE_CACHE or .rille/cache by default.
    runs
        Folder of the runs that are kept.
    dry_run
        Say what would go, by stage, and keep it.
    debug
        Show tracebacks.
    """
    from pipeline import run

    return run.collect_garbage(cache_folder(cache), runs, dry_run=dry_run)


@cache_app.command
def ls(
    *,
    as_json: Annotated[bool, Parameter(name="--json", negative="")] = False,
    cache: CacheFolder = None,
    runs: Path = Path("runs"),
    debug: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Say what the cache holds, by sequence and stage: number, sizes, age, and the run that used it last.

    Parameters
    ----------
    as_json
        As JSON.
    cache
        Folder of cached artifacts; RILLE_CACHE or .rille/cache by default.
    runs
        Folder of the runs that are kept.
    debug
        Show tracebacks.
    """
    from pipeline import inventory

    return inventory.ls(cache_folder(cache), runs, as_json=as_json)


@cache_app.command
def pin(
    run: str,
    *,
    cache: CacheFolder = None,
    runs: Path = Path("runs"),
    debug: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Keep all artifacts of a run, whatever is cleared away, even if the run's folder is removed.

    Parameters
    ----------
    run
        SEQUENCE (its latest run), SEQUENCE/ID, or the run's folder.
    cache
        Folder of cached artifacts; RILLE_CACHE or .rille/cache by default.
    runs
        Folder of runs.
    debug
        Show tracebacks.
    """
    from pipeline import run as commands

    return commands.pin(cache_folder(cache), run, runs)


@cache_app.command
def unpin(run: str, *, cache: CacheFolder = None, debug: Annotated[bool, Parameter(negative="")] = False) -> int:
    """Take the pin of a run away; its artifacts stay until they are cleared away.

    Parameters
    ----------
    run
        SEQUENCE/ID, or ID.
    cache
        Folder of cached artifacts; RILLE_CACHE or .rille/cache by default.
    debug
        Show tracebacks.
    """
    from pipeline import run as commands

    return commands.unpin(cache_folder(cache), run)


def main(argv: list[str] | None = None) -> None:
    """Entry point of ``rille``."""
    tokens = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in tokens
    try:
        code = app(tokens, exit_on_error=False, print_error=False, result_action="return_value")
        code = code if isinstance(code, int) else COMPLETE
    except KeyboardInterrupt:
        print("rille: interrupted; the same command resumes from here", file=sys.stderr)
        code = INTERRUPTED
    except CycloptsError as error:
        print(f"rille: {error}", file=sys.stderr)
        code = USAGE
    except Exception as error:
        code = _complain(error, debug)
    sys.stdout.flush()
    sys.exit(code)


def _complain(error: Exception, debug: bool) -> int:
    """One line that says what to change; the traceback on request."""
    from stages.errors import ConfigError, InputError, RilleError

    if debug:
        traceback.print_exception(error)
    known = isinstance(error, RilleError)
    hint = "" if known or debug else " (run again with --debug for the traceback)"
    name = "" if known else f"{type(error).__name__}: "
    print(f"rille: {name}{' '.join(str(error).split())}{hint}", file=sys.stderr)
    return USAGE if isinstance(error, ConfigError | InputError) else FAILED


if __name__ == "__main__":
    main()
