"""A run: its folder, what it left."""
