"""Paths over a risk map, and the local planner of a drive."""
