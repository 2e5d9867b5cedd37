"""Monitors of a driving vehicle: faults of its motion, and obstacles."""
