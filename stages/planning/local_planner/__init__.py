"""The planner that drives a vehicle over ground that it sees as it goes."""
