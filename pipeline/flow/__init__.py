"""The dataflow: reconstruction, closed loop, configuration."""
