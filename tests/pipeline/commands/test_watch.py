"""A sequence that is reconstructed while its images arrive."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from raising import raises

from rille.datasets.images import arrivals
from rille.datasets.protocol import Sequence
from rille.pipeline import cli
from rille.pipeline.commands.computing import watch as command
from rille.pipeline.engine import events
from rille.pipeline.runs import session
from rille.pipeline.runs.options import COMPLETE, HOLES, INTERRUPTED, WatchOptions
from rille.stages.core.errors import DegenerateError

MANIFEST = """
[images]
left = "left/*.png"
right = "right/*.png"
[cameras]
fx = 60.0
cx = 31.5
cy = 23.5
[rig]
baseline = 0.1
"""


def image(folder: Path, side: str, number: int, grey: int = 7) -> None:
    (folder / side).mkdir(exist_ok=True)
    assert cv2.imwrite(str(folder / side / f"{number:02d}.png"), np.full((48, 64), grey + number, np.uint8))


def pair(folder: Path, number: int) -> None:
    for side in ("left", "right"):
        image(folder, side, number)


class Scenario:
    """A watch of which the clock and the runs are made up: what happens to the folder, step by step."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        self.now, self.steps, self.runs = 0.0, list[Callable[[], None]](), list[tuple[int, str | None, bool]]()
        self.folder, self.error = tmp_path / "rover", None
        self.folder.mkdir()
        (self.folder / "manifest.toml").write_text(MANIFEST)
        self.places = {"runs": tmp_path / "runs", "cache": str(tmp_path / "cache")}
        for module in (command, arrivals):
            monkeypatch.setattr(module, "time", self)
        monkeypatch.setattr(session, "perform", self.perform)

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        """Let a second go by, after which the next step happens."""
        self.now += 1.0
        if self.steps:
            self.steps.pop(0)()

    def perform(self, sequence: Sequence, options: WatchOptions, **_: Any) -> session.RunResult:
        whole = sequence.frames - len(sequence.lost)
        self.runs.append((whole, options.frames, bool(options.only)))
        if self.error is not None:
            raise self.error
        folder = self.places["runs"] / f"{len(self.runs)}"
        folder.mkdir(parents=True)
        return session.RunResult(COMPLETE, folder, [f"run {len(self.runs)}"], [])

    def watch(self, *steps: Callable[[], None], until_idle: float | None = 3.0, **options: Any) -> int:
        self.steps = list(steps)
        given = WatchOptions(**self.places, **options, until_idle=until_idle)  # type: ignore[arg-type]
        return command.watch(str(self.folder), options=given)


