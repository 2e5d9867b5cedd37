"""What tasks cost, and what may run side by side."""
