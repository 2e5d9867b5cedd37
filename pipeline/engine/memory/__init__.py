"""Cost of tasks in memory, and the choice of tasks that run side by side."""
