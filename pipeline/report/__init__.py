"""The report of a run: ``report.json`` for programs and ``report.html``, one file, for people."""

from pipeline.report.page import draw, write_report
from pipeline.report.view import RunView, TaskRow

__all__ = ["RunView", "TaskRow", "draw", "write_report"]
