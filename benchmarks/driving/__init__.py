"""Parts of ``benchmarks/loop.py`` and ``exact_loop.py``: their beds, trials of the reflex, and how ways are judged."""
