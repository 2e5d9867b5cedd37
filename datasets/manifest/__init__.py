"""A sequence described by the user's file ``NAME.rille.toml``."""
