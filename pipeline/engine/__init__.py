"""Cached tasks: graph, keys, run, workers, events."""