@pytest.fixture
def scenario(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Scenario:
    return Scenario(monkeypatch, tmp_path)


def nothing() -> None:
    """A second in which nothing happens."""


def test_each_pair_is_taken_once_and_the_end_is_a_whole_run(scenario, capsys):
    f = scenario.folder
    assert scenario.watch(nothing, lambda: pair(f, 0), nothing, nothing, lambda: pair(f, 1), nothing) == COMPLETE
    assert scenario.runs == [(1, None, True), (2, None, True), (2, None, False)]
    assert [p.name for p in scenario.places["runs"].iterdir()] == ["3"], "results of earlier updates are replaced"
    out, err = capsys.readouterr()
    assert [line.split(": ")[-1] for line in out.splitlines()] == ["run 1", "run 2", "run 3"]
    assert err.count("images.left") == 1


def test_images_that_are_there_are_not_said_to_be_missing(scenario, capsys):
    pair(scenario.folder, 0)
    assert scenario.watch() == COMPLETE
    assert "waiting" not in capsys.readouterr().err


def test_a_half_written_image_is_not_taken(scenario):
    f = scenario.folder
    path = f / "right/01.png"

    def half() -> None:
        pair(f, 1)
        path.write_bytes(path.read_bytes()[:60])

    late = lambda: image(f, "right", 1)  # noqa: E731
    scenario.watch(lambda: pair(f, 0), nothing, half, nothing, late, nothing)
    assert scenario.runs == [(1, None, True), (2, None, True), (2, None, False)]


def test_an_image_that_stays_broken_is_left_out_and_named(scenario, capsys):
    f = scenario.folder
    broken = lambda: (pair(f, 2), (f / "right/02.png").write_bytes(b"x"))  # noqa: E731
    assert scenario.watch(lambda: pair(f, 0), lambda: pair(f, 1), broken, nothing) == HOLES
    assert [run for run in scenario.runs if not run[2]] == [(2, None, False)]
    assert "02.png" in capsys.readouterr().err


def test_a_late_image_is_waited_for_and_then_counts_as_lost(scenario):
    f = scenario.folder
    for k in (0, 2, 3):
        pair(f, k)
    image(f, "left", 1)
    late = lambda: image(f, "right", 1)  # noqa: E731
    scenario.watch(*[nothing] * 12, late, nothing, until_idle=20.0)
    # Up to the gap at once; without it after some seconds; whole once it has come.
    assert scenario.runs == [(3, "0:1", True), (3, None, True), (4, None, True), (4, None, False)]


def test_a_replaced_image_is_named_and_taken_anew(scenario, capsys):
    f = scenario.folder
    for k in (0, 1):
        pair(f, k)
    scenario.watch(nothing, nothing, lambda: image(f, "left", 0, grey=99), nothing)
    assert scenario.runs == [(2, None, True), (2, None, True), (2, None, False)], "never fewer than before"
    assert "00.png" in capsys.readouterr().err


def test_it_ends_at_a_number_of_pairs(scenario):
    f = scenario.folder
    scenario.watch(lambda: pair(f, 0), nothing, lambda: pair(f, 1), until_idle=None, count=2)
    assert scenario.runs[-2:] == [(2, None, True), (2, None, False)]


def test_what_is_ahead_of_the_pairs_at_the_end_is_left_out_and_named(scenario, capsys):
    f = scenario.folder
    (f / "manifest.toml").write_text(MANIFEST + '[times]\nfile = "times.txt"\n')
    (f / "times.txt").write_text("0\n1\n2\n")
    assert scenario.watch(lambda: pair(f, 0), nothing, lambda: pair(f, 1), nothing) == HOLES
    assert scenario.runs == [(1, None, True), (2, None, True), (2, None, False)]
    assert "times.txt" in capsys.readouterr().err


def test_ctrl_c_names_the_last_result(scenario, capsys):
    def interrupt() -> None:
        raise KeyboardInterrupt

    pair(scenario.folder, 0)
    assert scenario.watch(nothing, nothing, interrupt, until_idle=None) == INTERRUPTED
    assert str(scenario.places["runs"] / "1") in capsys.readouterr().err
    assert (scenario.places["runs"] / "1").is_dir()


def test_an_update_that_fails_does_not_end_the_watch(scenario, capsys):
    def mended() -> None:
        scenario.error = None
        pair(scenario.folder, 1)

    scenario.error = DegenerateError("RIL-051", "no cell")
    pair(scenario.folder, 0)
    assert scenario.watch(nothing, nothing, mended, nothing) == COMPLETE
    assert [run[0] for run in scenario.runs] == [1, 2, 2]
    assert "RIL-051" in capsys.readouterr().err


def test_what_no_file_can_mend_ends_it_at_once(scenario, tmp_path):
    with raises("RIL-276"):
        command.watch(str(tmp_path / "no/such"), options=WatchOptions(**scenario.places))
    with raises("RIL-087"):
        command.watch("mockup-short", options=WatchOptions(**scenario.places))
    with raises("RIL-027"):
        scenario.watch(assignments=("locus.cell_sise=1",))
    with raises("RIL-088", "mockup"):
        scenario.watch(assignments=("mockup.frames=1",))
    assert scenario.runs == []


def test_the_results_are_those_of_a_run_of_all_frames(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small = [f"mockup.{what}" for what in ("frames=3", "image_width=190", "image_height=174", "focal_length=200.0")]
    small = [word for what in small for word in ("--set", what)]
    assert cli._run(["datasets", "export", "mockup-short", "whole", "--cache", "images", *small]) == COMPLETE
    images = sorted(tmp_path.glob("whole/*t/*.png"), key=lambda path: path.name)
    assert len(images) == 6
    shutil.copytree("whole", "rover", ignore=lambda _, names: [n for n in names if n.endswith((".png", ".npz"))])

    def write() -> None:
        for path in images:
            content, place = path.read_bytes(), tmp_path / "rover" / path.parent.name / path.name
            place.write_bytes(content[: len(content) // 2])
            time.sleep(0.3)
            place.write_bytes(content)

    writer = threading.Thread(target=write)
    writer.start()
    given = [
        "--executor",
        "inline",
        "--set",
        "locus.cell_size=0.006",
        "--only",
        "dem.tif",
        "--only",
        "path.gpkg",
        "--quiet",
    ]
    codes = [cli._run(["watch", "./rover", "--cache", "c", "--count", "3", *given])]
    writer.join()
    watched = Path("runs/rover/latest").resolve()
    assert (watched / "config.toml").read_text().startswith("# rille reconstruct ./rover ")
    for cache in ("c", "other"):
        codes.append(cli._run(["reconstruct", "rover", "--cache", cache, *given]))
    again, apart = sorted(path for path in Path("runs/rover").iterdir() if path.is_dir() and not path.is_symlink())[1:]
    runs = [
        {row["label"]: row["digest"] for row in events.read(run / "ledger.jsonl")} for run in (watched, again, apart)
    ]
    assert codes == [codes[0]] * 3
    assert runs[0] == runs[1] == runs[2]
    assert len(runs[0]) > 30
    assert "  computed 0," in capsys.readouterr().out
