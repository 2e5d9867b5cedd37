"""A run: its folder, its pins, what it left."""
