"""Parts of ``benchmarks/loop.py`` and ``exact_loop.py``: beds, obstacle trials, and how paths are judged."""
