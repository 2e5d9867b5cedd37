"""One run from options to a folder of results: open, configure, run the graph, write products and report.

All that takes time is a cached task, files and figures too; each run copies these into its folder
``RUNS/<sequence>/<run id>/`` and renders the page. ``latest`` moves last, and only to a folder that is complete or
whose report names its holes.
"""

from __future__ import annotations

import re
import sys
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rille.datasets.images.files import Digests
from rille.datasets.protocol import Sequence
from rille.datasets.registry import open_sequence
from rille.datasets.text.reading import read_toml
from rille.pipeline.engine import events, memory
from rille.pipeline.engine import run as driver
from rille.pipeline.engine.caller import check
from rille.pipeline.engine.failures import reason_of
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.keys import installed, remember
from rille.pipeline.engine.plain import warn
from rille.pipeline.engine.runtime import atomic
from rille.pipeline.engine.runtime.environment import permit_open_files
from rille.pipeline.engine.store.base import Store
from rille.pipeline.engine.store.maintenance import note_runs
from rille.pipeline.engine.workers import Workers
from rille.pipeline.export.view import UNSTATED, RunView, Settled
from rille.pipeline.flow import config as configuration
from rille.pipeline.flow import unread
from rille.pipeline.flow.closed_loop import Drive, dataflow
from rille.pipeline.report.delivery import lacking, left_out
from rille.pipeline.runs import part_of_run, run_files
from rille.pipeline.runs.checks.records import judge_rig
from rille.pipeline.runs.lookup import LEDGER, refuse_unknown
from rille.pipeline.runs.options import COMPLETE, HOLES, Options, Settings, cache_folder
from rille.stages.core.errors import ConfigError, RilleError, warning, within
from rille.stages.odometry.resection.trajectory import trajectory_stage


def choose_frames(text: str | None, count: int) -> tuple[int, ...]:
    """Frame numbers of ``START:STOP[:STEP]``, or all.

    Raises
    ------
    ConfigError
        The text is no range, or the range is empty or reaches beyond the sequence.
    """
    # From Python it may be no text.
    found = re.fullmatch(r"(\d{0,9}):(\d{0,9})(?::(\d{0,9}))?", ":" if text is None else str(text))
    start, stop, step = (int(part) if part else None for part in found.groups()) if found else (0, 0, 1)
    chosen = range(count)[start:stop:step] if step != 0 and (stop or 0) <= count else ()
    if not chosen:
        shown = f"--frames {text!r} is no range of the sequence's {count} frames"
        raise ConfigError("RIL-055", shown, remedy=f"give START:STOP[:STEP] within 0:{count}")
    return tuple(chosen)


def configured(options: Settings) -> tuple[dict[str, Any], dict[str, Any]]:
    """The user's settings by section: of the sequence, and of the stages."""
    given = read_toml(options.config, "configuration") if options.config else {}
    # --set overrides --config.
    return configuration.split_dataset(configuration.merge(given, configuration.parse_assignments(options.assignments)))


def settings(sequence: str | Sequence, options: Settings) -> Settled:
    """Open a sequence, if it is none yet, and determine its configuration: defaults, presets, file and options."""
    for_dataset, for_stages = configured(options)
    if isinstance(sequence, str):
        sequence = open_sequence(sequence, for_dataset, Digests(cache_folder(options.cache) / "files.json"))
    elif for_dataset:
        text = f"{next(iter(for_dataset))}: the sequence is open already"
        raise ConfigError("RIL-860", text, remedy="give its parameters to rille.open")
    source = UNSTATED if sequence.vehicle is None else f"sequence {sequence.name}"
    if "vehicle" in for_stages:
        source = "user"
    # Defaults of the sequence lie beneath the user's values.
    with within(f"defaults of {sequence.name}"):
        defaults = configuration.suited(sequence)
        suited = configuration.build(defaults)
    config = configuration.build(defaults, for_stages)
    given = unread.set_by_user(for_stages, config, suited)
    frames = choose_frames(options.frames, sequence.frames)
    return Settled(sequence=sequence, frames=frames, config=config, vehicle_source=source, given=given)


def settings_of_run(sequence: str | Sequence, options: Options, warn: Callable[[str], None] = warn) -> Settled:
    """As :func:`settings`, for a run: refuse unusable settings; ``warn`` takes warnings about suspicious ones."""
    # Before anything is read or written.
    if options.force:
        refuse_unknown("--force", options.force, configuration.stage_names(), "stage")
    check(options.executor, options.jobs)
    memory_limit(options)
    permit_open_files()
    settled = settings(sequence, options)
    sequence, driven = settled.sequence, settled.sequence.simulation is not None
    who = "a drive" if driven else f"a reconstruction of {sequence.name}"
    # A drive always is over ground.
    nobody = unread.foreign(driven=driven) | ({"terrain.reference"} if driven else set())
    unread.refuse(settled.given, settled.config, nobody, who)
    rig = judge_rig(sequence.rig)
    # A manifest warns about its baseline itself, with the key to change; code and place stand before the words.
    if rig.level != "OK" and not any("baseline" in line.split(": ", 2)[-1] for line in sequence.warnings):
        sequence = replace(sequence, warnings=(*sequence.warnings, f"{rig.code}: {rig.text}: {rig.remedy}"))
    for line in sequence.warnings:
        warn(line)
    return replace(settled, sequence=sequence)


