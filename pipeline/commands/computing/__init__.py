"""Commands that compute a run, or its plan."""
