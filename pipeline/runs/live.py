"""``live.html``: progress of a run as a page that loads itself anew, and leads to the report in the end."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from rille.pipeline.engine.plain import plain
from rille.pipeline.engine.progress import Progress, clock, to_go
from rille.pipeline.engine.runtime import atomic

if TYPE_CHECKING:
    from rille.pipeline.engine.forecast import Kinds
    from rille.pipeline.engine.graph import Graph, Handle
    from rille.pipeline.engine.scheduler import Result

INTERVAL = 1.0
"""Least seconds between two writings; the page loads itself anew every two."""

PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{title}</title>
<style>
body {{ max-width: 44rem; margin: 0 auto; padding: 1.5rem 1rem; font: 16px/1.5 system-ui, sans-serif; }}
h1 {{ font-size: 1.4rem; overflow-wrap: anywhere; }}
progress {{ width: 100%; height: 1.4rem; accent-color: #2f7fc4; }}
td, th {{ text-align: left; padding: .15rem 1.2rem .15rem 0; overflow-wrap: anywhere; }}
td + td, th + th {{ text-align: right; font-variant-numeric: tabular-nums; }}
</style>
</head>
<body>
<main>
<h1>{title}</h1>
{body}
</main>
{script}</body>
</html>
"""
AGAIN = "<script>setTimeout(() => location.reload(), 2000);</script>\n"


@contextmanager
def page(shown: Progress, path: Path | None) -> Iterator[Progress]:
    """Yield the receiver of a run's progress: ``shown``, or with ``path`` one that also updates the page there."""
    if path is None:
        yield shown
        return
    live = Live(shown, path)
    try:
        yield live
    except BaseException as error:
        live.end(f"<p><strong>The run was ended: {escape(_said(error))}.</strong></p>")
        raise
    live.end('<p><strong>The run has come to its end: <a href="report.html">the report</a>.</strong></p>')


class Live(Progress):
    """Passes each step on, and writes the page now and then."""

    def __init__(self, shown: Progress, path: Path) -> None:
        self.shown, self.path, self.began, self.forecast = shown, path, time.monotonic(), shown.forecast
        self.graph: Graph | None = None
        self.running_now: dict[str, None] = {}
        self.ended: Counter[str] = Counter()
        self.failures: list[str] = []
        self.written = -INTERVAL

    def open(self, graph: Graph, earlier: Kinds | None, jobs: int) -> None:
        """Write the page for the first time."""
        self.shown.open(graph, earlier, jobs)
        self.graph, self.forecast = graph, self.shown.forecast
        self._write()

    def running(self, handle: Handle) -> None:
        """Name it."""
        self.shown.running(handle)
        self.running_now[handle.label] = None
        self._write()

    def resolved(self, handle: Handle) -> None:
        """Count it."""
        self.shown.resolved(handle)
        self.running_now.pop(handle.label, None)
        self.ended[handle.stage] += 1
        self._write()

    def failed(self, label: str, error: BaseException) -> None:
        """Name it with its reason."""
        self.shown.failed(label, error)
        self.failures.append(f"{label}: {_said(error)}")

    def detail(self, text: str) -> None:
        """Pass it on."""
        self.shown.detail(text)

    def close(self, result: Result) -> None:
        """Say that the report is being written."""
        self.shown.close(result)
        self.running_now = {"report": None}
        self.written = -INTERVAL
        self._write()

    def end(self, words: str) -> None:
        """Write the page for the last time: ``words`` are HTML."""
        self.running_now = {}
        self._put(words, "")

    def _write(self) -> None:
        if time.monotonic() - self.written >= INTERVAL:
            self.written = time.monotonic()
            words = f"<p>{datetime.now(UTC):%H:%M:%S} UTC{to_go(self.forecast)}"
            self._put(words + ". If this time stands still for minutes, the run was killed.</p>", AGAIN)

    def _put(self, words: str, script: str) -> None:
        if not self.path.parent.is_dir():  # the user removed the run: it ends with that message, not with a new folder
            return
        known = Counter(h.stage for h in self.graph.nodes) if self.graph is not None else Counter[str]()
        ended, total = self.ended.total(), known.total()
        body = [
            words,
            f'<progress aria-label="Tasks" value="{ended}" max="{max(total, 1)}"></progress>',
            f"<p>{ended} of {total} tasks known so far, after {clock(time.monotonic() - self.began)}.</p>",
            _list("Under way", self.running_now),
            _list("Failed", dict.fromkeys(self.failures)),
            _table(known, self.ended),
        ]
        title = escape(f"{self.path.parent.parent.name} · {self.path.parent.name}")
        atomic.write(self.path, PAGE.format(title=title, body="\n".join(filter(None, body)), script=script))


def _said(error: BaseException) -> str:
    return str(error) or type(error).__name__


def _list(title: str, lines: Mapping[str, None]) -> str:
    items = "".join(f"<li>{escape(plain(line))}</li>" for line in lines)
    return f"<h2>{title}</h2>\n<ul>{items}</ul>" if items else ""


def _table(known: Mapping[str, int], done: Mapping[str, int]) -> str:
    rows = [f"<tr><td>{escape(stage)}</td><td>{done[stage]}</td><td>{n}</td></tr>" for stage, n in known.items()]
    return "\n".join(["<table>", "<tr><th>Stage</th><th>done</th><th>known</th></tr>", *rows, "</table>"])
