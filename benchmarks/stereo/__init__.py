"""Parts of ``benchmarks/matching.py``: pairs with truth, matchers behind one interface, measures, misalignment."""
