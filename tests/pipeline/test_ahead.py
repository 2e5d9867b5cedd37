"""Figures that are drawn before a run has ended are those that it would have at its end."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from toys.chain import build
from toys.finished import bundles, view

from pipeline import ahead as ahead_module
from pipeline import driver
from pipeline.ahead import Ahead
from pipeline.dag import Graph
from pipeline.report import canvas, gallery
from pipeline.report.block import Block
from pipeline.report.gather import Scene
from pipeline.store import Store


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


def draw(early: Any) -> tuple[Ahead, threading.Thread]:
    begun = Ahead(lambda: early)
    thread = threading.Thread(target=begun.draw)
    thread.start()
    return begun, thread


def until(condition: Any) -> None:
    """Wait for what another thread does."""
    for _ in range(3000):
        if condition():
            return
        threading.Event().wait(0.01)
    raise AssertionError("it never came")


def test_a_figure_waits_for_all_its_artifacts_and_is_as_at_the_end(early: tuple[Any, threading.Event]) -> None:
    expected = at_the_end()
    needs_path = "Figure 7. Ortho image and path"
    assert needs_path in expected
    begun, thread = draw(early[0])
    until(lambda: "Figure 9. Trajectory" in begun._drawn)
    assert needs_path not in begun._drawn
    early[1].set()
    until(lambda: set(begun._drawn) == set(expected))
    thread.join()
    assert begun.take() == expected


def test_nothing_is_drawn_after_it_was_taken(early: tuple[Any, threading.Event]) -> None:
    begun, thread = draw(early[0])
    taken = dict(begun.take())
    early[1].set()
    thread.join()
    assert begun.take() == taken
    assert len(taken) < len(at_the_end())
    begun.draw()
    assert begun.take() == taken


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
    driver.run(graph, Store(cache), executor=executor, jobs=2, meanwhile=called.release).check()
    for _ in range(calls):
        assert called.acquire(timeout=10)
    assert not called.acquire(timeout=0.05)
    again = Graph()
    build(again)
    driver.run(again, Store(cache), executor=executor, jobs=2, meanwhile=called.release).check()
    assert not called.acquire(timeout=0.05)
