"""Sources of stereo sequences. This module imports nothing."""