def memory_limit(options: Options) -> int | None:
    """Bytes that a run may use in total; None: what is free."""
    return None if options.memory_limit is None else memory.parse(options.memory_limit)


@dataclass(frozen=True)
class RunResult:
    """Outcome of a run: its exit code, the folder of the results, and lines for stdout, the closing one first, and for
    stderr."""

    code: int
    folder: Path
    lines: list[str]
    complaints: list[str]

    def print(self) -> None:
        """Print all lines."""
        for line in self.complaints:
            print(line, file=sys.stderr)
        print("\n".join(self.lines))


@dataclass(frozen=True)
class _Opened:
    """A configured and laid out run: ``view`` for the report, ``folder`` for its results."""

    options: Options
    view: RunView
    folder: Path
    started: datetime
    store: Store
    graph: Graph
    drive: Drive | None


def late(view: RunView, drive: Drive | None, **known: Any) -> RunView:
    """The view with facts that are known late, such as the frames that a drive has recorded."""
    if drive is not None:
        known["sequence"], known["frames"] = drive.recorded()
    return replace(view, **known)


def perform(
    sequence: str | Sequence,
    options: Options,
    *,
    verb: str = "reconstruct",
    kept: list[Workers] | None = None,
    warn: Callable[[str], None] = warn,
) -> RunResult:
    """Run the whole chain; the same again resumes.

    Parameters
    ----------
    sequence : its name or path, or an open sequence.
    verb : command that asks for the run.
    kept : list that holds the workers after the run, for the next run with the same list; its maker ends them.
    warn : takes warnings, one line each; those of the input come before anything is computed.
    """
    opened = _open(sequence, options, verb, warn)
    made: run_files.Made = {}
    opened.graph.last = lambda: run_files.lay_out(opened.graph, late(opened.view, opened.drive), made)
    result = _compute(opened, kept)
    remember()
    report = _write(opened, result, made)
    _point_latest(opened.folder)
    last, outdated = opened.view.products.trajectory, opened.graph.outdated
    # What the trajectory lacked before it was adjusted, or driven to its end, is no matter.
    current = (h for h in opened.graph.nodes if h.stage != trajectory_stage.name or h is last)
    # The report has those of the rigs, of which there may be one for each pair.
    told = outdated | {rig.index for rig in opened.view.products.rigs.values()}
    valid = (h for h in current if h.index not in told)
    suspicious = (line for h in valid if h.ref is not None for line in h.ref.meta.get("warnings", ()))
    for line in unsaid((*suspicious, *report["warnings"]), report["missing"], opened.view.sequence.warnings):
        warn(line)
    return _summed_up(opened, result, report["missing"])


def unsaid(lines: Iterable[str], missing: Iterable[Mapping[str, str]], before: Iterable[str]) -> list[str]:
    """Warnings of tasks and of the report (which follow from several tasks), each once.

    Without those of the input, which came ``before`` the run, and those that the closing lines repeat as ``missing``.
    """
    said = {*before, *(item["what"] for item in missing)}
    return [line for line in dict.fromkeys(lines) if line not in said]


def _summed_up(opened: _Opened, result: driver.Result, missing: list[dict[str, str]]) -> RunResult:
    """Outcome of a run, with its closing lines; ``missing`` as its report lists it."""
    counts, lines, arrived = result.counts, [], True
    if opened.drive is not None:
        outcome, stops = opened.drive.outcome(), opened.drive.driven.stops
        lines.append(f"{': '.join(word for word in outcome if word)}  ({len(stops)} stops)")
        arrived = outcome[0] == "goal"
    page = opened.folder / "report.html"
    # Answers of stages, and failures outside of the reconstruction, do not count; nor do they in the exit code.
    lost = lacking(missing)
    made = f"computed {counts['computed']}, cached {counts['cached']}, missing {len(lost)}"
    lines.append(f"{page}  {made}, in {result.seconds:.1f} s")
    if opened.view.part:
        lines.append(f"left out, as {opened.view.part} asks: {left_out(result.left_out)}")
    complaints = [
        ": ".join(word for word in ("rille", "missing" if item in lost else "note", item["what"], item["why"]) if word)
        for item in missing
    ]
    if not result.ok:
        ledger = opened.folder / LEDGER
        complaints.append(f"rille: {counts['failed']} failed, {counts['skipped']} left out; ledger: {ledger}")
    done = result.ok and arrived
    # A drive that ended early has not reached the tasks that read some parameters.
    idle = list(_idle(opened)) if done else []
    whole = done and not lost and not idle
    return RunResult(COMPLETE if whole else HOLES, opened.folder, lines, [*complaints, *idle])


