"""The page that shows a run at work: what it says at each time, and that it leads to the report."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from toys.browser import Browser

from rille.pipeline.engine import scheduler
from rille.pipeline.engine.graph import Graph
from rille.pipeline.engine.progress import Progress
from rille.pipeline.engine.store.base import Store
from rille.pipeline.runs import live
from rille.stages.core.declare import NoParams


@pytest.fixture
def pages(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Every state of the page, in the order of writing."""
    written: list[str] = []
    put: Callable[[Path, bytes | str], None] = live.atomic.write

    def note(path: Path, data: bytes | str) -> None:
        written.extend([str(data)] if path.name == "live.html" else [])
        put(path, data)

    monkeypatch.setattr(live, "INTERVAL", 0.0)
    monkeypatch.setattr(live.atomic, "write", note)
    return written


def _run(folder: Path, cache: Path, *what: str) -> scheduler.Result:
    graph = Graph()
    for word in what:
        graph.node("toys.mischief", f"task <{word}>", NoParams(), {"what": word})
    with live.page(Progress(), folder / "live.html") as told:
        return scheduler.run(graph, Store(cache), scheduler.RunOptions(executor="inline", progress=told))


def test_it_loads_itself_anew_until_the_report_is_there(tmp_path: Path, cache: Path, pages: list[str]) -> None:
    folder = tmp_path / "bed" / "run"
    folder.mkdir(parents=True)
    assert not _run(folder, cache, "fine", "value").ok
    assert [live.AGAIN in page for page in pages] == [True] * (len(pages) - 1) + [False]
    counts = [int(found[1]) for page in pages if (found := re.search(r'value="(\d+)" max="2"', page))]
    assert counts == sorted(counts)
    assert {0, 1, 2} <= set(counts)
    assert any("<li>task &lt;fine&gt;</li>" in page for page in pages)
    assert "<li>report</li>" in pages[-2]
    assert '<a href="report.html">' in pages[-1]
    assert "<h2>Failed</h2>\n<ul><li>task &lt;value&gt;: " in pages[-1]
    assert (folder / "live.html").read_text(encoding="utf-8") == pages[-1]


def test_an_error_ends_it_without_a_report(tmp_path: Path, pages: list[str]) -> None:
    def stop() -> None:
        with live.page(Progress(), tmp_path / "live.html"):
            raise OSError("no <space>")

    with pytest.raises(OSError, match="space"):
        stop()
    assert "The run was ended: no &lt;space&gt;." in pages[-1]
    assert "report.html" not in pages[-1]
    assert live.AGAIN not in pages[-1]


def test_a_removed_folder_stays_removed(tmp_path: Path) -> None:
    with live.page(Progress(), tmp_path / "gone" / "live.html"):
        pass
    assert not (tmp_path / "gone").exists()


def test_who_does_not_ask_gets_the_usual_progress() -> None:
    usual = Progress()
    with live.page(usual, None) as told:
        assert told is usual


def test_a_browser_goes_from_state_to_state(chromium: str, tmp_path: Path, cache: Path, pages: list[str]) -> None:
    folder = tmp_path / "bed" / "run"
    folder.mkdir(parents=True)
    _run(folder, cache, "fine")
    (folder / "live.html").write_text(pages[0].replace("2000", "300"), encoding="utf-8")
    browser = Browser(chromium, tmp_path)
    try:
        browser.ask("Page.navigate", url=(folder / "live.html").resolve().as_uri())
        assert _awaited(browser, "document.querySelector('progress')?.value === 0")
        (folder / "live.html").write_text(pages[-1], encoding="utf-8")
        assert _awaited(browser, "document.querySelector('a')?.getAttribute('href') === 'report.html'")
        assert browser.messages == []
    finally:
        browser.close()


def _awaited(browser: Browser, condition: str) -> bool:
    """Whether it comes true within ten seconds; a page that goes away while it is asked has not answered."""
    until = time.monotonic() + 10
    while time.monotonic() < until:
        with suppress(AssertionError):
            if browser.run(condition):
                return True
        time.sleep(0.05)
    return False
