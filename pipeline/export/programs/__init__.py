"""Exports of a run for other programs, written by ``rille export --to``."""
