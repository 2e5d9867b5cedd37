"""A sequence described by a file of the user's: ``NAME.rille.toml``."""
