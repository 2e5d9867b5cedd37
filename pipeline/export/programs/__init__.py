"""Forms of a run that other programs ask for: written by ``rille export --to``."""
