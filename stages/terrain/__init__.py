"""Elevation models: the ground frame, merging, checks of overlaps, shading."""
