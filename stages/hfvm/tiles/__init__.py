"""Large pairs: each step of the matcher for one tile as a task, and the result put together."""
