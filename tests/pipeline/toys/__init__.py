"""Tiny stages for the tests of the engine."""
