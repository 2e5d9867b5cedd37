"""Elevation models from one disparity map in several ways, judged at equal completeness."""
