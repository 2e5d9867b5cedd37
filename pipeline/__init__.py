"""How work runs: keys, artifacts, graph, executors, report, command line and Python interface. No numerics."""
