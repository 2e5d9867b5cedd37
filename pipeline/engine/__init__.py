"""Cached tasks: graph, keys, scheduler, events."""
