"""What is computed from what: reconstruction, closed loop, configuration."""
