"""Calibration of the two cameras: orientation, rig, lenses from targets, test for swapped images."""