def _open(given: str | Sequence, options: Options, verb: str, warn: Callable[[str], None]) -> _Opened:
    """Read the input and lay the run out."""
    started = datetime.now(UTC)
    settled = settings_of_run(given, options, warn)
    sequence, frames, config = settled.sequence, settled.frames, settled.config
    if verb == "drive" and sequence.simulation is None:
        raise ConfigError("RIL-059", f"{sequence.name} is recorded, it cannot be driven", remedy="drive mockup-loop")
    command = options.command(verb, *(sequence.opened or (sequence.name,)))
    header = f"# {command}\n# rille reconstruct SEQ --config THIS_FILE uses the same parameters.\n\n"
    text = header + configuration.to_toml(config, sequence.parameters)
    graph, store = Graph(cut=part_of_run.cut(options.until, options.only)), Store(cache_folder(options.cache))
    products, drive = dataflow(graph, sequence, config, frames)
    # After the layout, so that no folder is left if that refuses something.
    folder = _make_folder(options.runs / sequence.name, started)
    atomic.write(folder / "config.toml", text)
    view = RunView(
        **vars(settled),
        run_id=folder.name,
        products=products,
        config_toml=text,
        versions=installed(),
        command=command,
        started=started.strftime("%Y-%m-%dT%H:%M:%SZ"),
        part=options.part(),
        until=options.until,
        only=options.only,
    )
    return _Opened(options, view, folder, started, store, graph, drive)


def _compute(opened: _Opened, kept: list[Workers] | None) -> driver.Result:
    """Run the graph; raise the first failure, unless the data are its cause and there are poses."""
    options, view = opened.options, opened.view
    note_runs(opened.store, options.runs)
    result = driver.run(
        opened.graph,
        opened.store,
        driver.RunOptions(
            executor=options.executor,
            jobs=options.jobs,
            keep_going=options.keep_going,
            force=options.force,
            ledger=opened.folder / LEDGER,
            progress=events.make("quiet" if options.quiet else options.progress, name=view.sequence.name),
            memory_limit=memory_limit(options),
            kept=kept,
        ),
    )
    trajectory = view.products.trajectory
    if not options.keep_going:
        posed = trajectory is not None and trajectory.done
        result.check(holes=view.sequence.simulation is not None or posed or bool(view.part))
    return result


def _write(opened: _Opened, result: driver.Result, made: run_files.Made) -> dict[str, Any]:
    """Write all files of the run; return the content of ``report.json``."""
    # The folder may be removed during the run; writing would make one without its first files.
    if not (opened.folder / "config.toml").exists():
        text = f"{opened.folder} was removed while the run was under way"
        raise RilleError("RIL-740", text, remedy="run again: what was computed is in the cache")
    if made["facts"].ref is None:
        # Without facts there is no report: the run fails with the error that prevented them.
        result.check()
    tasks = run_files.task_rows(opened.graph, result.failures)
    whole = late(opened.view, opened.drive, tasks=tasks, seconds=result.seconds, left_out=result.left_out)
    report = run_files.write(opened.folder, whole, made, opened.store)
    total = (datetime.now(UTC) - opened.started).total_seconds()
    holes = len(lacking(report["missing"]))
    events.add_facts(opened.folder / LEDGER, total=total, holes=holes, part=bool(opened.view.part))
    return report


def _idle(opened: _Opened) -> Iterator[str]:
    """Errors at the end of a run: parameters that no task read, and stages to force that it does not have."""
    # Parameters that a part of a run does not read may be for the rest.
    if not opened.view.part and (lost := unread.unread(opened.view.given, opened.view.config, opened.graph)):
        error = unread.error(lost, opened.view.config)
        yield f"rille: error {error.code}: {error}"
    idle = sorted(opened.options.force - {h.stage for h in opened.graph.nodes})
    if idle:
        yield f"rille: error RIL-735: --force {', '.join(idle)}: this run has no such task: leave it out"


def _make_folder(parent: Path, started: datetime) -> Path:
    """Make a folder named by the time of the start."""
    latest = parent / "latest"
    if latest.exists() and not latest.is_symlink():
        text = f"{latest} is no link to a run"
        raise ConfigError("RIL-765", text, remedy="move it away, or choose another --runs folder")
    # With microseconds, so that runs within a second have names of their own, in their order.
    folder = parent / f"{started:%Y%m%dT%H%M%SZ-%f}"
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        text = f"cannot make {folder}: {reason_of(error)}"
        raise ConfigError("RIL-061", text, remedy="choose another --runs folder") from error
    return folder


def _point_latest(folder: Path) -> None:
    """Move ``latest`` to a finished run in one step."""
    # Unlike symlink_to, a rename replaces the link in one step, so that readers find the earlier or the new run.
    link = folder.parent / f".latest-{uuid.uuid4().hex}"
    try:
        link.symlink_to(folder.name, target_is_directory=True)
        link.replace(folder.parent / "latest")
    except OSError as error:  # a file system without links; the results are complete
        text = f"{folder.parent / 'latest'} does not lead to this run: {error.strerror}; name it as {folder.name}"
        warn(warning("RIL-741", text))
