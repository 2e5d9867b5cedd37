"""Artifacts: committed once, found by their keys, in a folder."""
