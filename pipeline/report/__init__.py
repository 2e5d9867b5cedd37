"""The report of a run: ``report.json`` for programs and ``report.html``, one file, for people."""
