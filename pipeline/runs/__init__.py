"""A run: its options, its folder and files."""
