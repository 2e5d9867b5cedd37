"""Elevation models: ground frame, Locus, merge, checks of overlaps, place in a map, shading."""
