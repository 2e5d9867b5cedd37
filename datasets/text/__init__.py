"""Text files that are read with care: bounded, checked, and named in every complaint."""
