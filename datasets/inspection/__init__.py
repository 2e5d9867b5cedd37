"""Inspection of a folder of stereo images: what ``rille init`` finds in it."""
