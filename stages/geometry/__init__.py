"""Cameras, poses, surfaces and lattices."""
