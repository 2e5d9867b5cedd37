"""How work runs: keys, artifacts, graph, executors, report and command line. No numerics."""
