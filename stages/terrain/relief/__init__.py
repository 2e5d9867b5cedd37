"""Elevations on cells of any orientation, and how one terrain lies on another."""
