"""Commands that compute a run, or say what it would compute."""
