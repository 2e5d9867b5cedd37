"""Parts of ``benchmarks/hazards.py``: simulated scenes, ways to classes, and how they are judged."""
