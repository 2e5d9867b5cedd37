"""Figures drawn and files written before a run has ended are those that it would have at its end."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from toys.chain import build
from toys.finished import bundles, view

from pipeline.engine import scheduler
from pipeline.engine.graph import Graph
from pipeline.engine.store.folder import Store
from pipeline.runs import early as ahead_module
from pipeline.runs import run_files
from pipeline.runs.early import Ahead, Early
from pipeline.report import canvas, gallery
from pipeline.report.block import Block
from pipeline.report.gather import Scene


@pytest.fixture(autouse=True)
def _unpainted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are laid out, but not painted: a panel is what it says."""
    monkeypatch.setattr(canvas, "encode", lambda _, alt, *, photo=False: canvas.Panel(f"{photo}", alt, 1, 1))


def at_the_end() -> dict[str, Block]:
    """What the report of the whole run draws."""
    drawn = {title: maker(Scene(view())) for title, maker in gallery.makers()}
    return {title: block for title, block in drawn.items() if block is not None}


@pytest.fixture
def early(monkeypatch: pytest.MonkeyPatch) -> tuple[Any, threading.Event]:
    """A view of a run whose path is there once the event is set, and soon looked for again."""
    monkeypatch.setattr(ahead_module, "AGAIN", 0.01)
    there, whole, found = threading.Event(), view(), bundles()
    late = whole.products.path

    def find(handle: Any) -> Any:
        return None if handle is late and not there.is_set() else whole.bundle(handle)

    assert late is not None
    assert found
    return replace(whole, bundle=find, tasks=()), there


def begin(early: Any, folder: Path) -> tuple[Ahead, threading.Thread]:
    begun = Ahead(folder, lambda: early)
    thread = threading.Thread(target=begun.work)
    thread.start()
    return begun, thread


def until(condition: Any) -> None:
    """Wait for what another thread does."""
    for _ in range(3000):
        if condition():
            return
        threading.Event().wait(0.01)
    raise AssertionError("it never came")


def contents(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_figure_waits_for_all_its_artifacts_and_is_as_at_the_end(
    early: tuple[Any, threading.Event], tmp_path: Path
) -> None:
    expected = at_the_end()
    needs_path = "Figure 7. Ortho image and path"
    assert needs_path in expected
    begun, thread = begin(early[0], tmp_path)
    until(lambda: "Figure 9. Trajectory" in begun._made.figures)
    assert needs_path not in begun._made.figures
    early[1].set()
    until(lambda: set(begun._made.figures) == set(expected))
    thread.join()
    assert begun.take().figures == expected


def test_files_wait_too_and_the_run_takes_them_as_they_are(early: tuple[Any, threading.Event], tmp_path: Path) -> None:
    whole, folders = replace(early[0], bundle=view().bundle), [tmp_path / "plain", tmp_path / "early"]
    for folder in folders:
        folder.mkdir()
    run_files.write(folders[0], whole, Early())
    with Ahead(folders[1], lambda: early[0]) as ahead:
        thread = threading.Thread(target=ahead.work)
        thread.start()
        until(lambda: {"terrain", "risk"} <= set(ahead._made.files))
        assert "path" not in ahead._made.files
        assert [p.name for p in folders[1].iterdir()] == [".early"]
        early[1].set()
        until(lambda: "path" in ahead._made.files)
        thread.join()
        run_files.write(folders[1], whole, ahead.take())
    plain, found = map(contents, folders)
    assert {"dem.tif", "risk.tif", "path.gpkg", "path.geojson"} <= set(plain)
    assert found == plain


def test_a_run_that_fails_leaves_nothing_of_it(early: tuple[Any, threading.Event], tmp_path: Path) -> None:
    def fail() -> None:
        with Ahead(tmp_path, lambda: early[0]) as ahead:
            threading.Thread(target=ahead.work).start()
            until(lambda: "terrain" in ahead._made.files)
            assert contents(tmp_path)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert not list(tmp_path.iterdir())


def test_nothing_is_made_after_it_was_taken(early: tuple[Any, threading.Event], tmp_path: Path) -> None:
    begun, thread = begin(early[0], tmp_path)
    taken = dict(begun.take().figures)
    early[1].set()
    thread.join()
    assert begun.take().figures == taken
    assert len(taken) < len(at_the_end())
    begun.work()
    assert begun.take().figures == taken


def test_the_report_takes_what_was_drawn_and_draws_the_rest() -> None:
    expected = gallery.draw(Scene(view()))
    title = "Figure 9. Trajectory"
    mark = replace(at_the_end()[title], caption="drawn before")
    found = gallery.draw(Scene(view()), {title: mark})
    assert mark in found.blocks
    assert [b.name for b in found.blocks] == [b.name for b in expected.blocks]
    assert found.absent == expected.absent


@pytest.mark.parametrize(("executor", "calls"), [("processes", 1), ("threads", 0), ("inline", 0)])
def test_what_follows_begins_once_beside_worker_processes_only(cache: Path, executor: str, calls: int) -> None:
    called = threading.Semaphore(0)
    graph = Graph()
    build(graph)
    scheduler.run(graph, Store(cache), executor=executor, jobs=2, meanwhile=called.release).check()
    for _ in range(calls):
        assert called.acquire(timeout=10)
    assert not called.acquire(timeout=0.05)
    again = Graph()
    build(again)
    scheduler.run(again, Store(cache), executor=executor, jobs=2, meanwhile=called.release).check()
    assert not called.acquire(timeout=0.05)
