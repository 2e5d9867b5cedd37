"""Every stage bears inputs of which nothing, one or few things are usable: a result that can be committed, or a hole.

Small runs give one task of each stage, with its inputs. These are spoilt by what their stages declare as undefined; the
stage runs on them.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rille
from rille.pipeline.engine import run as driver
from rille.pipeline.engine.store.arrays import array_digests, output_digest
from rille.pipeline.engine.task import Spec, map_ports
from rille.pipeline.runs import run_files, session
from rille.stages.core.declare import AnyArray, Array, Bundle, Stage, check_outputs
from rille.stages.core.errors import DegenerateError

SHORT = (
    *("mockup.frames=4", "mockup.image_width=190", "mockup.image_height=174", "mockup.focal_length=200.0"),
    *("keyframes.stride=2", "locus.cell_size=0.006"),
)
LOOP = (
    *("mockup.image_width=160", "mockup.image_height=120", "mockup.focal_length=90.0", "mockup.cell=0.004"),
    *("mockup.bed_width=1.0", "mockup.bed_length=1.1", "mockup.rocks=0.0", "mockup.craters=0.0"),
    *("rover.frame_step=0.05", "locus.cell_size=0.008", "drive.goal=[0.03, 0.25]", "drive.around=0.4"),
)
RUNS = {
    "plain": ("mockup-short", "reconstruct", (*SHORT, "hfvm.preset=fast", "crosscheck.enabled=false")),
    "tiles": ("mockup-short", "reconstruct", (*SHORT, "hfvm.preset=default", "tiling.tile=128")),
    "drive": ("mockup-loop", "drive", (*LOOP, "hfvm.preset=fast")),
}
ELSEWHERE = {
    *(
        "calibration.knocked",
        "calibration.swap_check",
        "calibration.synchrony",
        "evaluation.position_accuracy",
        "hfvm.given",
        "imaging.undistort",
        "terrain.map_localization",
        *("odometry.loops", "odometry.resection.loop", "odometry.resection.adjust"),
    ),
}
"""Stages that need a lens, positions, a map, disparities, a doubt, a knock or a place seen again: their modules have
tests."""

AMOUNTS = {"nothing": 0, "one": 1, "few": 3}
POINTS = ("point", "block", "match", "vertex")


@dataclass(frozen=True)
class Task:
    """One task of a stage with its inputs, and the stages that made these."""

    label: str
    spec: Spec
    inputs: dict[str, Any]
    makers: dict[str, Any]

    def run(self, inputs: dict[str, Any]) -> Bundle | None:
        """Result that could be committed; None: the data do not determine it."""
        stage = self.spec.stage
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of empty means
            try:
                found = stage.run(self.spec.params, {**self.spec.args, **self.spec.hints}, inputs)
            except DegenerateError:
                return None
        check_outputs(stage, found)
        output_digest(array_digests(found.arrays), found.meta)
        return found


def recorded(names: list[str], folder: Path, *, outputs: bool = True) -> list[Task]:
    """The first task of each stage, and of each kind of tile and, where wanted, of output."""
    found: dict[Any, Task] = {}
    for name in names:
        sequence, verb, given = RUNS[name]
        where = {"runs": folder / "runs", "cache": folder / "cache"}
        opened = session._open(sequence, session.Options(given, executor="inline", **where), verb, print)
        if outputs:
            opened.graph.last = lambda opened=opened: run_files.lay_out(
                opened.graph, session.late(opened.view, opened.drive), {}
            )
        driver.run(opened.graph, opened.store, driver.RunOptions(executor="inline")).check()
        for node in opened.graph.nodes:
            kind = node.spec.args.get("step", node.spec.args.get("file"))
            wanted = node.inputs or node.spec.module.startswith("rille.stages.")
            if wanted and (node.spec.module, kind) not in found:
                inputs = map_ports(lambda h, store=opened.store: in_memory(store.open(h.ref)), node.inputs)
                makers = map_ports(lambda h: h.spec.stage, node.inputs)
                found[node.spec.module, kind] = Task(node.label, node.spec, inputs, makers)
    return list(found.values())


def in_memory(bundle: Bundle) -> Bundle:
    return Bundle({name: np.array(bundle[name]) for name in bundle.arrays}, bundle.meta)


def spoilt(bundle: Bundle, stage: Stage, how: str) -> Bundle:
    """The bundle with all undefined but for a few places, with few points, or without texture."""
    arrays = {}
    for name, array in bundle.arrays.items():
        about = next(a for a in stage.outputs if a.matches(name))
        if how in AMOUNTS:
            arrays[name] = blotted(array, about, AMOUNTS[how])
        elif how == "flat":
            image = about.dims[:2] == ("row", "col") and array.size
            arrays[name] = np.full_like(array, np.nan_to_num(array.flat[array.size // 2])) if image else array
        else:
            points = (slice(int(how[0])) if dim in POINTS else slice(None) for dim in about.dims)
            arrays[name] = array[tuple(points)]
    return Bundle(arrays, bundle.meta)


def blotted(array: AnyArray, about: Array, kept: int) -> AnyArray:
    """The array as it is declared where nothing is defined, an image black, but for some places."""
    image = about.dims[:2] == ("row", "col")
    if not array.size or not (image or about.nodata):
        return array
    out = np.full_like(array, float(about.nodata or 0))
    places = array.shape[: 2 if image else 1]
    for place in np.linspace(0, np.prod(places) - 1, kept + 2).astype(int)[1:-1]:
        at = np.unravel_index(place, places)
        out[at] = array[at]
    return out


def attempts(task: Task, ways: list[str]) -> Iterator[tuple[str, dict[str, Any]]]:
    """Inputs of the task, all of them spoilt, then one port alone, and of a list its first one alone."""
    for how in ways:
        bad = {}
        for port, given in task.inputs.items():
            many = isinstance(given, list)
            pairs = zip(given, task.makers[port], strict=True) if many else [(given, task.makers[port])]
            made = [spoilt(bundle, stage, how) for bundle, stage in pairs]
            bad[port] = made if many else made[0]
        yield f"{how}, all", bad
        if how[0].isdigit():  # a point without its partner in another input is no input
            continue
        for port, given in task.inputs.items():
            yield f"{how}, {port}", {**task.inputs, port: bad[port]}
            if isinstance(given, list) and len(given) > 1:
                yield f"{how}, first of {port}", {**task.inputs, port: [bad[port][0], *given[1:]]}


def survey(tasks: list[Task], ways: list[str]) -> list[str]:
    """All that raises an error other than the declared one."""
    failures = []
    for task in tasks:
        for what, inputs in attempts(task, ways):
            try:
                task.run(inputs)
            except Exception as error:
                failures.append(f"{task.label} ({what}): {type(error).__name__}: {error}")
    return failures


def test_stages_bear_that_nothing_is_usable(tmp_path: Path) -> None:
    assert survey(recorded(["plain"], tmp_path, outputs=False), ["nothing"]) == []


@pytest.mark.slow
def test_every_stage_bears_that_little_is_usable(tmp_path: Path) -> None:
    tasks = recorded(list(RUNS), tmp_path)
    sources = Path(rille.__file__).parent.parent
    declared = {
        path.relative_to(sources).with_suffix("").as_posix().replace("/", ".")
        for path in sources.glob("stages/**/*.py")
        if re.search(r"^(STAGE = |@stage\()", path.read_text(encoding="utf-8"), re.MULTILINE)
    }
    met = {task.spec.module.removeprefix("rille.") for task in tasks}
    assert declared - met == {f"stages.{name}" for name in ELSEWHERE}
    assert survey(tasks, [*AMOUNTS, "flat", "0 points", "1 points", "2 points"]) == []
