"""Where stereo sequences come from. This package imports nothing on its own."""
